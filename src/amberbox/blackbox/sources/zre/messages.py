"""Beacons and messages of ZRE version 2 (ZeroMQ RFC 36): read from bytes and written to bytes.

A beacon is a UDP datagram of 22 bytes: ``ZRE``, 1, the node's UUID, its TCP port (0: it leaves). A
message is a frame that begins with AA A1, kind, version and sequence number, then its content.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

HELLO, WHISPER, SHOUT, JOIN, LEAVE, PING, PING_OK = range(1, 8)
OTHERS: Final = (8, 9, 10)  # election, leader, goodbye: of newer nodes, not for a listener

_BEACON = struct.Struct(">4s16sH")
_MARK = b"ZRE\x01"
_HEAD = struct.Struct(">HBBH")
_SIGNATURE, _VERSION = 0xAAA1, 2
_COUNT = struct.Struct(">I")
_MOST_ENTRIES = 1000  # groups or headers of a node
_LONGEST_TEXT = 4096


class ZreError(ValueError):
    """Bytes that are no message or beacon of ZRE."""


@dataclass(frozen=True, slots=True)
class Beacon:
    """Where a node can be reached; port 0 says that it leaves."""

    node: bytes
    port: int


@dataclass(frozen=True, slots=True)
class ZreMessage:
    """A message; what it has depends on its kind.

    ``status`` counts the changes of the sender's groups. ``endpoint``, ``groups``, ``name`` and
    ``headers`` are those of ``HELLO``.
    """

    kind: int
    sequence: int
    group: str = ""
    status: int = 0
    endpoint: str = ""
    name: str = ""
    groups: Sequence[str] = ()
    headers: Mapping[str, str] = field(default_factory=dict)


def read_beacon(data: bytes) -> Beacon:
    """Read a datagram; raises ZreError."""
    if len(data) != _BEACON.size or not data.startswith(_MARK):
        raise ZreError("no beacon of version 1")
    _, node, port = _BEACON.unpack(data)
    return Beacon(node, port)


def write_beacon(beacon: Beacon) -> bytes:
    """Write a datagram."""
    return _BEACON.pack(_MARK, beacon.node, beacon.port)


def read_message(frame: bytes) -> ZreMessage:
    """Read the first frame of a message, behind that of the sender; raises ZreError."""
    if len(frame) < _HEAD.size:
        raise ZreError("shorter than a header")
    signature, kind, version, sequence = _HEAD.unpack_from(frame)
    if signature != _SIGNATURE or version != _VERSION:
        raise ZreError("no message of version 2")
    rest = _Reader(frame, _HEAD.size)
    if kind == HELLO:
        return ZreMessage(
            kind,
            sequence,
            endpoint=rest.text(),
            groups=rest.long_texts(),
            status=rest.byte(),
            name=rest.text(),
            headers=rest.headers(),
        )
    if kind == SHOUT:
        return ZreMessage(kind, sequence, group=rest.text())
    if kind in (JOIN, LEAVE):
        return ZreMessage(kind, sequence, group=rest.text(), status=rest.byte())
    if kind in (WHISPER, PING, PING_OK, *OTHERS):
        return ZreMessage(kind, sequence)
    raise ZreError(f"no kind {kind}")


def write_message(message: ZreMessage) -> bytes:
    """Write the first frame of a message of a kind that a listener sends."""
    head = _HEAD.pack(_SIGNATURE, message.kind, _VERSION, message.sequence)
    if message.kind == HELLO:
        headers = (_text(key) + _long_text(text) for key, text in message.headers.items())
        return b"".join(
            (
                head,
                _text(message.endpoint),
                _COUNT.pack(len(message.groups)),
                *map(_long_text, message.groups),
                bytes([message.status]),
                _text(message.name),
                _COUNT.pack(len(message.headers)),
                *headers,
            )
        )
    if message.kind in (JOIN, LEAVE):
        return head + _text(message.group) + bytes([message.status])
    return head + (_text(message.group) if message.kind == SHOUT else b"")


def _text(text: str) -> bytes:
    data = text.encode()[:255]
    return bytes([len(data)]) + data


def _long_text(text: str) -> bytes:
    data = text.encode()
    return _COUNT.pack(len(data)) + data


@dataclass
class _Reader:
    """Reads the fields of a message one after the other; raises ZreError at its end."""

    _frame: bytes
    _at: int

    def _take(self, length: int) -> bytes:
        end = self._at + length
        if end > len(self._frame):
            raise ZreError("shorter than its fields")
        data, self._at = self._frame[self._at : end], end
        return data

    def byte(self) -> int:
        return self._take(1)[0]

    def text(self) -> str:
        return self._take(self.byte()).decode(errors="replace")

    def _long_text(self) -> str:
        length = self._count(_LONGEST_TEXT)
        return self._take(length).decode(errors="replace")

    def long_texts(self) -> Sequence[str]:
        return [self._long_text() for _ in range(self._count(_MOST_ENTRIES))]

    def headers(self) -> Mapping[str, str]:
        entries = [(self.text(), self._long_text()) for _ in range(self._count(_MOST_ENTRIES))]
        return dict(entries)

    def _count(self, most: int) -> int:
        (count,) = _COUNT.unpack(self._take(_COUNT.size))
        if count > most:
            raise ZreError("too much of something")
        return int(count)
