"""A server's alarms without a network: reports of robots, time moved by hand, notifications."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import event, select

from amberbox.core.clock import NS
from amberbox.core.robot_status import Severity
from amberbox.core.types import Diagnosis, Hypothesis, Level
from amberbox.link.frames import Hello, JournalPosition, LinkRow, RunEnd, WriterReach
from amberbox.link.ledger import LinkAdmission
from amberbox.monitoring.findings import (
    AlarmChange,
    AlarmState,
    Finding,
    HealthState,
    Transition,
    encoded,
)
from amberbox.server.accounts.robots import add_group, add_robot
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.alarms.manager import Alarms
from amberbox.server.alarms.outbox import NotificationMessage
from amberbox.server.alarms.recipients import NAME, Destination, Notifications, Webhook
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.ingest import ledger
from amberbox.server.ingest.link_state import short_boot_id
from amberbox.server.schema import ALARM, CONSEQUENCE, HISTORY, OUTBOX
from amberbox.server.settings import write
from amberbox.testing.clock import ManualClock
from tests.server.database.portable import portable_database

START_NS = 1_800_000_000 * NS
STORE = "12345678-1234-1234-1234-123456789012"
BOOT = "9c2e4f10-1111-4000-8000-000000000001"
EARLIER = "0badb007-1111-4000-8000-000000000002"
EVERYTHING = Notifications(webhooks=(Webhook("hook", "https://hook.example/", "0123456789abcdef"),))


def reaches(boot: str) -> dict[str, WriterReach]:
    """Return a robot's statement of a run: its boot as in the names of journals."""
    run = RunEnd(1, short_boot_id(boot), 1_000_000, closed=False)
    return {
        "watch": WriterReach(
            JournalPosition(1, 0),
            JournalPosition(1, 1_000_000),
            JournalPosition(1, 1_000_000),
            (run,),
        )
    }


@dataclass
class Stand:
    """Alarms of a server, and the notifications sent."""

    database: ServerDatabase
    clock: ManualClock
    bus: EventBus = field(default_factory=EventBus)
    told: list[tuple[str, NotificationMessage]] = field(default_factory=list)
    trouble: str = ""
    published: list[int] = field(default_factory=list)
    epochs: dict[str, int] = field(default_factory=dict)
    places: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.bus.on("alarm", lambda change: self.published.append(change.data["id"]))
        self.alarms = self._made()

    def _made(self) -> Alarms:
        alarms = Alarms(self.database, self.bus, self.clock, "https://fleet.example")
        alarms.sender.deliver = self._deliver
        return alarms

    def _deliver(
        self, to: Destination, message: NotificationMessage, _: Notifications, __: int
    ) -> str:
        if not self.trouble:
            self.told.append((to.name, message))
        return self.trouble

    def restart(self) -> None:
        """Stop the server, without its having had a chance to do anything, and start it again."""
        self.alarms.close()
        self.alarms = self._made()

    def set(self, name: str, value: object) -> None:
        """Change a setting."""
        with self.database.begin() as connection:
            write(connection, self.clock.wall_ns(), name, value)

    def add(self, robots: Iterable[str], groups: Iterable[str] = ()) -> None:
        """Make robots known."""
        with self.database.begin() as connection:
            for robot in robots:
                add_robot(connection, self.clock.wall_ns(), robot, groups)

    def group(self, name: str) -> None:
        """Make a group known."""
        with self.database.begin() as connection:
            add_group(connection, self.clock.wall_ns(), name)

    def connect(self, *robots: str, behind_s: float = 0.0, boot: str = BOOT) -> None:
        """Let robots connect; their clocks are so far behind."""
        for robot in robots:
            wall_ns = self.clock.wall_ns() - round(behind_s * NS)
            hello = Hello(robot, STORE, boot, reaches(boot), "hash", wall_ns, 0, "1.0")
            with self.database.begin() as connection:
                admission: LinkAdmission = ledger.admit(connection, hello, self.clock.wall_ns())
            self.epochs[robot] = admission.epoch
            told = {"hello": hello, "admission": admission}
            self.bus.publish(ServerChange("connected", robot, told))

    def lose(self, *robots: str) -> None:
        """End the connections to robots."""
        for robot in robots:
            self.bus.publish(ServerChange("gone", robot))

    def rows(self, robot: str, found: Iterable[Finding], at_ns: int | None = None) -> list[LinkRow]:
        """Make rows of what the watcher of a robot finds, written at a time by its clock."""
        made = []
        for finding in found:
            channel, data = encoded(finding)
            seq = self.places[robot] = self.places.get(robot, 0) + 1
            log_ns = self.clock.wall_ns() if at_ns is None else at_ns
            made.append(LinkRow("watch", 1, seq, channel, log_ns, data))
        return made

    def send(self, robot: str, rows: list[LinkRow], *, heard: bool = True) -> None:
        """Store rows of a robot; without ``heard`` the server dies directly after storing them."""
        with self.database.begin() as connection:
            batch = ledger.RowBatch(
                robot, self.epochs[robot], STORE, rows, {}, {}, self.clock.wall_ns()
            )
            stored = batch(connection)
        if heard and stored.new:
            told = {"store_id": STORE, "rows": stored.new}
            self.bus.publish(ServerChange("rows", robot, told))

    def say(self, robot: str, *found: Finding) -> None:
        """Store findings of a robot written now, and notify the server of them."""
        self.send(robot, self.rows(robot, found))
        self.alarms.step()

    def hear(self, robot: str, *found: Finding) -> None:
        """Notify the alarms of findings of a robot, without storing them; they are
        processed next.
        """
        told = {"store_id": STORE, "rows": self.rows(robot, found)}
        self.bus.publish(ServerChange("rows", robot, told))

    def wait(self, seconds: float, step_s: float = 0.0) -> None:
        """Let time pass, also for the server, which runs its step a dozen times or every second."""
        step_s = step_s or max(1.0, seconds / 12)
        end_ns = self.clock.wall_ns() + round(seconds * NS)
        while self.clock.wall_ns() < end_ns:
            self.clock.advance(min(step_s, (end_ns - self.clock.wall_ns()) / NS))
            self.alarms.step()
            self.alarms.sender.step()

    def found(self) -> list[Alarm]:
        """Return the alarms there are, but for those that are part of others."""
        with self.database.reading() as connection:
            return AlarmRegister(connection).alarms(ALARM.c.merged_into.is_(None))

    def only(self) -> Alarm:
        """Return the one alarm there is."""
        (alarm,) = self.found()
        return alarm

    def history(self, number: int) -> list[str]:
        """Return what happened to an alarm, in words."""
        chosen = select(HISTORY.c.what).where(HISTORY.c.alarm == number).order_by(HISTORY.c.number)
        with self.database.reading() as connection:
            return list(connection.execute(chosen).scalars())

    def suffering(self, number: int) -> dict[str, bool]:
        """Return which components suffer (True) or suffered (False) from an alarm's root."""
        chosen = select(CONSEQUENCE).where(CONSEQUENCE.c.alarm == number)
        with self.database.reading() as connection:
            return {r.component: r.to_ns is None for r in connection.execute(chosen)}

    def outbox(self) -> list[dict[str, Any]]:
        """Return all messages."""
        with self.database.reading() as connection:
            rows = connection.execute(select(OUTBOX).order_by(OUTBOX.c.number)).mappings()
            return [dict(row) for row in rows]


@contextmanager
def stand(folder: Path, *, portable: bool = False) -> Iterator[Stand]:
    """Yield a bench for the duration of a test; one destination receives all notifications.

    With ``portable`` every statement is also compiled for PostgreSQL, which takes time.
    """
    clock = ManualClock(START_NS)
    opened = portable_database if portable else _database
    with opened(folder, clock) as database:
        event.listen(database.engine, "connect", _hurry)
        database.engine.dispose()
        one = Stand(database, clock)
        one.set(NAME, EVERYTHING)
        one.add(["r1"])
        one.connect("r1")
        yield one
        one.alarms.close()


@contextmanager
def _database(folder: Path, clock: ManualClock) -> Iterator[ServerDatabase]:
    database = ServerDatabase(folder / FILE, clock)
    try:
        yield database
    finally:
        database.close()


def _hurry(connection: Any, _record: object) -> None:
    """Wait for no disk: what a power cut does to a database is tested elsewhere."""
    connection.execute("PRAGMA synchronous=OFF").close()


def alarm(
    stand: Stand,
    component: str = "laser",
    state: AlarmState = "open",
    *,
    source: str = "",
    severity: Severity = "urgent",
    level: Level = "error",
    reason: str = "it does not work",
    count: int = 1,
    opened_ns: int | None = None,
    changed_ns: int | None = None,
    cause: str = "",
    diagnosis: str = "",
) -> AlarmChange:
    """Make a robot's report of an alarm of its own."""
    now_ns = stand.clock.wall_ns()
    opened = now_ns if opened_ns is None else opened_ns
    changed = now_ns if changed_ns is None else changed_ns
    return AlarmChange(
        "r1", source or f"{component}-1", component, severity, state, level, reason, opened,
        changed, count, "", None, "hash", cause=cause, diagnosis=diagnosis,
    )  # fmt: skip


def explained(stand: Stand, component: str = "laser", cause: str = "laser#x") -> AlarmChange:
    """Make a robot's report of an alarm of its own that a diagnosis explains."""
    return alarm(stand, component, cause=cause, diagnosis="d1")


def diagnosis(stand: Stand, *faults: str, share: float = 0.9, revision: int = 1) -> Diagnosis:
    """Make a diagnosis with one answer, which names these failure modes."""
    answer = Hypothesis("h1", frozenset(faults), share)
    return Diagnosis("d1", revision, "r1", stand.clock.wall_ns(), "hash", (answer,), share)


def blocked(stand: Stand, component: str, *by: str, level: Level = "error") -> Transition:
    """Make the transition of a component that is blocked by others."""
    before, after = HealthState("ok", "nominal"), HealthState(level, "working")
    return Transition(
        "r1", component, "", before, after, stand.clock.wall_ns(), "no data", by, "", "hash"
    )


def described(message: NotificationMessage) -> dict[str, Any]:
    """Return the fields of a message to a program."""
    return dict(json.loads(json.dumps(message.data)))
