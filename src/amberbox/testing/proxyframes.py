"""Faults of single WebSocket frames: sent twice, swapped, or with a byte changed.

Masks are undone and redone, so the peers see well-formed frames: what is wrong is their content.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

_BINARY = 2
_MASK = 0x80


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """How likely each fault is, for each binary frame."""

    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    hold: float = 0.0
    """A frame is held back and comes much later, behind others."""


@dataclass(slots=True)
class _Direction:
    """One direction of a connection: bytes that are no whole frame yet, frames held back."""

    upgraded: bool = False
    other: bool = False
    """It is no WebSocket: everything passes untouched."""
    buffer: bytearray = field(default_factory=bytearray)
    swapped: bytes = b""
    held: list[tuple[int, bytes]] = field(default_factory=list)


class Mangler:
    """Mangles the frames of one connection; what comes before the upgrade passes untouched."""

    def __init__(self, faults: FrameFaults, seed: int) -> None:
        self._faults = faults
        self._chance = random.Random(seed)
        self._ways = {True: _Direction(), False: _Direction()}
        self.done: list[str] = []

    def pass_on(self, data: bytes, *, up: bool) -> bytes:
        """Take bytes of one direction; return what goes on now."""
        way = self._ways[up]
        if way.other:
            return data
        way.buffer += data
        out = b""
        if not way.upgraded:
            head, found, _ = bytes(way.buffer).partition(b"\r\n\r\n")
            if not found:
                return b""
            if b"upgrade: websocket" not in head.lower():
                way.other = True
                return bytes(way.buffer)
            way.upgraded = True
            out, way.buffer = head + found, way.buffer[len(head) + len(found) :]
        while (size := _frame_size(way.buffer)) and len(way.buffer) >= size:
            frame, way.buffer = bytes(way.buffer[:size]), way.buffer[size:]
            out += self._mangled(frame, way)
        return out

    def _mangled(self, frame: bytes, way: _Direction) -> bytes:
        late = b"".join(held for count, held in way.held if count <= 0)
        way.held = [(count - 1, held) for count, held in way.held if count > 0]
        before, way.swapped = way.swapped, b""
        if frame[0] & 0x0F != _BINARY:
            return before + frame + late
        chance, faults = self._chance.random(), self._faults
        if chance < faults.duplicate:
            self.done.append("duplicate")
            frame += frame
        elif (chance := chance - faults.duplicate) < faults.reorder:
            self.done.append("reorder")
            way.swapped = frame
            return before + late
        elif (chance := chance - faults.reorder) < faults.corrupt:
            self.done.append("corrupt")
            frame = self._corrupted(frame)
        elif chance - faults.corrupt < faults.hold:
            self.done.append("hold")
            way.held.append((self._chance.randint(2, 10), frame))
            return before + late
        return frame + before + late

    def _corrupted(self, frame: bytes) -> bytes:
        """Change one byte of a frame's content; a masked one stays so."""
        start = _head_size(frame)
        if start >= len(frame):
            return frame
        at = self._chance.randrange(start, len(frame))
        return frame[:at] + bytes([frame[at] ^ (1 << self._chance.randrange(8))]) + frame[at + 1 :]


def _head_size(frame: bytes | bytearray) -> int:
    """Return where a frame's content begins; 0 when that cannot be told yet."""
    if len(frame) < 2:
        return 0
    length, mask = frame[1] & 0x7F, 4 if frame[1] & _MASK else 0
    return 2 + {126: 2, 127: 8}.get(length, 0) + mask


def _frame_size(buffer: bytearray) -> int:
    """Return the size of the frame at the beginning; 0 when that cannot be told yet."""
    head = _head_size(buffer)
    if not head or len(buffer) < head:
        return 0
    length = buffer[1] & 0x7F
    if length == 126:
        length = int.from_bytes(buffer[2:4], "big")
    elif length == 127:
        length = int.from_bytes(buffer[2:10], "big")
    return head + length
