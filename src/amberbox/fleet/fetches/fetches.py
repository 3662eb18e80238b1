"""Asks robots for windows of their record as soon as they are connected, and sees what comes.

A robot whose amberbox is older than the question what the server holds (``amberbox.link.holdings``)
never sends again what a restored server has lost: it takes it for copied. A window of such a robot
is given up when the robot was connected for ``ledger.IDLE_NS`` and nothing came.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import func, select

from amberbox.core.clock import Clock
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.fetches import ledger
from amberbox.fleet.fetches.ledger import Fetched, File
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.uploads import pieces
from amberbox.fleet.uploads.tables import UPLOAD
from amberbox.link.frames import Fetch

_LOOK_S = 60.0


@dataclass(frozen=True, slots=True)
class _Idle:
    """Since when (ns since boot) nothing of a connected robot came, nor was asked; what is held."""

    since_ns: int
    held: tuple[int, int, int]


class Fetches:
    """Sends what is waited for; what happened to it is in the database, nothing is in memory."""

    def __init__(
        self, folder: Path, database: Database, bus: Bus, clock: Clock, links: LinkServer
    ) -> None:
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock
        self._links = links
        self._changes: asyncio.Queue[Change] = asyncio.Queue()
        self._restoring: set[str] = set()  # robots that send again what the server lacks
        self._idle: dict[str, _Idle] = {}
        for kind in ("connected", "has", "journal", "fetch", "holdings"):
            bus.on(kind, self._hear)

    async def run(self) -> None:
        """Work until cancelled."""
        changes = self._changes = asyncio.Queue()
        loop, next_s = asyncio.get_running_loop(), 0.0
        while True:
            if loop.time() >= next_s:
                await self._look()
                next_s = loop.time() + _LOOK_S
            try:
                async with asyncio.timeout_at(next_s):  # wait_for may swallow the server's end
                    change = await changes.get()
            except TimeoutError:
                continue
            await self._do(change)

    def close(self) -> None:
        """Nothing is held."""

    def _hear(self, change: Change) -> None:
        """Take a change, in the event loop; of those to fetches only the ones of people."""
        if change.kind != "fetch" or change.data.get("ask"):
            self._changes.put_nowait(change)

    async def _do(self, change: Change) -> None:
        if change.kind == "holdings":
            self._restoring.add(change.robot)
        elif change.kind in ("connected", "fetch"):
            if change.kind == "connected":
                self._restoring.discard(change.robot)
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
            if await asyncio.to_thread(self._is_idle, robot):
                await asyncio.to_thread(self._give_up, robot)
            await self._send(robot)

    def _is_idle(self, robot: str) -> bool:
        """Tell whether a robot that may take things for copied has long sent nothing."""
        if robot in self._restoring or robot not in self._links.robots:
            self._idle.pop(robot, None)
            return False
        now_ns, held = self._clock.boot_ns(), self._held(robot)
        known = self._idle.get(robot)
        if known is None or known.held != held:
            self._idle[robot] = _Idle(now_ns, held)
            return False
        return now_ns - known.since_ns >= ledger.IDLE_NS

    def _held(self, robot: str) -> tuple[int, int, int]:
        """Count windows that are open, files that have come, and bytes of those that are coming."""
        with self._database.reading() as connection:
            chosen = select(func.count()).select_from(UPLOAD).where(UPLOAD.c.robot == robot)
            count = connection.scalar(chosen) or 0
            open_ones = len(ledger.waiting(connection, robot))
        coming = sum(path.stat().st_size for path in pieces.parts(self._folder, robot))
        return open_ones, count, coming

    def _give_up(self, robot: str) -> None:
        """Wait no longer for windows that the robot has answered long ago."""
        now_ns = self._clock.wall_ns()
        with self._database.begin() as connection:
            open_ones = ledger.waiting(connection, robot)
            ended = [
                ledger.give_up(connection, now_ns, one)
                for one in open_ones
                if one.state == "copying"
            ]
        self._idle.pop(robot, None)
        for one in ended:
            if one is not None:
                self._tell(one)

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
