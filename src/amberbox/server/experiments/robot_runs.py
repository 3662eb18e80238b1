"""Runs that robots carried out alone, from the events in their records; they are listed as others.

A run is entered when its end has come, once, and judged as those of the server are.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from amberbox.blackbox.journal import channels
from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.safe_text import one_line
from amberbox.experiments.run import RunEvent, state_of_events
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.derived import RecordStores, derived_records
from amberbox.server.experiments import runs
from amberbox.server.experiments.shelf import ExperimentShelf
from amberbox.server.live.records import clock_offsets_ns
from amberbox.server.schema import EXPERIMENT_RUN

# Largest number of events of a robot that are looked through for those of a run
_MOST: Final = 20_000
_NAME: Final = 128
_STATES: Final = {"passed": "judging", "failed": "judging"}


class EventRow(msgspec.Struct, frozen=True):
    """A record of the channel ``amberbox/experiment``."""

    run: str
    experiment: str
    number: int
    at_ns: Annotated[int, Meta(ge=0, le=2**62)]
    kind: str
    sha256: Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
    element: str = ""
    task: str = ""
    who: str = ""
    text: str = ""
    values: str = "{}"


class RobotRuns:
    """Enters runs of robots when their end arrives; a background service of the server."""

    def __init__(
        self, stores: RecordStores, bus: EventBus, clock: Clock, shelf: ExperimentShelf
    ) -> None:
        self._stores, self._bus, self._clock, self._shelf = stores, bus, clock, shelf

    async def run(self) -> None:
        """Enter runs until cancelled."""
        arrived: asyncio.Queue[tuple[str, str]] = asyncio.Queue()

        def look(change: ServerChange) -> None:
            for row in change.data["rows"]:
                if row.channel == channels.EXPERIMENT and (run := _ended(row.data)):
                    arrived.put_nowait((change.robot, run))

        end = self._bus.on("rows", look)
        try:
            while True:
                robot, run = await arrived.get()
                try:
                    run_id = await asyncio.to_thread(self.enter, robot, run)
                except AmberboxError as error:
                    text = "a run of %s at the robot is not entered: %s"
                    logging.getLogger(__name__).error(text, robot, error.what)
                else:
                    self._bus.publish(ServerChange("run", robot, {"id": run_id}))
        finally:
            end()

    def close(self) -> None:
        """Do nothing: everything is in the database."""

    def enter(self, robot: str, run: str) -> str:
        """Enter a run that is over, unless it is known; return its id here. Blocks.

        Raises UsageError where its events are not all here, or not those of a run.
        """
        rows = self._rows(robot, run)
        events = [_event(row) for row in rows]
        kept = state_of_events(events)
        over = next(event for event in events if event.kind == "over")
        begun, name = events[0], one_line(rows[0].experiment)[:_NAME]
        sha256, title = rows[0].sha256, one_line(begun.text)[:300]
        if not self._keep_files(robot, name, sha256):
            kept = b""
        outcome = over.values["outcome"]
        with self._stores.database.begin() as connection:
            ahead_ns = clock_offsets_ns(connection, [robot]).get(robot, 0)
            run_id = f"r-{hashlib.sha256(f'{robot} {run}'.encode()).hexdigest()[:16]}"
            row: dict[str, Any] = {
                "id": run_id, "robot": robot, "kind": "experiment", "name": name,
                "title": f"{title} (simulated)" if begun.values.get("simulated") else title,
                "sha256": sha256, "state": _STATES.get(outcome, outcome) if kept else outcome,
                "reason": one_line(over.text), "who": one_line(begun.who)[:_NAME],
                "parameters": json.dumps(begun.values.get("parameters") or {}),
                "series": run_id, "left": 0, "diagnosis": "", "test": "",
                "config_hash": str(begun.values.get("config_hash", ""))[:64],
                "versions": json.dumps(_versions(begun)), "created_ns": begun.at_ns + ahead_ns,
                "begun_ns": begun.at_ns + ahead_ns, "ended_ns": over.at_ns + ahead_ns,
                "kept": kept, "report": "", "at_robot": True,
            }  # fmt: skip
            if runs.find(connection, run_id) is None:
                connection.execute(EXPERIMENT_RUN.insert(), [row])
        return run_id

    def _rows(self, robot: str, run: str) -> Sequence[EventRow]:
        """Return the events of a run, in order, each once."""
        found = derived_records(
            self._stores, robot, channels.EXPERIMENT, limit=_MOST, newest=True
        )  # fmt: skip
        rows = {row.number: row for one in found for row in _read(one.values) if row.run == run}
        if not rows:
            raise UsageError("none of its events is here")
        return [rows[number] for number in sorted(rows)]

    def _keep_files(self, robot: str, name: str, sha256: str) -> bool:
        """Keep the experiment of a run, if the robot's folder still has it as it was."""
        for one in self._shelf.of_robot(robot):
            experiment = one.experiment
            if experiment is not None and (experiment.name, experiment.sha256) == (name, sha256):
                self._shelf.keep(experiment, "")
                return True
        return self._shelf.place(sha256).is_dir()


def _ended(data: bytes) -> str:
    """Return the run whose end a record is; empty for others."""
    try:
        row = msgspec.json.decode(data, type=EventRow)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):  # a robot wrote it
        return ""
    return row.run if row.kind == "over" else ""


def _read(values: object) -> Iterator[EventRow]:
    try:
        yield msgspec.convert(values, EventRow)
    except msgspec.MsgspecError:
        return


def _event(row: EventRow) -> RunEvent:
    about = {
        "number": row.number, "at_ns": row.at_ns, "kind": row.kind, "element": row.element,
        "task": row.task, "who": row.who, "text": row.text,
    }  # fmt: skip
    try:
        about["values"] = msgspec.json.decode(row.values)
        return msgspec.convert(about, RunEvent)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise UsageError(f"an event of it cannot be read: {error}") from error


def _versions(begun: RunEvent) -> dict[str, str]:
    found = begun.values.get("versions")
    known = found if isinstance(found, dict) else {}
    return {str(name)[:_NAME]: str(value)[:_NAME] for name, value in known.items()}
