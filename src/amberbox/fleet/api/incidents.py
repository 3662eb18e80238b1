"""Incidents: windows that robots or people want kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from fastapi import Path, Query
from pydantic import Field

from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form, Limit
from amberbox.fleet.api.windows import FROM, From, Shown, To, span_in
from amberbox.fleet.bus import Change
from amberbox.fleet.data import WORKER, remarks
from amberbox.fleet.data.remarks import Marked
from amberbox.fleet.services import Services

routes = Routes("incidents")

IncidentId = Annotated[str, Path(min_length=1, max_length=200)]
TimeField = Annotated[str, Field(min_length=1, max_length=64)]
_RELEASED = "released"
_BEYOND_NS = 2**63
"""Times are 64 bits."""


class Incident(Shown):
    """A window that is kept; ``state`` is ``open``, ``complete`` or ``released``."""

    id: str
    origin: Literal["robot", "server"]
    state: str
    reason: str
    who: str
    trigger: str
    from_: str = FROM
    to: str


class NewIncident(Form):
    """A window, and why what lies in it is to be kept."""

    from_: Annotated[TimeField, Field(alias="from")]
    to: TimeField
    reason: Annotated[str, Field(min_length=1, max_length=1000)]


@routes.get("/robots/{robot}/incidents", "incidents.read")
def list_incidents(
    fleet: Fleet, who: Who, robot: OfRobot, from_: From = "", to: To = "", limit: Limit = 100,
    after: Annotated[str, Query(max_length=200, description="the last id of the page before")] = "",
) -> list[Incident]:  # fmt: skip
    """List the incidents of a robot that meet a range of time, newest first."""
    from_ns, to_ns = span_in(fleet, robot.id, from_, to)
    answer = fleet.asking.ask_now(f"{WORKER}:incidents", {"robot": robot.id}, asker=who.asker)
    told = [_of_robot(values) for values in msgspec.json.decode(answer)]
    with fleet.database.reading() as connection:
        told += [_of_server(one) for one in remarks.incidents(connection, robot.id)]
    low, high = (None if ns is None else format_time(ns) for ns in (from_ns, to_ns))
    found = [
        one for one in told
        if (low is None or one.to > low) and (high is None or one.from_ < high)
    ]  # fmt: skip
    found.sort(key=lambda one: (one.from_, one.id), reverse=True)
    ids = [one.id for one in found]
    start = ids.index(after) + 1 if after in ids else 0
    return found[start : start + limit]


@routes.post("/robots/{robot}/incidents", "incidents.write", status_code=201)
def mark_incident(fleet: Fleet, who: Who, robot: OfRobot, new: NewIncident) -> Incident:
    """Mark a window: what the server has of it, or gets, is kept until it is released.

    What is still on the robot is asked for with ``/fetches``.
    """
    from_ns, to_ns = span_in(fleet, robot.id, new.from_, new.to)
    if from_ns is None or to_ns is None:
        raise UsageError("a window has a beginning and an end", "give from and to")
    with fleet.database.begin() as connection:
        now_ns, by = fleet.clock.wall_ns(), str(who.principal)
        marked = remarks.mark(connection, now_ns, robot.id, (from_ns, to_ns), new.reason, by)
        details = {"id": marked.id, "from": format_time(from_ns), "to": format_time(to_ns),
                   "reason": new.reason}  # fmt: skip
        who.note(connection, now_ns, "incidents.mark", robot.id, details=details)
    _tell(fleet, robot.id)
    return _of_server(marked)


@routes.post("/robots/{robot}/incidents/{id}/release", "incidents.write")
def release_incident(fleet: Fleet, who: Who, robot: OfRobot, id: IncidentId) -> Incident:
    """Let a window go that was marked here: retention counts for it again."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        released = remarks.release(connection, now_ns, robot.id, id)
        who.note(connection, now_ns, "incidents.release", robot.id, details={"id": id})
    _tell(fleet, robot.id)
    return _of_server(released)


def _of_robot(values: Mapping[str, Any]) -> Incident:
    texts = {name: str(values.get(name) or "") for name in ("id", "state", "reason", "who")}
    return Incident(
        origin="robot", trigger=str(values.get("trigger") or ""),
        from_=_time(values.get("from_ns")), to=_time(values.get("to_ns")),
        **texts,
    )  # fmt: skip


def _time(value: object) -> str:
    """Write a time that a robot told; what is none becomes the epoch."""
    return format_time(value if isinstance(value, int) and abs(value) < _BEYOND_NS else 0)


def _of_server(one: Marked) -> Incident:
    return Incident(
        id=one.id, origin="server", state="complete" if one.released_ns is None else _RELEASED,
        reason=one.reason, who=one.who, trigger="", from_=format_time(one.from_ns),
        to=format_time(one.to_ns),
    )  # fmt: skip


def _tell(fleet: Services, robot: str) -> None:
    fleet.bus.publish(Change("robot", robot))
