"""What server and worker send each other through pipes: msgpack, its length before it."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import IO, Any

import msgspec

_LENGTH = struct.Struct("<I")

FRAME_BYTES = 64 << 20
"""A longer frame is no frame: the pipe carries something else."""


def packed(frame: Mapping[str, Any]) -> bytes:
    """Make a frame."""
    body = msgspec.msgpack.encode(frame)
    return _LENGTH.pack(len(body)) + body


def read_frame(stream: IO[bytes]) -> dict[str, Any] | None:
    """Wait for the next frame; None when there are no more."""
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    body = stream.read(length)
    return _decoded(body) if len(body) == length else None


class Unpacker:
    """Cuts frames out of bytes as they come."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[dict[str, Any]]:
        """Take bytes, give the frames that are whole now. Raises ValueError for what is none."""
        self._bytes += data
        while len(self._bytes) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._bytes)
            if length > FRAME_BYTES:
                raise ValueError(f"a frame of {length} bytes")
            end = _LENGTH.size + length
            if len(self._bytes) < end:
                return
            body = bytes(self._bytes[_LENGTH.size : end])
            del self._bytes[:end]
            yield _decoded(body)


def _decoded(body: bytes) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.msgpack.decode(body)
    return found
