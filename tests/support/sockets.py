"""A robot's connection to a link server without a network, for tests."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from amberbox.link.frames import RobotFrame, ServerFrame, encode, from_server
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkServer, SocketClosedError
from amberbox.testing.clock import PATIENCE_S


class FakeSocket:
    """The server's side of a connection, and what a test does at the robot's side."""

    def __init__(self) -> None:
        self.up: asyncio.Queue[bytes | None] = asyncio.Queue()
        self.down: asyncio.Queue[bytes] = asyncio.Queue()
        self.closed = False

    async def receive(self) -> bytes:
        """Wait for what the robot sends."""
        data = await self.up.get()
        if data is None:
            raise SocketClosedError
        return data

    async def send(self, data: bytes) -> None:
        """Send bytes to the robot."""
        if self.closed:
            raise SocketClosedError
        self.down.put_nowait(data)

    async def close(self) -> None:
        """End the connection, at either side."""
        self.closed = True
        self.up.put_nowait(None)

    def say(self, *frames: RobotFrame) -> None:
        """Send frames as the robot."""
        for frame in frames:
            self.up.put_nowait(encode(frame))

    async def hear(self) -> ServerFrame:
        """Wait for the next frame at the robot."""
        return from_server(await self.hear_bytes())

    async def hear_bytes(self) -> bytes:
        """Wait for the next bytes at the robot."""
        return await asyncio.wait_for(self.down.get(), PATIENCE_S)


@asynccontextmanager
async def serving_one(
    database: ServerDatabase, robot: str, **options: Any
) -> AsyncIterator[tuple[LinkServer, FakeSocket]]:
    """Serve one connection of a robot until the block is left."""
    link, socket = LinkServer(database, **options), FakeSocket()
    task = asyncio.create_task(link.serve(socket, robot))
    try:
        yield link, socket
    finally:
        await socket.close()
        await asyncio.wait_for(task, PATIENCE_S)
        await asyncio.to_thread(link.close)
