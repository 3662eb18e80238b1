"""The alarm manager: opens, updates and resolves alarms, and queues their notifications."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, and_, or_, select, update

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.notes import RecordedNote
from amberbox.server.alarms import lifecycle, outbox
from amberbox.server.alarms import reports as boxes
from amberbox.server.alarms.alarm import (
    NAME,
    Alarm,
    AlarmExplanation,
    AlarmSettings,
    explanation_of,
    is_worse,
)
from amberbox.server.alarms.grouping import apply_explanation, apply_reports
from amberbox.server.alarms.offline import (
    AbsenceTracker,
    absent_since_start,
    end_absences,
    open_offline_alarms,
)
from amberbox.server.alarms.outbox import AlarmNotice, NotificationSender, queue_alarm
from amberbox.server.alarms.recipients import NAME as NOTIFICATIONS
from amberbox.server.alarms.recipients import Notifications
from amberbox.server.alarms.reports import (
    AlarmReport,
    Inbox,
    InboxEntry,
    ReceivedRow,
    RobotConnected,
    RobotDisconnected,
    is_of_interest,
    reports,
)
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import ALARM, ALARM_ROBOT, CHANGED, MARK, ROBOT_GROUPS
from amberbox.server.settings import read

_ASTRAY_NS: Final = 60 * NS
_RECENT_NS: Final = 3600 * NS
"""An alarm that was resolved within this time may still be reopened."""
_AT_ONCE: Final = 50
"""Alarms notified in one transaction, the oldest first; the others a moment later."""


@dataclass(slots=True)
class LateReports:
    """When (ns) each robot last sent a late report: more may follow until it has caught up."""

    until: dict[str, int] = field(default_factory=dict)

    def note(self, reported: Iterable[AlarmReport], now_ns: int) -> None:
        """Note which robots sent late reports."""
        for report in reported:
            if report.late:
                self.until[report.robot] = now_ns

    def move(self, step_ns: int) -> None:
        """Shift all times by a step of the wall clock."""
        self.until = {robot: at_ns + step_ns for robot, at_ns in self.until.items()}


def move_times(connection: Connection, now_ns: int, step_ns: int) -> None:
    """Shift the due times of alarms by a step of the wall clock, so that waits keep their length.

    The end of shelving stays: a person chose it as wall time.
    """
    moving = or_(ALARM.c.state != "resolved", ALARM.c.resolved_ns > now_ns - step_ns - _RECENT_NS)
    times = (ALARM.c.cleared_ns, ALARM.c.notify_ns, ALARM.c.resolved_ns)
    moved = {column.name: column + step_ns for column in times}  # NULL stays NULL
    connection.execute(update(ALARM).where(moving).values(moved))
    connection.execute(update(CHANGED).values(due_ns=CHANGED.c.due_ns + step_ns))
    ahead = update(MARK).where(MARK.c.received_ns > now_ns)
    connection.execute(ahead.values(received_ns=now_ns))


def is_due(connection: Connection, now_ns: int, settings: AlarmSettings) -> bool:
    """Return whether an alarm has a change or a notification due now."""
    over = and_(ALARM.c.state != "resolved", _is_over(now_ns, settings))
    chosen = select(ALARM.c.number).where(or_(over, _is_due(now_ns, settings))).limit(1)
    return connection.execute(chosen).first() is not None or outbox.is_followup_due(
        connection, now_ns
    )


def _is_over(now_ns: int, settings: AlarmSettings) -> ColumnElement[bool]:
    quiet_ns = now_ns - settings.ns("quiet_s")
    return or_(ALARM.c.cleared_ns <= quiet_ns, ALARM.c.shelved_until_ns <= now_ns)


def _is_due(now_ns: int, settings: AlarmSettings) -> ColumnElement[bool]:
    """Return the condition for a due notification.

    A time too far ahead was set by a wrong clock and counts as due.
    """
    wrong_ns = now_ns + 2 * settings.ns("settle_s") + _ASTRAY_NS
    due = or_(ALARM.c.notify_ns <= now_ns, ALARM.c.notify_ns > wrong_ns)
    return and_(due, ALARM.c.state != "shelved")


def apply_due_changes(
    register: AlarmRegister, late: LateReports, now_ns: int, settings: AlarmSettings, url: str
) -> None:
    """Apply all changes and queue all notifications that are due now."""
    for alarm in register.alarms(ALARM.c.state != "resolved", _is_over(now_ns, settings)):
        register.keep(alarm, lifecycle.settled(alarm, now_ns, settings))
    for alarm in register.alarms(_is_due(now_ns, settings))[:_AT_ONCE]:
        _notify(register, late, alarm, now_ns, settings, url)
    if outbox.is_followup_due(register.connection, now_ns):
        setting = read(register.connection, NOTIFICATIONS, Notifications)
        stays_ns = settings.ns("reopen_s")
        outbox.follow_up(register.connection, register.alarm, now_ns, stays_ns, setting, url)


def _notify(
    register: AlarmRegister,
    late: LateReports,
    alarm: Alarm,
    now_ns: int,
    settings: AlarmSettings,
    url: str,
) -> None:
    """Queue the notification of an alarm, defer it, or drop it if the alarm was over on arrival."""
    if alarm.late and alarm.active:
        ready_ns = late.until.get(alarm.robot, 0) + settings.ns("settle_s")
        if now_ns < ready_ns:
            register.keep(alarm, (replace(alarm, notify_ns=ready_ns), []))
            return
    old = alarm.late and not alarm.active
    if old or alarm.merged_into is not None or not is_worse(alarm.severity, alarm.told):
        register.keep(alarm, (replace(alarm, notify_ns=None), []))
        return
    setting = read(register.connection, NOTIFICATIONS, Notifications)
    robots = _robots(register, alarm.number)
    sent = queue_alarm(register.connection, AlarmNotice(alarm, robots), now_ns, setting, url)
    unnotified = replace(alarm, notify_ns=None)
    register.keep(alarm, lifecycle.notified(alarm, now_ns) if sent else (unnotified, []))


def _robots(register: AlarmRegister, number: int) -> dict[str, frozenset[str]]:
    """Return the robots that an alarm still concerns, with their groups."""
    of = select(ALARM_ROBOT.c.robot).where(
        ALARM_ROBOT.c.alarm == number, ALARM_ROBOT.c.to_ns.is_(None)
    )
    names = list(register.connection.execute(of).scalars())
    groups: dict[str, set[str]] = {name: set() for name in names}
    chosen = select(ROBOT_GROUPS.c.robot, ROBOT_GROUPS.c.group)
    for robot, group in register.connection.execute(chosen.where(ROBOT_GROUPS.c.robot.in_(names))):
        groups[robot].add(group)
    return {name: frozenset(found) for name, found in groups.items()}


_TICK_S: Final = 1.0
_STEP_NS: Final = 2 * NS
"""A wall clock that is off by this much since the last step was set; a smaller difference is
slewing.
"""


class Alarms:
    """Opens and updates alarms from reports and connections of robots; ``step`` does the work.

    Entries are applied in transactions, so each is applied once even after a crash or an error.
    """

    def __init__(
        self, database: ServerDatabase, bus: EventBus, clock: Clock, public_url: str = ""
    ) -> None:
        self._database = database
        self._bus = bus
        self._clock = clock
        self._url = public_url
        self._made_ns = clock.wall_ns()
        self._base_ns = clock.wall_ns() - clock.boot_ns()
        self._inbox = Inbox()
        self._absence: AbsenceTracker | None = None
        self._late = LateReports()
        self._offsets: dict[tuple[str, str], int] = {}
        self._stepping = threading.Lock()
        self.sender = NotificationSender(database, clock)
        self._forget: list[Callable[[], None]] = [
            bus.on("rows", self._rows), bus.on("connected", self._connected),
            bus.on("gone", self._gone), bus.on("explained", self._explained),
        ]  # fmt: skip

    def _rows(self, change: ServerChange) -> None:
        now_ns = self._clock.wall_ns()
        for row in change.data["rows"]:
            if is_of_interest(row):
                self._inbox.put(ReceivedRow(change.robot, change.data["store_id"], row, now_ns))

    def _connected(self, change: ServerChange) -> None:
        hello: Any = change.data["hello"]
        now_ns = self._clock.wall_ns()
        self._inbox.put(RobotConnected(change.robot, hello.boot_id, now_ns - hello.wall_ns, now_ns))

    def _gone(self, change: ServerChange) -> None:
        self._inbox.put(RobotDisconnected(change.robot, self._clock.boot_ns()))

    def _explained(self, change: ServerChange) -> None:
        found = explanation_of(change.robot, change.data["answer"])
        if found is not None:
            self._inbox.put(found)

    async def run(self) -> None:
        """Call ``step`` and deliver notifications every second, until cancelled."""
        sending = asyncio.create_task(self._send())
        try:
            while True:
                await asyncio.to_thread(self.step)
                await asyncio.sleep(_TICK_S)
        finally:
            sending.cancel()

    async def _send(self) -> None:
        while True:
            try:
                await asyncio.to_thread(self.sender.step)
            except AmberboxError as error:
                logging.getLogger(__name__).error("the outbox waits: %s", error.what)
            except Exception:  # the messages stay in the outbox
                logging.getLogger(__name__).exception("the outbox could not be emptied")
            await asyncio.sleep(_TICK_S)

    def step(self) -> None:
        """Apply all new entries and due changes; publish the alarms that changed."""
        with self._stepping:
            self._follow_clock()
            changed = self._start() if self._absence is None else set()
            while news := self._inbox.next():
                changed |= self._taken(news)
                self._inbox.done(len(news))
            changed |= self._tick()
        for number, robot in sorted(self._robots(changed)):
            self._bus.publish(ServerChange("alarm", robot, {"id": number}))

    def _follow_clock(self) -> None:
        """Shift stored due times when the wall clock was set, so that waits keep their length."""
        boot_ns = self._clock.boot_ns()
        base_ns = self._clock.wall_ns() - boot_ns
        if self._clock.boot_ns() - boot_ns >= _STEP_NS / 2:
            return  # this thread was delayed between both readings: compare the next time
        step_ns = base_ns - self._base_ns
        if abs(step_ns) >= _STEP_NS:
            with self._database.begin() as connection:
                move_times(connection, self._clock.wall_ns(), step_ns)
            self._offsets = {of: ns + step_ns for of, ns in self._offsets.items()}
            self._late.move(step_ns)
        self._base_ns = base_ns

    def _start(self) -> set[int]:
        """Start with no robot counted as missing; apply the rows that arrived in the meantime."""
        with self._database.reading() as connection:
            absence = absent_since_start(AlarmRegister(connection), self._clock.boot_ns())
            left: list[InboxEntry] = list(boxes.missed_rows(connection, self._made_ns))
        self._absence = absence
        self._note_clocks(self._inbox.next())
        return self._taken(left) if left else set()

    def _taken(self, news: list[InboxEntry]) -> set[int]:
        """Apply entries; leave out and log those that fail, so that the others are applied.

        Raises AmberboxError when the database is busy: they are then applied later.
        """
        try:
            return self._take(news)
        except AmberboxError:
            raise
        except Exception:  # a defect, or an invalid report
            if len(news) > 1:
                return set[int]().union(*[self._taken([one]) for one in news])
            logging.getLogger(__name__).exception("this of %s is left out", news[0].robot)
            return set()

    def _take(self, news: list[InboxEntry]) -> set[int]:
        """Apply entries in one transaction; return the numbers of the changed alarms."""
        assert self._absence is not None
        now_ns = self._clock.wall_ns()
        rows = [one for one in news if isinstance(one, ReceivedRow)]
        back = {one.robot for one in news if isinstance(one, RobotConnected)}
        self._note_clocks(news)
        with self._database.begin() as connection:
            settings = read(connection, NAME, AlarmSettings)
            register = AlarmRegister(connection)
            known = boxes.offsets(connection, rows, self._offsets)
            found_reports = list(reports(rows, known, settings.ns("late_s")))
            apply_reports(register, found_reports, now_ns, settings)
            for one in news:
                if isinstance(one, AlarmExplanation):
                    apply_explanation(register, one, now_ns, settings)
            end_absences(register, back, now_ns)
            if rows:
                boxes.mark(connection, max(one.received_ns for one in rows))
        self._late.note(found_reports, now_ns)
        self._move(news)
        for robot in sorted(register.commanded):
            self._bus.publish(ServerChange("command", robot, {"ids": []}))
        for report in found_reports:
            if isinstance(report.content, RecordedAnswer):
                about = {"id": report.content.diagnosis}
                self._bus.publish(ServerChange("diagnosis", report.robot, about))
            elif isinstance(report.content, RecordedNote):
                self._bus.publish(ServerChange("robot", report.robot))
        return register.touched

    def _note_clocks(self, news: list[InboxEntry]) -> None:
        for one in news:
            if isinstance(one, RobotConnected):
                self._offsets[one.robot, one.boot_id] = one.offset_ns

    def _move(self, news: list[InboxEntry]) -> None:
        """Note which robots connected and disconnected, in order."""
        assert self._absence is not None
        for one in news:
            if isinstance(one, RobotConnected):
                self._absence.back(one.robot)
            elif isinstance(one, RobotDisconnected):
                self._absence.gone(one.robot, one.boot_ns)

    def _tick(self) -> set[int]:
        """Carry out the changes that are due; return the numbers of the changed alarms."""
        absence, now_ns = self._absence, self._clock.wall_ns()
        assert absence is not None
        with self._database.reading() as connection:
            settings = read(connection, NAME, AlarmSettings)
            waits = is_due(connection, now_ns, settings)
        if not waits and not absence.away.keys() - absence.settled:
            return set()
        before = set(absence.settled)
        try:
            with self._database.begin() as connection:
                register = AlarmRegister(connection)
                open_offline_alarms(register, absence, now_ns, self._clock.boot_ns(), settings)
                apply_due_changes(register, self._late, now_ns, settings, self._url)
        except BaseException:  # rolled back: decide again
            absence.settled = before
            raise
        return register.touched

    def _robots(self, numbers: set[int]) -> set[tuple[int, str]]:
        if not numbers:
            return set()
        with self._database.reading() as connection:
            register = AlarmRegister(connection)
            return {(n, alarm.robot) for n in numbers if (alarm := register.alarm(n)) is not None}

    def close(self) -> None:
        """Stop listening to the bus and close the sender."""
        for forget in self._forget:
            forget()
        with self._stepping:  # wait for a step under way
            self.sender.close()
