"""A robot's way to the server, which can be cut: bytes go through it until somebody cuts it."""

from __future__ import annotations

import asyncio
import contextlib
import socket

_PIECE = 1 << 16


class Relay:
    """Passes connections on to a port of this machine; while it is cut, nobody gets through."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])
        self.is_cut = False
        self._is_used = False
        self._open: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None
        self._to = 0

    async def begin(self, port: int) -> None:
        """Begin to pass on to a port."""
        self._to = port
        self._server = await asyncio.start_server(self._pass_on, sock=self._socket)

    def was_used(self) -> bool:
        """Tell whether somebody came through."""
        return self._is_used

    def cut(self) -> None:
        """Cut the way: what is open ends at once, and nothing new gets through."""
        self.is_cut = True
        for writer in tuple(self._open):
            writer.transport.abort()

    def mend(self) -> None:
        """Let connections through again."""
        self.is_cut = False

    def close(self) -> None:
        """Let go of everything."""
        self.cut()
        if self._server is not None:
            self._server.close()
        self._socket.close()

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.is_cut:
            writer.transport.abort()
            return
        self._open.add(writer)
        self._is_used = True
        with contextlib.suppress(OSError):
            there = await asyncio.open_connection("127.0.0.1", self._to)
            self._open.add(there[1])
            try:
                await asyncio.gather(_copy(reader, there[1]), _copy(there[0], writer))
            finally:
                self._end(there[1])
        self._end(writer)

    def _end(self, writer: asyncio.StreamWriter) -> None:
        self._open.discard(writer)
        writer.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copy until one end is gone, and tell the other."""
    try:
        while piece := await reader.read(_PIECE):
            writer.write(piece)
            await writer.drain()
    finally:
        writer.close()
