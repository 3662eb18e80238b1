"""How many alarms each robot has open, and the highest severity of them."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select

from amberbox.fleet.alarms.alarm import rank_of
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT

_OPEN = ("open", "acknowledged")


@dataclass(frozen=True, slots=True)
class OpenAlarms:
    """Alarms that last and that nobody has shelved or resolved."""

    count: int = 0
    severity: str = ""


def open_alarms(connection: Connection) -> dict[str, OpenAlarms]:
    """Return the open alarms by robot; an alarm about several robots counts for each."""
    joined = select(ALARM_ROBOT.c.robot, ALARM.c.severity).join(
        ALARM, ALARM.c.number == ALARM_ROBOT.c.alarm
    )
    wanted = joined.where(
        ALARM.c.active, ALARM.c.state.in_(_OPEN), ALARM.c.merged_into.is_(None),
        ALARM_ROBOT.c.to_ns.is_(None),
    )  # fmt: skip
    found: dict[str, OpenAlarms] = {}
    for robot, severity in connection.execute(wanted):
        known = found.get(robot, OpenAlarms())
        found[robot] = OpenAlarms(known.count + 1, max(known.severity, severity, key=rank_of))
    return found
