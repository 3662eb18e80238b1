"""What happens to alarms as time goes by: they are over, leave the shelf, and people are told."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final

from sqlalchemy import ColumnElement, Connection, and_, or_, select, update

from amberbox.core.clock import NS
from amberbox.fleet.accounts.tables import ROBOT_GROUPS
from amberbox.fleet.alarms import machine
from amberbox.fleet.alarms.alarm import Alarm, is_worse
from amberbox.fleet.alarms.register import Register
from amberbox.fleet.alarms.reports import Report
from amberbox.fleet.alarms.settings import AlarmSettings
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT, MARK
from amberbox.fleet.notifying import followups
from amberbox.fleet.notifying.outbox import Told, put
from amberbox.fleet.notifying.settings import NAME, Notifications
from amberbox.fleet.notifying.tables import CHANGED
from amberbox.fleet.options.options import read

_ASTRAY_NS: Final = 60 * NS
_RECENT_NS: Final = 3600 * NS
"""Alarms that were resolved in this time may still open again."""
_AT_ONCE: Final = 50
"""Alarms that are told in one transaction, the oldest first; the others a moment later."""


@dataclass(slots=True)
class Lateness:
    """When robots last told what had happened long before: until that ends, more may come."""

    until: dict[str, int] = field(default_factory=dict)

    def note(self, told: Iterable[Report], now_ns: int) -> None:
        """Note which robots speak of the past."""
        for report in told:
            if report.late:
                self.until[report.robot] = now_ns

    def move(self, step_ns: int) -> None:
        """Move all times by a step of the wall clock."""
        self.until = {robot: at_ns + step_ns for robot, at_ns in self.until.items()}


def move_times(connection: Connection, now_ns: int, step_ns: int) -> None:
    """Move what alarms wait for by a step of the wall clock: no time has passed by it.

    Until when an alarm is shelved is what a person chose, and stays.
    """
    moving = or_(ALARM.c.state != "resolved", ALARM.c.resolved_ns > now_ns - step_ns - _RECENT_NS)
    times = (ALARM.c.cleared_ns, ALARM.c.notify_ns, ALARM.c.resolved_ns)
    moved = {column.name: column + step_ns for column in times}  # NULL stays NULL
    connection.execute(update(ALARM).where(moving).values(moved))
    connection.execute(update(CHANGED).values(due_ns=CHANGED.c.due_ns + step_ns))
    ahead = update(MARK).where(MARK.c.received_ns > now_ns)
    connection.execute(ahead.values(received_ns=now_ns))


def is_due(connection: Connection, now_ns: int, settings: AlarmSettings) -> bool:
    """Tell whether something happens to an alarm by itself now."""
    over = and_(ALARM.c.state != "resolved", _is_over(now_ns, settings))
    chosen = select(ALARM.c.number).where(or_(over, _is_to_be_told(now_ns, settings))).limit(1)
    return connection.execute(chosen).first() is not None or followups.is_due(connection, now_ns)


def _is_over(now_ns: int, settings: AlarmSettings) -> ColumnElement[bool]:
    quiet_ns = now_ns - settings.ns("quiet_s")
    return or_(ALARM.c.cleared_ns <= quiet_ns, ALARM.c.shelved_until_ns <= now_ns)


def _is_to_be_told(now_ns: int, settings: AlarmSettings) -> ColumnElement[bool]:
    """Judge when people are to be told; what is too far off is of a clock that was wrong."""
    wrong_ns = now_ns + 2 * settings.ns("settle_s") + _ASTRAY_NS
    due = or_(ALARM.c.notify_ns <= now_ns, ALARM.c.notify_ns > wrong_ns)
    return and_(due, ALARM.c.state != "shelved")


def pass_time(
    register: Register, late: Lateness, now_ns: int, settings: AlarmSettings, url: str
) -> None:
    """Do what is due by now with all alarms."""
    for alarm in register.alarms(ALARM.c.state != "resolved", _is_over(now_ns, settings)):
        register.keep(alarm, machine.settled(alarm, now_ns, settings))
    for alarm in register.alarms(_is_to_be_told(now_ns, settings))[:_AT_ONCE]:
        _tell(register, late, alarm, now_ns, settings, url)
    if followups.is_due(register.connection, now_ns):
        setting = read(register.connection, NAME, Notifications)
        stays_ns = settings.ns("reopen_s")
        followups.follow_up(register.connection, register.alarm, now_ns, stays_ns, setting, url)


def _tell(
    register: Register,
    late: Lateness,
    alarm: Alarm,
    now_ns: int,
    settings: AlarmSettings,
    url: str,
) -> None:
    """Tell of an alarm, wait, or let it be: what was over before we heard of it is not news."""
    if alarm.late and alarm.active:
        ready_ns = late.until.get(alarm.robot, 0) + settings.ns("settle_s")
        if now_ns < ready_ns:
            register.keep(alarm, (replace(alarm, notify_ns=ready_ns), []))
            return
    old = alarm.late and not alarm.active
    if old or alarm.merged_into is not None or not is_worse(alarm.severity, alarm.told):
        register.keep(alarm, (replace(alarm, notify_ns=None), []))
        return
    setting = read(register.connection, NAME, Notifications)
    robots = _robots(register, alarm.number)
    sent = put(register.connection, Told(alarm, robots), now_ns, setting, url)
    untold = replace(alarm, notify_ns=None)
    register.keep(alarm, machine.told(alarm, now_ns) if sent else (untold, []))


def _robots(register: Register, number: int) -> dict[str, frozenset[str]]:
    """Return the robots of an alarm that are still concerned, with their groups."""
    of = select(ALARM_ROBOT.c.robot).where(
        ALARM_ROBOT.c.alarm == number, ALARM_ROBOT.c.to_ns.is_(None)
    )
    names = list(register.connection.execute(of).scalars())
    groups: dict[str, set[str]] = {name: set() for name in names}
    chosen = select(ROBOT_GROUPS.c.robot, ROBOT_GROUPS.c.group)
    for robot, group in register.connection.execute(chosen.where(ROBOT_GROUPS.c.robot.in_(names))):
        groups[robot].add(group)
    return {name: frozenset(found) for name, found in groups.items()}
