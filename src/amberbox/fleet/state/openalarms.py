"""How many alarms each robot has open, how many of them are over, and how bad what lasts is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, Row, and_, select

from amberbox.core.robotstatus import Severity, highest, severity_rank
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT


def is_open() -> ColumnElement[bool]:
    """Fit the alarms that are counted as open: nobody has said anything about them yet.

    It is the one meaning of the number on all pages, and of the list that the number leads to.
    """
    return and_(ALARM.c.state == "open", ALARM.c.merged_into.is_(None))


@dataclass(frozen=True, slots=True)
class OpenAlarms:
    """Alarms of a robot that nobody has said anything about; ``over`` of them have stopped.

    ``severity`` is the highest of what lasts, acknowledged or not; empty where nothing does.
    ``lasting`` is the same of what its monitors found, ``reason`` what that alarm is about: an
    alarm that tells of its absence says nothing of how it is.
    """

    count: int = 0
    over: int = 0
    severity: Severity | Literal[""] = ""
    lasting: Severity | Literal[""] = ""
    reason: str = ""


def open_alarms(connection: Connection) -> dict[str, OpenAlarms]:
    """Return the alarms by robot; an alarm about several robots counts for each."""
    lasts = and_(ALARM.c.active, ALARM_ROBOT.c.to_ns.is_(None)).label("lasts")
    wanted = (
        select(ALARM_ROBOT.c.robot, ALARM.c.severity, ALARM.c.state, ALARM.c.kind,
               ALARM.c.origin, ALARM.c.reason, lasts)
        .join(ALARM, ALARM.c.number == ALARM_ROBOT.c.alarm)
        .where(is_open() | and_(ALARM.c.state == "acknowledged", ALARM.c.merged_into.is_(None)))
        .order_by(ALARM.c.number)
    )  # fmt: skip
    found: dict[str, OpenAlarms] = {}
    for row in connection.execute(wanted):
        found[row.robot] = _with(found.get(row.robot, OpenAlarms()), row)
    return found


def _with(known: OpenAlarms, row: Row[Any]) -> OpenAlarms:
    """Add an alarm to those of a robot."""
    is_new = row.state == "open"
    if not row.lasts:
        return replace(known, count=known.count + is_new, over=known.over + is_new)
    worst = highest((known.severity, row.severity))
    known = replace(known, count=known.count + is_new, severity=worst)
    if row.kind != "robot" or severity_rank(row.severity) <= severity_rank(known.lasting):
        return known
    return replace(known, lasting=row.severity, reason=f"{row.origin}: {row.reason}")
