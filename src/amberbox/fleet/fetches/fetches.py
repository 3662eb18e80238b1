"""Asks robots for windows of their record as soon as they are connected, and sees what comes."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from amberbox.core.clock import Clock
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.fetches import ledger
from amberbox.fleet.fetches.ledger import Fetched, File
from amberbox.fleet.linkend.server import LinkServer
from amberbox.link.frames import Fetch

_LOOK_S = 60.0


class Fetches:
    """Sends what is waited for; what happened to it is in the database, nothing is in memory."""

    def __init__(self, database: Database, bus: Bus, clock: Clock, links: LinkServer) -> None:
        self._database = database
        self._bus = bus
        self._clock = clock
        self._links = links
        self._changes: asyncio.Queue[Change] = asyncio.Queue()
        for kind in ("connected", "has", "journal", "fetch"):
            bus.on(kind, self._hear)

    async def run(self) -> None:
        """Work until cancelled."""
        changes = self._changes = asyncio.Queue()
        await self._look()
        while True:
            try:
                async with asyncio.timeout(_LOOK_S):  # wait_for may swallow the end of the server
                    change = await changes.get()
            except TimeoutError:
                await self._look()
            else:
                await self._do(change)

    def close(self) -> None:
        """Nothing is held."""

    def _hear(self, change: Change) -> None:
        """Take a change, in the event loop; of those to fetches only the ones of people."""
        if change.kind != "fetch" or change.data.get("ask"):
            self._changes.put_nowait(change)

    async def _do(self, change: Change) -> None:
        if change.kind in ("connected", "fetch"):
            await self._send(change.robot)
        elif change.kind == "has":
            data = change.data
            files = [File(data["store_id"], name, size) for name, size in data["files"]]
            await asyncio.to_thread(self._answered, change.robot, data["id"], files)
        else:
            await asyncio.to_thread(self._arrived, change.robot)

    async def _look(self) -> None:
        """See to all robots: something may have been missed while nobody listened."""
        for robot in await asyncio.to_thread(self._robots):
            await asyncio.to_thread(self._arrived, robot)
            await self._send(robot)

    def _robots(self) -> Sequence[str]:
        with self._database.reading() as connection:
            return ledger.robots(connection)

    def _waiting(self, robot: str) -> Sequence[Fetched]:
        with self._database.reading() as connection:
            return ledger.waiting(connection, robot)

    async def _send(self, robot: str) -> None:
        """Ask a robot for all that is open, again with each connection: it may have forgotten."""
        if robot not in self._links.robots:
            return
        for one in await asyncio.to_thread(self._waiting, robot):
            frame = Fetch(one.id, one.item, one.from_ns, one.to_ns)
            if not await self._links.send(robot, frame):
                return
            await asyncio.to_thread(self._sent, one)

    def _sent(self, one: Fetched) -> None:
        with self._database.begin() as connection:
            changed = ledger.sent(connection, self._clock.wall_ns(), one)
        if changed:
            self._tell(one)

    def _answered(self, robot: str, fetch_id: str, files: Sequence[File]) -> None:
        with self._database.begin() as connection:
            one = ledger.find(connection, robot, fetch_id)
            now_ns = self._clock.wall_ns()
            changed = one and ledger.answered(connection, now_ns, one, files)
        if changed:
            self._tell(changed)

    def _arrived(self, robot: str) -> None:
        """See what has come of a robot; mostly nothing is waited for."""
        if not any(one.state == "copying" for one in self._waiting(robot)):
            return
        with self._database.begin() as connection:
            now_ns = self._clock.wall_ns()
            looked = [
                ledger.looked(connection, now_ns, one, one.files)
                for one in ledger.waiting(connection, robot)
                if one.state == "copying"
            ]
        for one in looked:
            if one is not None:
                self._tell(one)

    def _tell(self, one: Fetched) -> None:
        self._bus.publish(Change("fetch", one.robot, {"id": one.id}))
