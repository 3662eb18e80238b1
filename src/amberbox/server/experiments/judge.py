"""The verdict of runs that are over: their record is kept, awaited, and judged by its criteria."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Final, TypeAlias

import msgspec
from sqlalchemy import Connection

from amberbox.core.api import RunState
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.experiments.report import RunReport
from amberbox.server.bus import EventBus, Kind, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import ProcedureShelf, RunOrder, RunRegister, StoredRun
from amberbox.server.workers.pool import WorkerPool

REPORT: Final = "amberbox.server.experiments.worker:report"
# How long the record of a run is awaited; after it the run is undecided for good
PATIENCE_S: Final = 24 * 3600.0
# How often it is looked for where no journal comes
LOOK_S: Final = 10.0


# How long all of a record is awaited; after it the last second may be missing
WHOLE_S: Final = 60.0
# Gives an open diagnosis what a run with this verdict answers; raises AmberboxError
GiveAnswer: TypeAlias = Callable[[StoredRun, str], Awaitable[None]]


async def _no_answer(run: StoredRun, verdict: str) -> None:
    pass


class RunJudge:
    """Judges the runs that are over; a background service of the server."""

    def __init__(
        self,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        register: RunRegister,
        shelf: ProcedureShelf,
        workers: WorkerPool,
    ) -> None:
        self._database, self._bus, self._clock = database, bus, clock
        self._register, self._shelf, self._workers = register, shelf, workers
        self._since_ns: dict[str, int] = {}
        self.answer: GiveAnswer = _no_answer
        """Gives open diagnoses what a verdict answers."""

    async def run(self) -> None:
        """Judge until cancelled, whenever a run ends and whenever something of a record comes."""
        news = asyncio.Event()
        kinds: tuple[Kind, ...] = ("run", "journal", "committed")
        ends = [self._bus.on(kind, lambda _: news.set()) for kind in kinds]
        try:
            while True:
                news.clear()
                for stored in await asyncio.to_thread(self._waiting):
                    try:
                        await self._judge(stored)
                    except Exception:  # of this run; others are judged
                        logging.getLogger(__name__).exception("run %s is not judged", stored.id)
                try:
                    async with asyncio.timeout(LOOK_S):
                        await news.wait()
                except TimeoutError:
                    continue
        finally:
            for end in ends:
                end()

    def close(self) -> None:
        """Do nothing: everything is in the database."""

    def _waiting(self) -> list[StoredRun]:
        with self._database.reading() as connection:
            return runs.listed(connection, states=["judging"], limit=1000)

    async def _judge(self, stored: StoredRun) -> None:
        waited_s = self._waited_s(stored)
        late = waited_s > PATIENCE_S
        try:
            procedure = await asyncio.to_thread(self._shelf.procedure, stored)
            whole = bool(procedure.options.criteria) and not late
            asked = {
                "run": stored.id, "whole": whole, "step_ns": self._register.step_ns(),
                "late": waited_s > WHOLE_S,
            }  # fmt: skip
            data = await self._workers.ask(REPORT, asked)
        except AmberboxError as error:
            logging.getLogger(__name__).error("run %s is not judged: %s", stored.id, error.what)
            if not late:
                return
            data = b""
        if data or late:
            await self._answer(stored, data)
            await asyncio.to_thread(self._store, stored, data)
            self._since_ns.pop(stored.id, None)
            self._bus.publish(ServerChange("run", stored.robot, {"id": stored.id}))

    def _waited_s(self, stored: StoredRun) -> float:
        """Return for how long the record of a run is awaited by this process, in seconds."""
        boot_ns = self._clock.boot_ns()
        since_ns = self._since_ns.setdefault(stored.id, boot_ns)
        return (boot_ns - since_ns) / NS

    async def _answer(self, stored: StoredRun, data: bytes) -> None:
        verdict = _answers(stored, RunReport.from_json(data)) if data else ""
        if not verdict:
            return
        try:
            await self.answer(stored, verdict)
        except AmberboxError as error:  # its folder is not here: the verdict counts all the same
            logging.getLogger(__name__).error("run %s answers nothing: %s", stored.id, error.what)

    def _store(self, stored: StoredRun, data: bytes) -> None:
        """Store the verdict; begin the next run of the series."""
        report = RunReport.from_json(data) if data else None
        state: RunState = "undecided"
        reason = "its record has not come"
        kept = ""
        if report is not None and report.verdict is not None:
            state, reason = report.verdict, "; ".join(report.reasons)
            kept = msgspec.json.encode(
                {"verdict": report.verdict, "reasons": report.reasons, "criteria": report.criteria}
            ).decode()
        with self._database.begin() as connection:
            runs.judge(connection, stored.id, state, reason, kept)
            if stored.left:
                self._repeat(connection, stored)

    def _repeat(self, connection: Connection, stored: StoredRun) -> None:
        """Begin the next run of a series, with the people of the one before."""
        order = RunOrder(
            stored.robot, stored.kind, stored.name, stored.title, stored.sha256,
            stored.parameters, stored.who, stored.diagnosis, stored.test, stored.config_hash,
            stored.versions, stored.left,
        )  # fmt: skip
        try:
            following = runs.add(connection, self._clock.wall_ns(), order, stored.series)
            if runs.holder_of(connection, stored.robot) is None:
                people = {"technician": stored.who}
                self._register.begin(connection, following, people, stored.who)
        except AmberboxError as error:  # too many wait, or the experiment is not here any more
            logging.getLogger(__name__).error("run %s is not repeated: %s", stored.id, error.what)


def _answers(stored: StoredRun, report: RunReport) -> str:
    """Return the verdict that answers tests of a diagnosis; empty if it says nothing about them.

    A unit test that was refused, aborted or lost has failed as a run, but it has measured nothing.
    """
    if report.verdict not in ("passed", "failed") or stored.at_robot:  # it has answered there
        return ""
    if stored.kind == "experiment":
        return report.verdict
    results = [event.values.get("result", {}) for event in report.events if event.kind == "ended"]
    outcome = results[-1].get("outcome") if results else None
    return report.verdict if outcome == report.verdict else ""
