"""Missions: those that robots told of, and those that people begin, end and annotate here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import msgspec
from fastapi import HTTPException, Path, Query
from pydantic import Field
from sqlalchemy import Connection

from amberbox.blackbox.missions.mission import Mission as Known
from amberbox.blackbox.missions.mission import choose
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form, Id, Limit, shown
from amberbox.fleet.api.windows import FROM, From, Shown, To, span_in, time_in
from amberbox.fleet.bus import Change
from amberbox.fleet.data import WORKER, remarks
from amberbox.fleet.services import Services

routes = Routes("missions")

_PARAMETERS_BYTES = 8192
MissionId = Annotated[str, Path(min_length=1, max_length=200)]
At = Annotated[str, Field(max_length=64, description="when it was; empty: now")]
Origin = Literal["robot", "server"]


class Note(Shown):
    """A remark of somebody."""

    at: str
    who: str
    text: str


class Mission(Shown):
    """A mission; ``to`` is null while it lasts, ``origin`` says who began it."""

    id: str
    name: str
    origin: Origin
    from_: str = FROM
    to: str | None
    outcome: str
    failed: bool
    who: str
    parameters: dict[str, Any]
    notes: list[Note]


class NewMission(Form):
    """A mission that begins now, or began at some time; parameters are for whoever reads it."""

    name: Id
    at: At = ""
    parameters: Annotated[dict[str, Any], Field(max_length=100, default_factory=dict)]


class EndMission(Form):
    """How it ended; ``failed`` follows from the outcome where nothing is said."""

    outcome: Annotated[str, Field(pattern=r"^[a-z0-9_.-]{0,64}$")] = "done"
    failed: bool | None = None
    at: At = ""


class NewNote(Form):
    """A remark on a mission, on a moment of it or on now."""

    text: Annotated[str, Field(min_length=1, max_length=4000)]
    at: At = ""


@routes.get("/robots/{robot}/missions", "missions.read")
def list_missions(
    fleet: Fleet, who: Who, robot: OfRobot,
    name: Annotated[str, Query(max_length=64, description="of this name only")] = "",
    failed: Annotated[bool, Query(description="failed ones only")] = False,
    from_: From = "", to: To = "", limit: Limit = 100,
    after: Annotated[str, Query(max_length=200, description="the last id of the page before")] = "",
) -> list[Mission]:  # fmt: skip
    """List the missions of a robot that meet a range of time, newest first."""
    span = span_in(fleet, robot.id, from_, to)
    known = _missions(fleet, who, robot.id)
    found = choose(known, name or None, failed=failed, span=span)[::-1]
    ids = [mission.id for mission in found]
    start = ids.index(after) + 1 if after in ids else 0
    with fleet.database.reading() as connection:
        return _shown(connection, robot.id, found[start : start + limit])


@routes.get("/robots/{robot}/missions/{id}", "missions.read")
def read_mission(fleet: Fleet, who: Who, robot: OfRobot, id: MissionId) -> Mission:
    """Return a mission with what people remarked on it."""
    mission = _find(fleet, who, robot.id, id)
    with fleet.database.reading() as connection:
        return _shown(connection, robot.id, [mission])[0]


@routes.post("/robots/{robot}/missions", "missions.write", status_code=201)
def begin_mission(fleet: Fleet, who: Who, robot: OfRobot, new: NewMission) -> Mission:
    """Begin a mission; one of the same name that was begun here and still lasts ends."""
    if len(msgspec.json.encode(new.parameters)) > _PARAMETERS_BYTES:
        raise UsageError(f"parameters are longer than {_PARAMETERS_BYTES} bytes")
    now_ns = fleet.clock.wall_ns()
    at_ns = _at(fleet, robot.id, new.at)
    with fleet.database.begin() as connection:
        begun = remarks.begin(
            connection, at_ns, robot.id, new.name, str(who.principal), new.parameters
        )
        details = {"id": begun.id, "at": format_time(at_ns)}
        who.note(connection, now_ns, "missions.begin", robot.id, details=details)
        found = _shown(connection, robot.id, [begun])[0]
    _tell(fleet, robot.id)
    return found


@routes.post("/robots/{robot}/missions/{id}/end", "missions.write")
def end_mission(fleet: Fleet, who: Who, robot: OfRobot, id: MissionId, how: EndMission) -> Mission:
    """End a mission that was begun here; a robot's own mission ends there."""
    at_ns = _at(fleet, robot.id, how.at)
    with fleet.database.begin() as connection:
        ended = remarks.end(connection, at_ns, robot.id, id, how.outcome, failed=how.failed)
        details = {"id": id, "outcome": how.outcome, "at": format_time(at_ns)}
        who.note(connection, fleet.clock.wall_ns(), "missions.end", robot.id, details=details)
        found = _shown(connection, robot.id, [ended])[0]
    _tell(fleet, robot.id)
    return found


@routes.post("/robots/{robot}/missions/{id}/notes", "missions.write", status_code=201)
def annotate_mission(
    fleet: Fleet, who: Who, robot: OfRobot, id: MissionId, new: NewNote
) -> Mission:
    """Remark something on a mission, a robot's own one too."""
    mission = _find(fleet, who, robot.id, id)
    now_ns, at_ns = fleet.clock.wall_ns(), _at(fleet, robot.id, new.at)
    with fleet.database.begin() as connection:
        remarks.annotate(connection, at_ns, robot.id, id, str(who.principal), new.text)
        details = {"id": id, "text": new.text}
        who.note(connection, now_ns, "missions.annotate", robot.id, details=details)
        found = _shown(connection, robot.id, [mission])[0]
    _tell(fleet, robot.id)
    return found


def _at(fleet: Services, robot: str, text: str) -> int:
    found = time_in(fleet, robot, text)
    return fleet.clock.wall_ns() if found is None else found


def _missions(fleet: Services, who: Caller, robot: str) -> list[Known]:
    answer = fleet.asking.ask_now(f"{WORKER}:missions", {"robot": robot}, asker=who.asker)
    return msgspec.msgpack.decode(answer, type=list[Known])


def _find(fleet: Services, who: Caller, robot: str, mission_id: str) -> Known:
    for mission in _missions(fleet, who, robot):
        if mission.id == mission_id:
            return mission
    raise HTTPException(404, f"there is no such mission of {robot}")


def _shown(connection: Connection, robot: str, found: Sequence[Known]) -> list[Mission]:
    noted = remarks.notes(connection, robot, [mission.id for mission in found])
    ours = {mission.id for mission in remarks.missions(connection, robot)}
    return [
        Mission(
            id=m.id, name=m.name, origin="server" if m.id in ours else "robot",
            from_=format_time(m.from_ns), to=shown(m.to_ns), outcome=m.outcome, failed=m.failed,
            who=m.who, parameters=dict(m.parameters),
            notes=[Note(at=format_time(n.at_ns), who=n.who, text=n.text)
                   for n in noted.get(m.id, ())],
        )
        for m in found
    ]  # fmt: skip


def _tell(fleet: Services, robot: str) -> None:
    fleet.bus.publish(Change("robot", robot))
