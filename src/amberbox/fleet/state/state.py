"""What the server remembers of how robots are, beside its database."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.fleet.accounts.robots import list_robots
from amberbox.fleet.accounts.tables import ROBOTS
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.folders.folders import Folders
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.services.status import FEW, RobotStatuses
from amberbox.fleet.state.cards import Cards
from amberbox.fleet.state.facts import FactsBook
from amberbox.fleet.state.latest import Latest
from amberbox.fleet.state.said import status_data
from amberbox.fleet.state.standing import Moment, clock_offsets_ns, standings
from amberbox.fleet.state.views import Card


@dataclass(frozen=True, slots=True)
class Snapshot:
    """How robots are at one moment."""

    robots: Sequence[Card]
    statuses: Mapping[str, Sequence[Mapping[str, Any]]]


class State:
    """Newest missions and diagnoses, and what robots' folders say; threads may share it."""

    def __init__(
        self,
        database: Database,
        archive: FolderArchive,
        bus: Bus,
        links: LinkServer,
        folders: Folders,
        asking: Asking,
    ) -> None:
        self.database = database
        self.archive = archive
        self.latest = Latest()
        self.facts = FactsBook(folders, asking)
        self.statuses = RobotStatuses(links, self.latest)
        self.cards = Cards(self.statuses, self.facts)
        self._bus = bus
        bus.on("explained", self._explained)
        self._folders = folders
        self._wanted: asyncio.Queue[str] = asyncio.Queue()

    async def run(self) -> None:
        """Read the past of all robots, then of those that come, one after the other."""
        ends: list[Callable[[], None]] = [
            self._bus.on("rows", self._rows),
            self._bus.on("connected", self._robot),
            self._bus.on("robot", self._robot),
        ]
        try:
            for robot in await asyncio.to_thread(self._robots):
                self._wanted.put_nowait(robot)
            while True:
                robot = await self._wanted.get()
                await asyncio.to_thread(self._load, robot)
        finally:
            for end in ends:
                end()

    def snapshot(self, robots: Collection[str], now_ns: int, *, with_statuses: bool) -> Snapshot:
        """Return cards of robots, and their statuses."""
        with self.database.reading() as connection:
            known = [robot for robot in list_robots(connection) if robot.id in robots]
            few = sorted(robots) if len(robots) <= FEW else None
            found = standings(connection, few)
            cards = self.cards.of(connection, known, now_ns, found)
            offsets = clock_offsets_ns(connection, few)
        when = {robot: Moment(now_ns, offsets.get(robot)) for robot in robots}
        statuses = {
            robot: [
                {**status_data(one.said), "age_s": round(when[robot].age_ns(one) / NS, 2)}
                for one in found[robot]
            ]
            for robot in sorted(robots if with_statuses else ())
            if robot in found
        }
        return Snapshot(cards, statuses)

    def _rows(self, change: Change) -> None:
        self.latest.take(change.robot, change.data["rows"])

    def _explained(self, change: Change) -> None:
        """Note what a diagnosis that was put into words leaves of its robot."""
        answer = change.data["answer"]
        told = answer.get("explanation")
        if told and answer.get("id"):
            severity = told["use"]["severity"]
            self.latest.explain(change.robot, answer["id"], answer["revision"], severity)

    def _robot(self, change: Change) -> None:
        if change.robot:
            self._wanted.put_nowait(change.robot)

    def _robots(self) -> list[str]:
        with self.database.reading() as connection:
            return list(connection.execute(select(ROBOTS.c.robot)).scalars())

    def _load(self, robot: str) -> None:
        try:
            self.latest.load(self, robot)
            self.facts.read(robot, self._folders.current(robot))
        except AmberboxError as error:  # its card lacks something; the others do not
            logging.getLogger(__name__).warning("%s: %s", robot, error)
        except Exception:  # of a robot whose files are damaged, the same
            logging.getLogger(__name__).exception("the past of %s cannot be read", robot)
