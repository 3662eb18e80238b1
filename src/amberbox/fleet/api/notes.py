"""Notes: what people remark on moments of a robot, whether a mission was under way or not."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from pydantic import Field

from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form, Limit
from amberbox.fleet.api.windows import From, Shown, To, span_in, time_in
from amberbox.fleet.bus import Change
from amberbox.fleet.data import remarks
from amberbox.fleet.data.remarks import Remark

routes = Routes("missions")


class MomentNote(Shown):
    """A remark on a moment; ``mission`` is empty where it is on no mission."""

    id: int
    at: str
    who: str
    text: str
    mission: str


class NewMomentNote(Form):
    """A remark on a moment of a robot."""

    text: Annotated[str, Field(min_length=1, max_length=4000)]
    at: Annotated[str, Field(max_length=64, description="when it was; empty: now")] = ""


@routes.get("/robots/{robot}/notes", "missions.read")
def list_notes(
    fleet: Fleet, robot: OfRobot, from_: From = "", to: To = "", limit: Limit = 100,
    after: Annotated[
        int | None, Query(description="the last id of the page before", ge=0, lt=2**63)
    ] = None,
) -> list[MomentNote]:  # fmt: skip
    """List the notes on moments of a range of time, newest first; those on missions, too."""
    span = span_in(fleet, robot.id, from_, to)
    with fleet.database.reading() as connection:
        found = remarks.remarked(connection, robot.id, span, after, limit)
    return [_shown(one) for one in found]


@routes.post("/robots/{robot}/notes", "missions.write", status_code=201)
def annotate_moment(fleet: Fleet, who: Who, robot: OfRobot, new: NewMomentNote) -> MomentNote:
    """Remark something on a moment, whether a mission was under way then or not."""
    now_ns = fleet.clock.wall_ns()
    given_ns = time_in(fleet, robot.id, new.at)
    at_ns = now_ns if given_ns is None else given_ns
    with fleet.database.begin() as connection:
        by = str(who.principal)
        one = remarks.annotate(connection, at_ns, robot.id, remarks.NO_MISSION, by, new.text)
        details = {"id": one.number, "at": format_time(at_ns), "text": new.text}
        who.note(connection, now_ns, "notes.add", robot.id, details=details)
    fleet.bus.publish(Change("robot", robot.id))
    return _shown(one)


def _shown(one: Remark) -> MomentNote:
    return MomentNote(
        id=one.number, at=format_time(one.at_ns), who=one.who, text=one.text, mission=one.mission
    )
