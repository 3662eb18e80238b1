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
from amberbox.core.notes import RecordedNote
from amberbox.core.record_commands import NoteWrite
from amberbox.server import record_orders
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import INCIDENT, MISSION, MISSION_NOTE

# Largest number of missions, incidents or annotations that people may add per robot
_MOST = 10_000


@dataclass(frozen=True, slots=True)
class StoredNote:
    """A note on a moment or a mission; ``number`` is its place among all of the server."""

    number: int
    note: RecordedNote


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


def annotate(connection: Connection, robot: str, note: RecordedNote) -> StoredNote:
    """Add a note to a mission (of people or of the robot) or to a moment.

    Raises UsageError when a robot has too many.
    """
    _refuse_too_many(connection, MISSION_NOTE, robot)
    row = {"robot": robot, "uid": note.id} | {name: getattr(note, name) for name in _NOTE_FIELDS}
    made = connection.execute(MISSION_NOTE.insert().returning(MISSION_NOTE.c.number), row)
    return StoredNote(made.scalar_one(), note)


def find_note(connection: Connection, robot: str, uid: str) -> StoredNote | None:
    """Return a note by the id that robot and server share; None if there is none."""
    chosen = select(MISSION_NOTE).where(MISSION_NOTE.c.robot == robot, MISSION_NOTE.c.uid == uid)
    row = connection.execute(chosen).first()
    return None if row is None else _stored(row)


def change_note(connection: Connection, robot: str, note: RecordedNote) -> None:
    """Store a later revision of a note; its times remain."""
    values = {name: getattr(note, name) for name in _CHANGED}
    chosen = update(MISSION_NOTE).where(
        MISSION_NOTE.c.robot == robot, MISSION_NOTE.c.uid == note.id
    )
    connection.execute(chosen.values(**values))


def take_note(connection: Connection, robot: str, note: RecordedNote) -> bool:
    """Take a note from a robot's record; return whether it is new here, or changed.

    The note of a command that comes back is no news, nor is an older revision.
    """
    about = note_matter(note.id)
    known = find_note(connection, robot, note.id)
    if known is not None and known.note.rank >= note.rank:
        sent = record_orders.find(connection, robot, about)
        if sent is not None and known.note.rank == note.rank:
            record_orders.see(connection, robot, about, sent.command)
        return False
    note = msgspec.structs.replace(note, who=f"{note.who or 'somebody'} at the robot"[:200])
    if known is not None:
        change_note(connection, robot, note)
    elif note.withdrawn:
        return False
    else:
        try:
            annotate(connection, robot, note)
        except UsageError:  # a robot that writes notes without end
            return False
    return True


def send_note(connection: Connection, now_ns: int, robot: str, note: RecordedNote) -> bool:
    """Let a robot write a note into its record, too; return whether a command was made.

    The caller publishes ``command`` for the robot after the transaction.
    """
    wanted = NoteWrite(**msgspec.structs.asdict(note))
    matter = note_matter(note.id)
    return record_orders.order(connection, now_ns, robot, matter, wanted, note.who)


def note_matter(uid: str) -> str:
    """Return the matter of the orders that concern a note."""
    return f"note:{uid}"


_NOTE_FIELDS = (
    "at_ns", "to_ns", "who", "text", "about", "mission", "revision", "withdrawn", "written_ns",
)  # fmt: skip
_CHANGED = ("who", "text", "revision", "withdrawn", "written_ns")


def _stored(row: Row[Any]) -> StoredNote:
    values = {name: getattr(row, name) for name in _NOTE_FIELDS}
    return StoredNote(row.number, RecordedNote(row.uid, **values))


def moment_annotations(
    connection: Connection, robot: str, span: tuple[int | None, int | None], after: int | None,
    limit: int,
) -> list[StoredNote]:  # fmt: skip
    """Return at most ``limit`` notes in ``[from, to)``, newest first, older than number ``after``.

    Those that are withdrawn are left out.
    """
    of, (from_ns, to_ns) = MISSION_NOTE.c, span
    chosen = select(MISSION_NOTE).where(of.robot == robot, of.withdrawn.is_(False))
    if from_ns is not None:
        chosen = chosen.where(func.coalesce(of.to_ns - 1, of.at_ns) >= from_ns)
    if to_ns is not None:
        chosen = chosen.where(of.at_ns < to_ns)
    last_ns = connection.scalar(select(of.at_ns).where(of.robot == robot, of.number == after))
    if last_ns is not None:
        same = (of.at_ns == last_ns) & (of.number < after)
        chosen = chosen.where((of.at_ns < last_ns) | same)
    rows = connection.execute(chosen.order_by(of.at_ns.desc(), of.number.desc()).limit(limit))
    return [_stored(row) for row in rows]


def mission_annotations(
    connection: Connection, robot: str, mission_ids: Sequence[str]
) -> dict[str, list[RecordedNote]]:
    """Return the notes on missions by mission id, oldest first."""
    of = MISSION_NOTE.c
    chosen = select(MISSION_NOTE).where(
        of.robot == robot, of.mission.in_(mission_ids), of.withdrawn.is_(False)
    )
    found: dict[str, list[RecordedNote]] = {}
    for row in connection.execute(chosen.order_by(of.number)):
        found.setdefault(row.mission, []).append(_stored(row).note)
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
