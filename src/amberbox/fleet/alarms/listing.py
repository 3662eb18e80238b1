"""Alarms as people ask for them: those that fit, and all that is known of one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, RowMapping, select

from amberbox.fleet.alarms.alarm import Alarm, State
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT, CONSEQUENCE, HISTORY
from amberbox.monitoring.engine.outputs import SEVERITIES
from amberbox.monitoring.plan import Severity

_MOST = 1_000


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which alarms; what is empty or None fits all. ``robots`` None are all that there are."""

    robots: frozenset[str] | None = None
    states: Collection[State] = ()
    least: Severity = "warning"
    since_ns: int | None = None
    after: int = 0
    limit: int = 100


def fitting(connection: Connection, wanted: Wanted) -> list[Alarm]:
    """Return alarms, the newest first; those that became part of another one are left out.

    ``after`` is the number of the last alarm of the page before.
    """
    where: list[ColumnElement[bool]] = [
        ALARM.c.merged_into.is_(None),
        ALARM.c.severity.in_(SEVERITIES[SEVERITIES.index(wanted.least) :]),
    ]
    if wanted.states:
        where.append(ALARM.c.state.in_(sorted(wanted.states)))
    if wanted.since_ns is not None:
        where.append(ALARM.c.changed_ns >= wanted.since_ns)
    if wanted.after:
        where.append(ALARM.c.number < wanted.after)
    if wanted.robots is not None:
        of = select(ALARM_ROBOT.c.alarm).where(ALARM_ROBOT.c.robot.in_(sorted(wanted.robots)))
        where.append(ALARM.c.number.in_(of))
    chosen = select(ALARM).where(*where).order_by(ALARM.c.number.desc()).limit(wanted.limit)
    return [Alarm(**row) for row in connection.execute(chosen).mappings()]


def robots_of(connection: Connection, numbers: Sequence[int]) -> dict[int, list[RowMapping]]:
    """Return which robots alarms are about: robot, from_ns, to_ns."""
    found: dict[int, list[RowMapping]] = {number: [] for number in numbers}
    chosen = select(ALARM_ROBOT).where(ALARM_ROBOT.c.alarm.in_(list(numbers)))
    for row in connection.execute(chosen.order_by(ALARM_ROBOT.c.robot)).mappings():
        found[row["alarm"]].append(row)
    return found


def consequences_of(connection: Connection, number: int) -> list[RowMapping]:
    """Return what suffers or suffered from the root of an alarm, the first first."""
    chosen = select(CONSEQUENCE).where(CONSEQUENCE.c.alarm == number)
    ordered = chosen.order_by(CONSEQUENCE.c.from_ns, CONSEQUENCE.c.component)
    return list(connection.execute(ordered).mappings())


def history_of(connection: Connection, number: int) -> list[RowMapping]:
    """Return what happened to an alarm, oldest first; of very much the newest."""
    chosen = select(HISTORY).where(HISTORY.c.alarm == number).order_by(HISTORY.c.number.desc())
    return list(connection.execute(chosen.limit(_MOST)).mappings())[::-1]
