"""A TCP proxy that injects faults, also into WebSocket frames; the same for the same seed.

``Proxy(port, Faults(...), seed)`` listens on loopback and passes connections on; as a context
manager it runs in a thread of its own. ``plan`` gives the faults of each connection beforehand.
Frames are sent twice, swapped, or with a byte changed: masks are undone and redone, so the peers
see well-formed frames whose content is wrong.
"""

from __future__ import annotations

import random
import selectors
import socket
import struct
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

_BINARY = 2
_MASK = 0x80


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """The probability of each fault, for each binary frame."""

    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    hold: float = 0.0
    """A frame is held back and delivered much later, after others."""


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
    """Mangles the frames of one connection; data before the upgrade pass unchanged."""

    def __init__(self, faults: FrameFaults, seed: int) -> None:
        self._faults = faults
        self._chance = random.Random(seed)
        self._causal_paths = {True: _Direction(), False: _Direction()}
        self.done: list[str] = []

    def pass_on(self, data: bytes, *, up: bool) -> bytes:
        """Add bytes of one direction; return those to forward now."""
        way = self._causal_paths[up]
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
    """Return where a frame's content begins; 0 when that is not known yet."""
    if len(frame) < 2:
        return 0
    length, mask = frame[1] & 0x7F, 4 if frame[1] & _MASK else 0
    return 2 + {126: 2, 127: 8}.get(length, 0) + mask


def _frame_size(buffer: bytearray) -> int:
    """Return the size of the frame at the beginning; 0 when that is not known yet."""
    head = _head_size(buffer)
    if not head or len(buffer) < head:
        return 0
    length = buffer[1] & 0x7F
    if length == 126:
        length = int.from_bytes(buffer[2:4], "big")
    elif length == 127:
        length = int.from_bytes(buffer[2:10], "big")
    return head + length


Fault = Literal["none", "cut", "half_open", "stall", "throttle", "mid_frame"]
FAULTS: Sequence[Fault] = ("none", "cut", "half_open", "stall", "throttle", "mid_frame")
_READ_BYTES = 64 << 10
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Faults:
    """What may happen to a connection, and how soon.

    A fault is chosen for each connection from ``kinds`` and begins after a number of bytes between
    ``after_bytes``. A stall lasts ``stall_s``; a throttled connection carries ``rate`` bytes/s.
    ``frames`` are faults of WebSocket frames, which need a link without TLS.
    """

    kinds: Sequence[Fault] = FAULTS
    after_bytes: tuple[int, int] = (500, 50_000)
    stall_s: float = 1.0
    rate: float = 20_000.0
    frames: FrameFaults | None = None


@dataclass(frozen=True, slots=True)
class Planned:
    """The fault of one connection, and the number of bytes after which it begins."""

    kind: Fault
    after_bytes: int
    seed: int


def plan(faults: Faults, seed: int, connection: int) -> Planned:
    """Return the fault of a connection, counted from 0: the same for the same seed."""
    chance = random.Random(f"{seed}/{connection}")
    kind = chance.choice(list(faults.kinds))
    return Planned(kind, chance.randint(*faults.after_bytes), chance.getrandbits(32))


@dataclass(slots=True, eq=False)
class _Pair:
    """One connection: both its sockets, and the bytes passed so far."""

    client: socket.socket
    server: socket.socket
    planned: Planned
    mangler: Mangler | None
    passed: int = 0
    dead: bool = False
    stalled_until: float = 0.0
    budget: float = 0.0
    seen_at: float = field(default_factory=time.monotonic)

    @property
    def struck(self) -> bool:
        """Return whether its fault has begun."""
        return self.planned.kind != "none" and self.passed >= self.planned.after_bytes


class Proxy:
    """Passes TCP connections on to ``port`` of this computer, with faults."""

    def __init__(self, port: int, faults: Faults | None = None, seed: int = 0) -> None:
        self.target = port
        self.faults = faults or Faults(kinds=("none",))
        self.seed = seed
        self.connections = 0
        self.struck: list[Fault] = []
        self.mangled: list[str] = []
        self._pairs: list[_Pair] = []
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._run, name="faulty proxy", daemon=True)

    def __enter__(self) -> Proxy:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._listener.close()
        self.cut()

    def cut(self) -> None:
        """Cut every connection now, without a goodbye."""
        with self._lock:
            for pair in self._pairs:
                _reset(pair)
            self._pairs = []

    def silence(self) -> None:
        """Stall every connection from now on: both sides stay open, and no byte passes."""
        with self._lock:
            for pair in self._pairs:
                pair.dead = True

    def _run(self) -> None:
        self._listener.setblocking(False)
        while not self._stop.is_set():
            self._accept()
            with self._lock:
                pairs = list(self._pairs)
            self._pass_on(pairs)

    def _accept(self) -> None:
        with suppress(BlockingIOError):
            client, _ = self._listener.accept()
            try:
                server = socket.create_connection(("127.0.0.1", self.target), 2.0)
            except OSError:
                client.close()  # no server: same error as without a proxy
                return
            planned = plan(self.faults, self.seed, self.connections)
            self.connections += 1
            frames = self.faults.frames
            mangler = Mangler(frames, planned.seed) if frames is not None else None
            if mangler is not None:
                mangler.done = self.mangled
            with self._lock:
                self._pairs.append(_Pair(client, server, planned, mangler))

    def _pass_on(self, pairs: Sequence[_Pair]) -> None:
        """Forward the bytes that arrived."""
        with selectors.DefaultSelector() as ready:
            for pair in pairs:
                if self._may_pass(pair):
                    with suppress(ValueError):  # cut meanwhile
                        ready.register(pair.client, selectors.EVENT_READ, (pair, True))
                        ready.register(pair.server, selectors.EVENT_READ, (pair, False))
            if not ready.get_map():
                time.sleep(_POLL_S / 4)
                return
            for key, _ in ready.select(_POLL_S):
                pair, up = key.data
                try:
                    self._pass(pair, up=up)
                except OSError:
                    self._end(pair)

    def _may_pass(self, pair: _Pair) -> bool:
        """Return whether a connection carries anything now; begin its fault when it is due."""
        now = time.monotonic()
        if pair.dead or now < pair.stalled_until:
            return False
        if pair.struck and pair.planned.kind == "throttle":
            pair.budget = min(pair.budget + (now - pair.seen_at) * self.faults.rate, 65_536.0)
            pair.seen_at = now
            return pair.budget >= 256
        return True

    def _pass(self, pair: _Pair, *, up: bool) -> None:
        source, target = (pair.client, pair.server) if up else (pair.server, pair.client)
        kind, left = pair.planned.kind, pair.planned.after_bytes - pair.passed
        most = _READ_BYTES
        if kind == "throttle" and pair.struck:
            most = int(pair.budget)
            if most <= 0:
                return  # the other direction has used it up
        elif kind == "mid_frame" and left > 0:
            most = max(left, 1)  # it ends in the middle of the data under way
        data = source.recv(most)
        if not data:
            self._end(pair)
            return
        target.settimeout(5.0)
        target.sendall(pair.mangler.pass_on(data, up=up) if pair.mangler else data)
        was_struck = pair.struck
        pair.passed += len(data)
        if was_struck:
            pair.budget -= len(data)
        if pair.struck and not was_struck:
            self._strike(pair)

    def _strike(self, pair: _Pair) -> None:
        self.struck.append(pair.planned.kind)
        kind = pair.planned.kind
        if kind in ("cut", "mid_frame"):
            self._end(pair, abruptly=kind == "cut")
        elif kind == "half_open":
            pair.dead = True
        elif kind == "throttle":
            pair.seen_at = time.monotonic()
        elif kind == "stall":
            pair.stalled_until = time.monotonic() + self.faults.stall_s

    def _end(self, pair: _Pair, *, abruptly: bool = False) -> None:
        with self._lock:
            if pair in self._pairs:
                self._pairs.remove(pair)
        if abruptly:
            _reset(pair)
        pair.client.close()
        pair.server.close()


def _reset(pair: _Pair) -> None:
    """Close both sides as a broken network does: the peers get a reset, and no goodbye."""
    for side in (pair.client, pair.server):
        with suppress(OSError):
            side.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        side.close()
