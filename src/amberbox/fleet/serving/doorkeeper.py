"""Ends connections of robots whose key does not work any more."""

from __future__ import annotations

import asyncio
from collections.abc import Collection

from sqlalchemy import or_, select

from amberbox.core.clock import Clock
from amberbox.fleet.accounts.tables import ROBOT_KEYS, ROBOTS
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.linkend.sockets import Socket
from amberbox.link.frames import Bye

EVERY_S = 3.0
"""Keys also end by themselves, or by another process: so often all open ones are looked at."""


class KeyedSocket:
    """A robot's connection, and the key that it was opened with."""

    def __init__(self, socket: Socket, key_id: str) -> None:
        self._socket = socket
        self.key_id = key_id

    async def receive(self) -> bytes:
        """Wait for the next message; raises SocketClosedError at the end."""
        return await self._socket.receive()

    async def send(self, data: bytes) -> None:
        """Send a message; raises SocketClosedError when nobody is there any more."""
        await self._socket.send(data)

    async def close(self) -> None:
        """End the connection."""
        await self._socket.close()


class Doorkeeper:
    """Looks at the keys of all open connections, all at once, and right away when one changes."""

    def __init__(
        self,
        database: Database,
        bus: Bus,
        clock: Clock,
        links: LinkServer,
        every_s: float = EVERY_S,
    ) -> None:
        self._database = database
        self._clock = clock
        self._links = links
        self._every_s = every_s
        self._changed = asyncio.Event()
        bus.on("robot", self._hear)
        bus.on("account", self._hear)

    def _hear(self, _: Change) -> None:
        self._changed.set()

    async def run(self) -> None:
        """Look, and wait until a key has changed or it is time to look again."""
        while True:
            self._changed.clear()
            await self._look()
            try:
                async with asyncio.timeout(self._every_s):
                    await self._changed.wait()
            except TimeoutError:
                continue

    async def _look(self) -> None:
        open_ = {
            robot: one.socket.key_id
            for robot, one in self._links.robots.items()
            if isinstance(one.socket, KeyedSocket)
        }
        working = await asyncio.to_thread(self._working, set(open_.values())) if open_ else set()
        for robot in [robot for robot, key in open_.items() if key not in working]:
            await self._send_away(robot, open_[robot])

    async def _send_away(self, robot: str, key_id: str) -> None:
        one = self._links.robots.get(robot)
        if one is None or not isinstance(one.socket, KeyedSocket) or one.socket.key_id != key_id:
            return  # it has come again meanwhile, with another key
        one.end.closed = True
        await self._links.send(robot, Bye("this key does not work any more", for_good=True))
        await one.socket.close()

    def _working(self, keys: Collection[str]) -> set[str]:
        """Return which keys work now: one look for all of them."""
        now_ns = self._clock.wall_ns()
        joined = select(ROBOT_KEYS.c.key_id).join(ROBOTS, ROBOTS.c.robot == ROBOT_KEYS.c.robot)
        still = or_(ROBOT_KEYS.c.expires_ns.is_(None), ROBOT_KEYS.c.expires_ns > now_ns)
        wanted = joined.where(
            ROBOT_KEYS.c.revoked_ns.is_(None), still, ROBOTS.c.disabled_ns.is_(None)
        )
        with self._database.reading() as connection:
            return set(connection.execute(wanted).scalars()) & set(keys)

    def close(self) -> None:
        """Nothing is held."""
