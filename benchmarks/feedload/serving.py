"""A server in this process: what it takes is measured here, whoever listens."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import uvicorn

from amberbox.link.server_end import ServerEnd
from amberbox.server import process
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.app import make_app
from amberbox.server.config import ServerSettings
from amberbox.server.ingest.link_server import RobotConnection
from amberbox.server.services.context import Services
from benchmarks.feedload.fleet import ROBOTS


@contextmanager
def assembled(folder: Path, port: int) -> Iterator[Services]:
    """Put a server together whose robots are taken to be here."""
    settings = ServerSettings(f"http://localhost:{port}")
    services = process.make_services(folder, settings, None, Passwords(HashCost(1, 8, 1)))
    for name in (f"r{robot}" for robot in range(ROBOTS)):
        here = RobotConnection(
            name, _Nobody(), ServerEnd(name), time.time_ns(), last_received_s=math.inf
        )
        services.links.robots[name] = here
    try:
        yield services
    finally:
        process.close(services)


@asynccontextmanager
async def served(services: Services, port: int) -> AsyncIterator[None]:
    """Answer at a port."""
    config = uvicorn.Config(make_app(services), port=port, lifespan="off", log_level="critical",
                            ws="websockets-sansio", ws_per_message_deflate=False)  # fmt: skip
    server = uvicorn.Server(config)
    services.bus.attach(asyncio.get_running_loop())
    tasks = [asyncio.create_task(services.feed.run()), asyncio.create_task(server.serve())]
    while not server.started:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.5)
    try:
        yield
    finally:
        tasks[0].cancel()
        server.should_exit = server.force_exit = True
        await asyncio.gather(*tasks, return_exceptions=True)


class _Nobody:
    """The socket of a robot that is taken to be here."""

    async def receive(self) -> bytes:
        return b""

    async def send(self, data: bytes) -> None:
        return None

    async def close(self) -> None:
        return None
