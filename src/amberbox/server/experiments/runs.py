"""Runs of experiments and unit tests: their rows, and every change of one, saved as it is made.

A run is a state machine (``experiments.run``) in a row. Each change is one transaction that stores
its state together with what it asks of the robot, so that a server that is killed goes on where it
was, and asks nothing twice.
"""

from __future__ import annotations

import hashlib
import json
import logging
import secrets
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Protocol, TypeAlias, TypeVar

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.core.api import RunState
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Value
from amberbox.core.record_commands import IncidentMark, JournalRotate
from amberbox.core.version import __version__
from amberbox.experiments.procedure import Procedure
from amberbox.experiments.run import ExperimentRun
from amberbox.server import annotations as server_annotations
from amberbox.server import commands, record_orders
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase, upsert_rows
from amberbox.server.ingest.link_state import clock_offset_ns
from amberbox.server.schema import EXPERIMENT_RUN, RUN_CLOCK

RunKind: TypeAlias = Literal["experiment", "unit_test"]
# Runs that hold their robot, and those that are not over for good
HOLDING: Final[Sequence[RunState]] = ("running", "paused", "stopping")
OPEN: Final[Sequence[RunState]] = ("planned", *HOLDING, "judging")
# Largest number of repetitions of a run, and of planned runs of a robot
MOST_REPEATS: Final = 100
MOST_PLANNED: Final = 20

T = TypeVar("T")


class LostRunError(AmberboxError):
    """The experiment of a run, or the state that was kept of it, cannot be read any more."""


@dataclass(frozen=True, slots=True)
class StoredRun:
    """A run; times (ns) by the server's clock. ``left`` runs of its series are to follow.

    A robot carried it out alone if it is ``at_robot``.
    """

    number: int
    id: str
    robot: str
    kind: RunKind
    name: str
    title: str
    sha256: str
    state: RunState
    reason: str
    who: str
    parameters: Mapping[str, Any]
    series: str
    left: int
    diagnosis: str
    test: str
    config_hash: str
    versions: Mapping[str, str]
    created_ns: int
    begun_ns: int | None
    ended_ns: int | None
    report: str
    at_robot: bool


@dataclass(frozen=True, slots=True)
class RunOrder:
    """What somebody wants to run on a robot, and which test of a diagnosis its verdict answers."""

    robot: str
    kind: RunKind
    name: str
    title: str
    sha256: str
    parameters: Mapping[str, Any]
    who: str
    diagnosis: str = ""
    test: str = ""
    config_hash: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    repeats: int = 1


def new_run_id() -> str:
    """Return a random id for a run, which is also the name of its lease."""
    return f"r-{secrets.token_hex(8)}"


def command_id(run: str, task: str) -> str:
    """Return the id of the command for a step: the same whenever it is made."""
    return hashlib.sha256(f"amberbox run {run} {task}".encode()).hexdigest()[:32]


def find(connection: Connection, run_id: str) -> StoredRun | None:
    """Return a run; None if there is none of this id."""
    row = connection.execute(_chosen().where(EXPERIMENT_RUN.c.id == run_id)).one_or_none()
    return None if row is None else _stored(row)


def listed(
    connection: Connection, robots: Collection[str] | None = None, *,
    states: Sequence[RunState] = (), name: str = "", sha256: str = "", series: str = "",
    before: int = 0, limit: int = 100,
) -> list[StoredRun]:  # fmt: skip
    """Return runs, the newest first; of all robots with None."""
    c = EXPERIMENT_RUN.c
    chosen = _chosen().order_by(c.number.desc()).limit(limit)
    if robots is not None:
        chosen = chosen.where(c.robot.in_(robots))
    if states:
        chosen = chosen.where(c.state.in_(states))
    for column, value in ((c.name, name), (c.sha256, sha256), (c.series, series)):
        chosen = chosen.where(column == value) if value else chosen
    if before:
        chosen = chosen.where(c.number < before)
    return [_stored(row) for row in connection.execute(chosen)]


def holder_of(connection: Connection, robot: str) -> StoredRun | None:
    """Return the run that a robot is reserved for; None if it is free."""
    found = listed(connection, [robot], states=HOLDING, limit=1)
    return found[0] if found else None


def add(connection: Connection, now_ns: int, order: RunOrder, series: str = "") -> StoredRun:
    """Store a run that is planned; raises UsageError for one too many."""
    if not 1 <= order.repeats <= MOST_REPEATS:
        raise UsageError(f"a run is repeated {MOST_REPEATS} times at most", "choose fewer")
    c = EXPERIMENT_RUN.c
    waiting = select(func.count()).where(c.robot == order.robot, c.state == "planned")
    if (connection.scalar(waiting) or 0) >= MOST_PLANNED:
        what = f"{MOST_PLANNED} runs on {order.robot} wait for it"
        raise UsageError(what, "begin or abort some of them first")
    run_id = new_run_id()
    row = {
        "id": run_id, "robot": order.robot, "kind": order.kind, "name": order.name,
        "title": order.title, "sha256": order.sha256, "state": "planned", "reason": "",
        "who": order.who, "parameters": json.dumps(dict(order.parameters)),
        "series": series or run_id, "left": order.repeats - 1, "diagnosis": order.diagnosis,
        "test": order.test, "config_hash": order.config_hash,
        "versions": json.dumps(dict(order.versions)),
        "created_ns": now_ns, "kept": b"", "report": "", "at_robot": False,
    }  # fmt: skip
    connection.execute(EXPERIMENT_RUN.insert(), [row])
    found = find(connection, run_id)
    assert found is not None, "it was stored"
    return found


def abort_planned(connection: Connection, now_ns: int, run_id: str, reason: str) -> None:
    """End a run that has not begun."""
    changed = update(EXPERIMENT_RUN).where(EXPERIMENT_RUN.c.id == run_id)
    values = {"state": "aborted", "reason": reason, "ended_ns": now_ns}
    connection.execute(changed.where(EXPERIMENT_RUN.c.state == "planned").values(**values))


def judge(connection: Connection, run_id: str, state: RunState, reason: str, report: str) -> None:
    """Store the verdict of a run that was over; ``report`` is JSON."""
    changed = update(EXPERIMENT_RUN).where(EXPERIMENT_RUN.c.id == run_id)
    connection.execute(changed.values(state=state, reason=reason, report=report))


class ProcedureShelf(Protocol):
    """Keeps the experiments that runs carry out."""

    def procedure(self, run: StoredRun) -> Procedure:
        """Return what a run carries out; raises AmberboxError if it is not kept any more."""


class RunRegister:
    """The runs under way. ``change`` may be called in any thread, and is one transaction.

    ``live`` returns the newest value of an address of a robot, None if it is unknown.
    """

    def __init__(
        self,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        shelf: ProcedureShelf,
        live: Callable[[str, str], Value] = lambda robot, address: None,
    ) -> None:
        self._database = database
        self._bus = bus
        self._shelf = shelf
        self._clock = clock
        self._live = live
        with database.begin() as connection:
            self._base_ns = _base_ns(connection, clock)
        self._lock = threading.Lock()
        self._locks: dict[str, threading.RLock] = {}
        self._runs: dict[str, ExperimentRun] = {}

    def now_ns(self) -> int:
        """Return the time of runs: the wall clock's when the first began, without later steps."""
        return self._base_ns + self._clock.boot_ns()

    def step_ns(self) -> int:
        """Return how far the wall clock is ahead of the time of runs (ns)."""
        return self._clock.wall_ns() - self.now_ns()

    def begin(
        self, connection: Connection, stored: StoredRun, people: Mapping[str, str], who: str
    ) -> None:
        """Begin a planned run; raises UsageError if its robot is reserved for another one."""
        other = holder_of(connection, stored.robot)
        if other is not None:
            what = f"{stored.robot} is reserved by {other.who} for {other.title}"
            raise UsageError(what, "wait until that run is over, or abort it")
        self._base_ns = _base_ns(connection, self._clock)
        now_ns = self.now_ns()
        about = {
            "versions": {**stored.versions, "server": __version__},
            "config_hash": stored.config_hash, "series": stored.series,
        }  # fmt: skip
        run = ExperimentRun.begin(
            self._shelf.procedure(stored), stored.id, stored.robot, stored.parameters, people,
            now_ns, who=who, about=about, live=lambda address: self._live(stored.robot, address),
        )  # fmt: skip
        self._save(connection, stored, run, begun_ns=now_ns)

    def read(self, stored: StoredRun) -> ExperimentRun | None:
        """Return a run as it is stored, to be looked at only; None before it began."""
        with self._database.reading() as connection:
            return self._restored(connection, stored)

    def change(
        self, stored: StoredRun, work: Callable[[ExperimentRun, Connection, int], T]
    ) -> tuple[T, StoredRun]:
        """Change a run and save it; return the result of ``work``, and the run as it is now.

        ``work`` gets the time (ns). If it fails nothing has changed. Raises UsageError for a run
        that has not begun, LostRunError for one that cannot be read.
        """
        with self._lock:
            lock = self._locks.setdefault(stored.id, threading.RLock())
        with lock:
            try:
                with self._database.begin() as connection:
                    run = self._runs.get(stored.id) or self._restored(connection, stored)
                    if run is None:
                        raise UsageError("this run has not begun", "begin it first")
                    known = len(run.events)
                    result = work(run, connection, self.now_ns())
                    changed = self._save(connection, stored, run)
            except BaseException:
                self._runs.pop(stored.id, None)  # it may be half changed: the row is whole
                raise
            if run.is_closed:
                self._runs.pop(stored.id, None)
            else:
                self._runs[stored.id] = run
        if changed.state not in HOLDING:  # its record is to be kept at the robot
            self._bus.publish(ServerChange("command", stored.robot, {"ids": []}))
        if len(run.events) != known or changed.state != stored.state:
            self._bus.publish(ServerChange("run", stored.robot, {"id": stored.id}))
        return result, changed

    def give_up(self, stored: StoredRun, reason: str) -> StoredRun:
        """End a run whose state cannot be read or changed, and free its robot.

        What it has asked of the robot is withdrawn; who holds the robot's lease for it releases it,
        which stops what still runs.
        """
        with self._database.begin() as connection:
            wall_ns = self._clock.wall_ns()
            withdrawn = commands.withdraw(connection, wall_ns, stored.robot, stored.id, reason)
            c = EXPERIMENT_RUN.c
            ended = update(EXPERIMENT_RUN).where(c.id == stored.id, c.state.in_(HOLDING))
            connection.execute(ended.values(state="error", reason=reason, ended_ns=self.now_ns()))
            after = find(connection, stored.id)
        assert after is not None, "runs are never deleted"
        self._bus.publish(ServerChange("command", stored.robot, {"ids": withdrawn}))
        self._bus.publish(ServerChange("run", stored.robot, {"id": stored.id}))
        return after

    def _restored(self, connection: Connection, stored: StoredRun) -> ExperimentRun | None:
        chosen = select(EXPERIMENT_RUN.c.kept).where(EXPERIMENT_RUN.c.id == stored.id)
        kept = connection.execute(chosen).scalar_one()
        if not kept:
            return None
        try:
            return ExperimentRun.restore(
                self._shelf.procedure(stored), bytes(kept),
                lambda address: self._live(stored.robot, address),
            )  # fmt: skip
        except AmberboxError as error:
            what = f"the run cannot be read any more: {error.what}"
            raise LostRunError(what, "abort it and begin another") from error

    def _save(
        self, connection: Connection, stored: StoredRun, run: ExperimentRun, **more: Any
    ) -> StoredRun:
        found = find(connection, stored.id)
        assert found is not None, "runs are never deleted while they are under way"
        state = state_of(run, found)
        values = {"kept": run.state(), "state": state, **more}
        if state != found.state or run.outcome is not None:
            values["reason"] = "; ".join(run.reasons)
        if run.outcome is not None and found.ended_ns is None:
            values["ended_ns"] = run.events[-1].at_ns
        changed = update(EXPERIMENT_RUN).where(EXPERIMENT_RUN.c.id == stored.id)
        connection.execute(changed.values(**values))
        after = find(connection, stored.id)
        assert after is not None
        if run.is_closed and found.state in ("planned", *HOLDING):
            _keep_record(connection, self._clock.wall_ns(), after, self.step_ns())
        return after


def state_of(run: ExperimentRun, stored: StoredRun) -> RunState:
    """Return the state of a run by what it has come to."""
    if run.outcome is None:
        return "paused" if run.is_paused else "running"
    if not run.is_closed:
        return "stopping"
    if stored.state not in OPEN:
        return stored.state  # it was judged before
    return "judging" if run.outcome in ("passed", "failed") else run.outcome


class _Reached(msgspec.Struct):
    now_ns: int


def _base_ns(connection: Connection, clock: Clock) -> int:
    """Return the time of runs at this boot; made anew where no run is under way.

    After a reboot it goes on from the latest time of a run, at least.
    """
    c = EXPERIMENT_RUN.c
    kept = connection.scalars(select(c.kept).where(c.state.in_(HOLDING))).all()
    known = connection.execute(select(RUN_CLOCK)).one_or_none()
    if kept and known is not None and known.boot_id == clock.boot_id():
        return int(known.base_ns)
    base_ns = max([clock.wall_ns(), *_reached_ns(kept)]) - clock.boot_ns()
    row = {"one": 1, "boot_id": clock.boot_id(), "base_ns": base_ns}
    upsert_rows(connection, RUN_CLOCK, [row], ("boot_id", "base_ns"))
    return base_ns


def _reached_ns(kept: Sequence[bytes]) -> Iterator[int]:
    """Yield the times (ns) that runs have come to; a damaged one is given up later."""
    for state in kept:
        with suppress(msgspec.MsgspecError):
            yield msgspec.json.decode(state, type=_Reached).now_ns


def _keep_record(connection: Connection, now_ns: int, run: StoredRun, step_ns: int) -> None:
    """Keep the record of a run that is over: mark its time here and at the robot.

    The recorder begins new files, so that the present ones come soon. ``step_ns`` is how far the
    wall clock is ahead of the time of runs.
    """
    from_ns = (run.begun_ns or run.created_ns) + step_ns
    to_ns = (run.ended_ns or run.created_ns) + step_ns + NS
    reason = f"run {run.id}: {run.title}"[:1000]
    try:
        marked = server_annotations.mark(
            connection, now_ns, run.robot, (from_ns, to_ns), reason, run.who
        )
    except UsageError as error:  # too many are marked: the run ends all the same
        logging.getLogger(__name__).error("run %s is not marked: %s", run.id, error.what)
        return
    ahead_ns = clock_offset_ns(connection, run.robot) or 0
    who = record_orders.person_label(run.who)
    mark = IncidentMark(marked.id, from_ns - ahead_ns, to_ns - ahead_ns, who, reason)
    record_orders.order(connection, now_ns, run.robot, f"incident:{marked.id}", mark, who)
    record_orders.order(connection, now_ns, run.robot, "rotate", JournalRotate(), who)


def _chosen() -> Any:
    columns = [column for column in EXPERIMENT_RUN.c if column.name != "kept"]
    return select(*columns)


def _stored(row: Row[Any]) -> StoredRun:
    values = dict(row._mapping)
    decoded = {name: json.loads(values[name]) for name in ("parameters", "versions")}
    return StoredRun(**values | decoded)
