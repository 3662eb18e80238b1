"""How many alarms each robot has open, how many of them are over, and how bad what lasts is."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, and_, select

from amberbox.fleet.alarms.alarm import rank_of
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
    """

    count: int = 0
    over: int = 0
    severity: str = ""


def open_alarms(connection: Connection) -> dict[str, OpenAlarms]:
    """Return the alarms by robot; an alarm about several robots counts for each."""
    lasts = and_(ALARM.c.active, ALARM_ROBOT.c.to_ns.is_(None)).label("lasts")
    wanted = (
        select(ALARM_ROBOT.c.robot, ALARM.c.severity, ALARM.c.state, lasts)
        .join(ALARM, ALARM.c.number == ALARM_ROBOT.c.alarm)
        .where(is_open() | and_(ALARM.c.state == "acknowledged", ALARM.c.merged_into.is_(None)))
    )
    found: dict[str, OpenAlarms] = {}
    for robot, severity, state, is_there in connection.execute(wanted):
        known = found.get(robot, OpenAlarms())
        found[robot] = _with(known, severity, is_open=state == "open", lasts=bool(is_there))
    return found


def _with(known: OpenAlarms, severity: str, *, is_open: bool, lasts: bool) -> OpenAlarms:
    worst = max(known.severity, severity, key=rank_of) if lasts else known.severity
    over = known.over + (is_open and not lasts)
    return OpenAlarms(known.count + is_open, over, worst)
