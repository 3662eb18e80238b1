"""How many alarms nobody has said anything about yet: it stands at the top of every page."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import func, select

from amberbox.core.robotstatus import highest
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT
from amberbox.fleet.api.access import Caller
from amberbox.fleet.services import Services
from amberbox.fleet.state.openalarms import is_open


@dataclass(frozen=True, slots=True)
class OpenCount:
    """Open alarms of the robots that somebody may see, and the highest severity that lasts."""

    count: int = 0
    severity: str = ""


def open_count(fleet: Services, who: Caller) -> OpenCount:
    """Count the open alarms that somebody may see; none for who may see none at all."""
    every = who.principal.groups is None
    if every and not who.may("alarms.read"):
        return OpenCount()
    wanted = select(ALARM.c.severity, ALARM.c.active, func.count()).where(is_open())
    with fleet.database.reading() as connection:
        if not every:
            mine = [robot.id for robot in who.robots(connection, "alarms.read")]
            of = select(ALARM_ROBOT.c.alarm).where(ALARM_ROBOT.c.robot.in_(mine))
            wanted = wanted.where(ALARM.c.number.in_(of))
        rows = connection.execute(wanted.group_by(ALARM.c.severity, ALARM.c.active)).all()
    worst = highest(severity for severity, lasts, _ in rows if lasts)
    return OpenCount(sum(count for *_, count in rows), worst)
