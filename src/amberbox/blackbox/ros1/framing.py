"""Cuts a TCPROS byte stream into messages: a length of 4 bytes, then the message."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable

from amberbox.blackbox.ros1.settings import MalformedError

BUFFER_BYTES = 256 << 10
LARGE_BYTES = 64 << 10
KEPT_BYTES = 16 << 20
FIRST_BYTES = 1 << 20
"""Memory for a large message at first; it doubles as its bytes arrive, whatever was announced."""

_length_at = struct.Struct("<I").unpack_from


class Framer:
    """Takes bytes as they come and gives whole messages.

    Small messages are sliced out of one buffer that is read into again and again; what is left
    of the last one is carried over. A message above ``LARGE_BYTES`` that is not complete yet is
    received in its own place, which grows with it and is used again for the next one.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._buffer = memoryview(bytearray(BUFFER_BYTES))
        self._rest = b""
        self._store = bytearray()
        self._large = memoryview(b"")
        self._size = 0
        self._filled = 0

    def room(self) -> memoryview:
        """Where to receive next."""
        return self._large[self._filled :] if self._large else self._buffer

    def received(self, count: int) -> list[bytes]:
        """Take the ``count`` bytes just put into ``room()``; return the messages they end."""
        if self._large:
            return self._fill(count)
        return self._cut(self._rest + self._buffer[:count])

    def _cut(self, data: bytes) -> list[bytes]:
        messages = []
        at, end, limit = 0, len(data), self._limit
        while end - at >= 4:
            size = _length_at(data, at)[0]
            if size > limit:
                text = f"message of {size} bytes announced, {limit} allowed"
                raise MalformedError(text, "store.queue and max_message_mb set how much")
            stop = at + 4 + size
            if stop > end:
                if size > LARGE_BYTES:
                    self._begin_large(size, data[at + 4 :])
                    at = end
                break
            messages.append(data[at + 4 : stop])
            at = stop
        self._rest = data[at:]
        return messages

    def _begin_large(self, size: int, first: bytes) -> None:
        if len(self._store) < min(size, FIRST_BYTES):
            self._store = bytearray(min(size, FIRST_BYTES))
        self._size = size
        self._large = memoryview(self._store)[:size]
        self._large[: len(first)] = first
        self._filled = len(first)

    def _fill(self, count: int) -> list[bytes]:
        self._filled += count
        if self._filled < len(self._large):
            return []
        if self._filled < self._size:
            self._grow()
            return []
        message = bytes(self._large)
        self._large = memoryview(b"")
        if len(self._store) > KEPT_BYTES:
            self._store = bytearray()
        return [message]

    def _grow(self) -> None:
        """Make as much room again as has been filled."""
        store = bytearray(min(self._size, 2 * self._filled))
        store[: self._filled] = self._large
        self._store = store
        self._large = memoryview(store)


class Reader:
    """Reads one connection to its end; ``last_ns`` is when something came last."""

    def __init__(self, sock: socket.socket, limit: int, now_ns: Callable[[], int]) -> None:
        self._sock = sock
        self._framer = Framer(limit)
        self._now_ns = now_ns
        self.last_ns = now_ns()
        self.has_read = False

    def run(self, deliver: Callable[[bytes, int], None]) -> None:
        """Deliver every message with its time of receipt until the peer ends the connection.

        Raises MalformedError or OSError.
        """
        framer, now_ns, receive = self._framer, self._now_ns, self._sock.recv_into
        while count := receive(framer.room()):
            self.last_ns = received_ns = now_ns()
            self.has_read = True
            for message in framer.received(count):
                deliver(message, received_ns)
