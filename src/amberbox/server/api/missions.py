"""Routes of missions, notes and incidents."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from fastapi import HTTPException, Path, Query
from pydantic import Field

from amberbox.blackbox.retention.missions import RecordedMission as KnownMission
from amberbox.core.api import Incident, Mission, MomentNote
from amberbox.core.errors import UsageError
from amberbox.core.notes import TEXT_LENGTH
from amberbox.core.timestamps import format_time
from amberbox.server import annotations as server_annotations
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import Form, From, Id, Limit, To
from amberbox.server.services import recordings
from amberbox.server.services.context import Caller, Services, robot_time_ns
from amberbox.server.services.recordings import (
    known_missions,
    mission_lines,
)

mission_routes = Routes("missions")

_PARAMETERS_BYTES = 8192
MissionId = Annotated[str, Path(min_length=1, max_length=200)]
At = Annotated[str, Field(max_length=64, description="when it was; empty: now")]


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

    text: Annotated[str, Field(min_length=1, max_length=TEXT_LENGTH)]
    at: At = ""


@mission_routes.get("/robots/{robot}/missions", "missions.read")
def list_missions(
    fleet: Fleet, who: Who, robot: OfRobot,
    name: Annotated[str, Query(max_length=64, description="of this name only")] = "",
    failed: Annotated[bool, Query(description="failed ones only")] = False,
    from_: From = "", to: To = "", limit: Limit = 100,
    after: Annotated[str, Query(max_length=200, description="the last id of the page before")] = "",
) -> list[Mission]:  # fmt: skip
    """List the missions of a robot that meet a range of time, newest first."""
    return recordings.list_missions(
        fleet, who, robot, name, failed=failed, from_=from_, to=to, limit=limit, after=after
    )


@mission_routes.get("/robots/{robot}/missions/{id}", "missions.read")
def read_mission(fleet: Fleet, who: Who, robot: OfRobot, id: MissionId) -> Mission:
    """Return a mission with what people remarked on it."""
    mission = _find(fleet, who, robot.id, id)
    with fleet.database.reading() as connection:
        return mission_lines(connection, robot.id, [mission])[0]


@mission_routes.post("/robots/{robot}/missions", "missions.write", status_code=201)
def begin_mission(fleet: Fleet, who: Who, robot: OfRobot, new: NewMission) -> Mission:
    """Begin a mission; one of the same name that was begun here and still lasts ends."""
    if len(msgspec.json.encode(new.parameters)) > _PARAMETERS_BYTES:
        raise UsageError(f"parameters are longer than {_PARAMETERS_BYTES} bytes")
    now_ns = fleet.clock.wall_ns()
    at_ns = _at(fleet, robot.id, new.at)
    with fleet.database.begin() as connection:
        begun = server_annotations.begin(
            connection, at_ns, robot.id, new.name, str(who.principal), new.parameters
        )
        details = {"id": begun.id, "at": format_time(at_ns)}
        who.note(connection, now_ns, "missions.begin", robot.id, details=details)
        found = mission_lines(connection, robot.id, [begun])[0]
    fleet.bus.publish(ServerChange("robot", robot.id))
    return found


@mission_routes.post("/robots/{robot}/missions/{id}/end", "missions.write")
def end_mission(fleet: Fleet, who: Who, robot: OfRobot, id: MissionId, how: EndMission) -> Mission:
    """End a mission that was begun here; a robot's own mission ends there."""
    at_ns = _at(fleet, robot.id, how.at)
    with fleet.database.begin() as connection:
        ended = server_annotations.end(
            connection, at_ns, robot.id, id, how.outcome, failed=how.failed
        )
        details = {"id": id, "outcome": how.outcome, "at": format_time(at_ns)}
        who.note(connection, fleet.clock.wall_ns(), "missions.end", robot.id, details=details)
        found = mission_lines(connection, robot.id, [ended])[0]
    fleet.bus.publish(ServerChange("robot", robot.id))
    return found


@mission_routes.post("/robots/{robot}/missions/{id}/notes", "missions.write", status_code=201)
def annotate_mission(
    fleet: Fleet, who: Who, robot: OfRobot, id: MissionId, new: NewNote
) -> Mission:
    """Remark something on a mission, a robot's own one too."""
    mission = _find(fleet, who, robot.id, id)
    recordings.write_note(fleet, who, robot, new.text, new.at, mission=id)
    with fleet.database.reading() as connection:
        return mission_lines(connection, robot.id, [mission])[0]


def _at(fleet: Services, robot: str, text: str) -> int:
    found = robot_time_ns(fleet, robot, text)
    return fleet.clock.wall_ns() if found is None else found


def _find(fleet: Services, who: Caller, robot: str, mission_id: str) -> KnownMission:
    for mission in known_missions(fleet, who, robot):
        if mission.id == mission_id:
            return mission
    raise HTTPException(404, f"there is no such mission of {robot}")


class NewMomentNote(Form):
    """A remark on a moment of a robot, or on a range of time."""

    text: Annotated[str, Field(min_length=1, max_length=TEXT_LENGTH)]
    at: Annotated[str, Field(max_length=64, description="when it was; empty: now")] = ""
    to: Annotated[str, Field(max_length=64, description="end of the range; empty: a moment")] = ""
    about: Annotated[str, Field(max_length=200, description="item, variable or component")] = ""


class ChangedNote(Form):
    """The new text of a note."""

    text: Annotated[str, Field(min_length=1, max_length=TEXT_LENGTH)]


NoteId = Annotated[str, Path(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$", description="its key ``note``")]


@mission_routes.get("/robots/{robot}/notes", "missions.read")
def list_notes(
    fleet: Fleet, robot: OfRobot, from_: From = "", to: To = "", limit: Limit = 100,
    after: Annotated[
        int | None, Query(description="the last id of the page before", ge=0, lt=2**63)
    ] = None,
) -> list[MomentNote]:  # fmt: skip
    """List the notes on moments of a range of time, newest first; those on missions, too."""
    return recordings.list_notes(fleet, robot, from_, to, limit, after)


@mission_routes.post("/robots/{robot}/notes", "missions.write", status_code=201)
def annotate_moment(fleet: Fleet, who: Who, robot: OfRobot, new: NewMomentNote) -> MomentNote:
    """Remark something on a moment or a range, whether a mission was under way then or not.

    The robot writes it into its record, too.
    """
    return recordings.write_note(fleet, who, robot, new.text, new.at, new.to, new.about)


@mission_routes.post("/robots/{robot}/notes/{note}", "missions.write")
def change_note(
    fleet: Fleet, who: Who, robot: OfRobot, note: NoteId, new: ChangedNote
) -> MomentNote:
    """Change the text of a note, also of one that was written on the robot."""
    return recordings.change_note(fleet, who, robot, note, new.text)


@mission_routes.post("/robots/{robot}/notes/{note}/withdraw", "missions.write")
def withdraw_note(fleet: Fleet, who: Who, robot: OfRobot, note: NoteId) -> MomentNote:
    """Withdraw a note: it is shown no more; the robot's record states that it was there."""
    return recordings.change_note(fleet, who, robot, note, withdrawn=True)


incident_routes = Routes("incidents")

IncidentId = Annotated[str, Path(min_length=1, max_length=200)]
TimeField = Annotated[str, Field(min_length=1, max_length=64)]


class NewIncident(Form):
    """A window, and why what lies in it is to be kept."""

    from_: Annotated[TimeField, Field(alias="from")]
    to: TimeField
    reason: Annotated[str, Field(min_length=1, max_length=1000)]


@incident_routes.get("/robots/{robot}/incidents", "incidents.read")
def list_incidents(
    fleet: Fleet, who: Who, robot: OfRobot, from_: From = "", to: To = "", limit: Limit = 100,
    after: Annotated[str, Query(max_length=200, description="the last id of the page before")] = "",
) -> list[Incident]:  # fmt: skip
    """List the incidents of a robot that meet a range of time, newest first."""
    return recordings.list_incidents(fleet, who, robot, from_, to, limit, after)


@incident_routes.post("/robots/{robot}/incidents", "incidents.write", status_code=201)
def mark_incident(fleet: Fleet, who: Who, robot: OfRobot, new: NewIncident) -> Incident:
    """Mark a window: what the server has of it, or gets, is kept until it is released.

    The robot pins it as well, in its ring, too. It is asked for with ``/fetches``.
    """
    return recordings.mark_incident(fleet, who, robot, new.from_, new.to, new.reason)


@incident_routes.post("/robots/{robot}/incidents/{id}/release", "incidents.write")
def release_incident(fleet: Fleet, who: Who, robot: OfRobot, id: IncidentId) -> Incident:
    """Let a window go that was marked here: retention counts for it again."""
    return recordings.release_incident(fleet, who, robot, id)
