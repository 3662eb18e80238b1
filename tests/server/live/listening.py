"""A server's app on a loopback port, its running feed, and listeners."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import msgspec
import uvicorn
from websockets.asyncio.client import ClientConnection, connect

from amberbox.blackbox.journal import channels
from amberbox.link.frames import LinkRow
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import find_user
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import COOKIE
from amberbox.testing.clock import PATIENCE_S, until
from tests.server.house import URL, House


class Stage:
    """A house that can be listened to."""

    def __init__(self, home: House, port: int) -> None:
        self.home = home
        self.port = port
        self.seq = 0

    def session(self, name: str) -> str:
        """Sign a person in."""
        services = self.home.services
        with services.database.begin() as connection:
            user = find_user(connection, name)
            now_ns = self.home.clock.wall_ns()
            return begin_session(connection, now_ns, user.user_id, "192.0.2.1", "tests").secret

    def browser(self, name: str = "", origin: str | None = URL) -> connect:
        """Open a socket as a page does."""
        cookie = {"Cookie": f"{COOKIE}={self.session(name)}"} if name else {}
        return self.program({**cookie, **({"Origin": origin} if origin else {})})

    def program(self, headers: dict[str, str]) -> connect:
        """Open a socket with these headers."""
        address = f"ws://127.0.0.1:{self.port}/api/v1/feed"
        return connect(address, additional_headers=headers, compression=None, max_size=None)

    def say(self, robot: str, channel: str, **values: Any) -> None:
        """Let a record of a robot arrive."""
        self.seq += 1
        row = LinkRow("watch", 1, self.seq, channel, self.home.clock.wall_ns(),
                  msgspec.json.encode(values))  # fmt: skip
        told = {"store_id": "s", "rows": [row]}
        self.home.services.bus.publish(ServerChange("rows", robot, told))

    def status(self, robot: str, level: str = "ok", component: str = "laser", **more: Any) -> None:
        """Let a status of a robot arrive."""
        self.say(robot, channels.STATUS, component=component, level=level, **more)

    async def numbered(self) -> None:
        """Wait until every change so far has its number: those of statuses are gathered first."""
        await until(lambda: not self.home.services.feed._is_due, "statuses are gathered")


@asynccontextmanager
async def stage(home: House) -> AsyncIterator[Stage]:
    """Serve a house for the time of a scene."""
    config = uvicorn.Config(home.app, port=0, lifespan="off", log_level="critical",
                            ws="websockets-sansio", ws_per_message_deflate=False)  # fmt: skip
    server = uvicorn.Server(config)
    home.services.bus.attach(asyncio.get_running_loop())
    tasks = [asyncio.create_task(home.services.feed.run()), asyncio.create_task(server.serve())]
    try:
        while not server.started:
            await asyncio.sleep(0.005)
        feed, listeners = home.services.feed, home.services.bus._listeners
        await until(lambda: feed._rows in listeners.get("rows", ()), "the feed listens")
        yield Stage(home, server.servers[0].sockets[0].getsockname()[1])
    finally:
        tasks[0].cancel()
        server.should_exit = True
        with suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks)


async def hear(socket: ClientConnection, kind: str) -> dict[str, Any]:
    """Wait for a message of a kind; others are passed over."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            for message in json.loads(await socket.recv()):
                if message["kind"] == kind:
                    found: dict[str, Any] = message
                    return found


async def hear_up_to(
    socket: ClientConnection, is_last: Callable[[dict[str, Any]], bool]
) -> list[dict[str, Any]]:
    """Return all messages up to the last one; pings, which fill pauses, are left out."""
    found: list[dict[str, Any]] = []
    async with asyncio.timeout(PATIENCE_S):
        while not any(map(is_last, found)):
            found += [m for m in json.loads(await socket.recv()) if m["kind"] != "ping"]
    return found


def is_about(component: str, kind: str = "status") -> Callable[[dict[str, Any]], bool]:
    """Return what knows a message of a kind about a component."""
    return lambda message: (
        message["kind"] == kind and any(s["component"] == component for s in message["data"])
    )


async def ask(socket: ClientConnection, **asked: Any) -> None:
    """Send a subscription."""
    await socket.send(json.dumps(asked))
