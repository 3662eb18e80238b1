"""Annotations: missions, notes and incidents that people write down on the server."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.blackbox.retention.missions import FAILED, SUPERSEDED, MissionInstant, RecordedMission
from amberbox.core.errors import UsageError
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import INCIDENT, MISSION, MISSION_NOTE

# The mission id of an annotation of a moment alone; no mission has this id
NO_MISSION = ""
# Largest number of missions, incidents or annotations that people may add per robot
_MOST = 10_000


@dataclass(frozen=True, slots=True)
class MissionAnnotation:
    """A remark on a mission."""

    at_ns: int
    who: str
    text: str


@dataclass(frozen=True, slots=True)
class MomentAnnotation:
    """A remark on a moment; ``mission`` is ``NO_MISSION`` where it is on none."""

    number: int
    at_ns: int
    who: str
    text: str
    mission: str


@dataclass(frozen=True, slots=True)
class MarkedIncident:
    """An incident marked by a person."""

    id: str
    from_ns: int
    to_ns: int
    reason: str
    who: str
    made_ns: int
    released_ns: int | None


def missions(connection: Connection, robot: str) -> list[RecordedMission]:
    """Return the missions of a robot that people began on the server, in order of their start."""
    chosen = select(MISSION).where(MISSION.c.robot == robot)
    rows = connection.execute(chosen.order_by(MISSION.c.from_ns, MISSION.c.id))
    return [_mission(row) for row in rows]


def begin(
    connection: Connection, at_ns: int, robot: str, name: str, who: str,
    parameters: Mapping[str, Any],
) -> RecordedMission:  # fmt: skip
    """Begin a mission; end a running one of the same name that people began on the server.

    Raises UsageError when that one began later.
    """
    _refuse_too_many(connection, MISSION, robot)
    for mission in missions(connection, robot):
        if mission.name == name and mission.end is None:
            end(connection, at_ns, robot, mission.id, SUPERSEDED, failed=None)
    mission_id = f"{name[:44]}-{secrets.token_hex(6)}"
    row = {
        "robot": robot, "id": mission_id, "name": name, "from_ns": at_ns, "to_ns": None,
        "outcome": "", "failed": False, "who": who,
        "parameters": msgspec.json.encode(parameters).decode(),
    }  # fmt: skip
    connection.execute(MISSION.insert(), [row])
    return _found(connection, robot, mission_id)


def end(
    connection: Connection, at_ns: int, robot: str, mission_id: str, outcome: str,
    *, failed: bool | None,
) -> RecordedMission:  # fmt: skip
    """End a mission that people began on the server.

    Raises UsageError for an unknown id, a mission that has ended, or one that began later than
    ``at_ns``.
    """
    mission = _found(connection, robot, mission_id)
    if mission.end is not None:
        raise UsageError(f"the mission '{mission_id}' has ended already", "annotate it instead")
    if at_ns < mission.from_ns:
        raise UsageError(f"the mission '{mission_id}' began later than that", "choose another time")
    judged = outcome in FAILED if failed is None else failed
    changed = update(MISSION).where(MISSION.c.robot == robot, MISSION.c.id == mission_id)
    connection.execute(changed.values(to_ns=at_ns, outcome=outcome, failed=judged))
    return _found(connection, robot, mission_id)


def annotate(
    connection: Connection, now_ns: int, robot: str, mission_id: str, who: str, text: str
) -> MomentAnnotation:
    """Add an annotation to a mission (of people or of the robot) or to a moment."""
    _refuse_too_many(connection, MISSION_NOTE, robot)
    row = {"robot": robot, "mission": mission_id, "at_ns": now_ns, "who": who, "text": text}
    made = connection.execute(MISSION_NOTE.insert().returning(MISSION_NOTE.c.number), row)
    return MomentAnnotation(made.scalar_one(), now_ns, who, text, mission_id)


def moment_annotations(
    connection: Connection, robot: str, span: tuple[int | None, int | None], after: int | None,
    limit: int,
) -> list[MomentAnnotation]:  # fmt: skip
    """Return at most ``limit`` annotations in ``[from, to)``, newest first, older than number
    ``after``.
    """
    of, (from_ns, to_ns) = MISSION_NOTE.c, span
    chosen = select(MISSION_NOTE).where(of.robot == robot)
    if from_ns is not None:
        chosen = chosen.where(of.at_ns >= from_ns)
    if to_ns is not None:
        chosen = chosen.where(of.at_ns < to_ns)
    last_ns = connection.scalar(select(of.at_ns).where(of.robot == robot, of.number == after))
    if last_ns is not None:
        same = (of.at_ns == last_ns) & (of.number < after)
        chosen = chosen.where((of.at_ns < last_ns) | same)
    rows = connection.execute(chosen.order_by(of.at_ns.desc(), of.number.desc()).limit(limit))
    return [MomentAnnotation(row.number, row.at_ns, row.who, row.text, row.mission) for row in rows]


def mission_annotations(
    connection: Connection, robot: str, mission_ids: Sequence[str]
) -> dict[str, list[MissionAnnotation]]:
    """Return the annotations of missions by mission id, oldest first."""
    chosen = select(MISSION_NOTE).where(
        MISSION_NOTE.c.robot == robot, MISSION_NOTE.c.mission.in_(mission_ids)
    )
    found: dict[str, list[MissionAnnotation]] = {}
    for row in connection.execute(chosen.order_by(MISSION_NOTE.c.number)):
        found.setdefault(row.mission, []).append(MissionAnnotation(row.at_ns, row.who, row.text))
    return found


def incidents(connection: Connection, robot: str) -> list[MarkedIncident]:
    """Return the incidents of a robot that people marked on the server, in order of their
    windows.
    """
    chosen = select(INCIDENT).where(INCIDENT.c.robot == robot)
    rows = connection.execute(chosen.order_by(INCIDENT.c.from_ns, INCIDENT.c.id))
    return [
        MarkedIncident(r.id, r.from_ns, r.to_ns, r.reason, r.who, r.made_ns, r.released_ns)
        for r in rows
    ]


def mark(
    connection: Connection, now_ns: int, robot: str, span: tuple[int, int], reason: str, who: str
) -> MarkedIncident:
    """Mark a time window as an incident: its data are not deleted until it is released."""
    _refuse_too_many(connection, INCIDENT, robot)
    incident_id = f"server-{secrets.token_hex(8)}"
    row = {
        "robot": robot, "id": incident_id, "from_ns": span[0], "to_ns": span[1],
        "reason": reason, "who": who, "made_ns": now_ns,
    }  # fmt: skip
    connection.execute(INCIDENT.insert(), [row])
    return next(one for one in incidents(connection, robot) if one.id == incident_id)


def release(connection: Connection, now_ns: int, robot: str, incident_id: str) -> MarkedIncident:
    """Release a marked incident; raises UsageError for an unknown or released one."""
    found = next((one for one in incidents(connection, robot) if one.id == incident_id), None)
    if found is None:
        raise UsageError(
            f"nobody marked '{incident_id}' here",
            "the robot's own incidents are released on the robot",
        )
    if found.released_ns is not None:
        raise UsageError(f"the incident '{incident_id}' was released already")
    changed = update(INCIDENT).where(INCIDENT.c.robot == robot, INCIDENT.c.id == incident_id)
    connection.execute(changed.values(released_ns=now_ns))
    return next(one for one in incidents(connection, robot) if one.id == incident_id)


def pinned(database: ServerDatabase, robot: str) -> list[tuple[int, int]]:
    """Return the windows ``[from_ns, to_ns)`` of the marked incidents that are not released."""
    with database.reading() as connection:
        found = incidents(connection, robot)
    return [(one.from_ns, one.to_ns) for one in found if one.released_ns is None]


def _found(connection: Connection, robot: str, mission_id: str) -> RecordedMission:
    for mission in missions(connection, robot):
        if mission.id == mission_id:
            return mission
    raise UsageError(
        f"nobody began a mission '{mission_id}' here", "the robot ends its own missions"
    )


def _refuse_too_many(connection: Connection, table: Any, robot: str) -> None:
    counted = select(func.count()).select_from(table).where(table.c.robot == robot)
    if (connection.scalar(counted) or 0) >= _MOST:
        raise UsageError(f"there are {_MOST} of these for {robot} already")


def _mission(row: Row[Any]) -> RecordedMission:
    finish = None if row.to_ns is None else MissionInstant(row.to_ns)
    return RecordedMission(
        row.id, row.name, MissionInstant(row.from_ns), finish, row.outcome, row.failed, row.who,
        msgspec.json.decode(row.parameters),
    )  # fmt: skip
