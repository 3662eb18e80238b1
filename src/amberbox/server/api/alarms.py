"""Routes of alarms: list, show, acknowledge, shelve, own, note and resolve them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

from fastapi import HTTPException, Query
from pydantic import Field, StringConstraints
from sqlalchemy import Connection

from amberbox.core.api import AlarmLine, AlarmPage, AlarmState
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.robot_status import Severity
from amberbox.core.timestamps import format_time
from amberbox.server.accounts.users import find_user
from amberbox.server.alarms import lifecycle, store
from amberbox.server.alarms.agreement import agree
from amberbox.server.alarms.alarm import Alarm, Step
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import Fleet, Routes, Who
from amberbox.server.http.forms import AlarmNumber, Form, Limit, TimeText
from amberbox.server.services import alarms
from amberbox.server.services.alarms import alarm_page, find_alarm
from amberbox.server.services.context import Caller, Services, query_time_ns

routes = Routes("alarms")

_LONGEST_NS = 366 * 86_400 * NS
_CHANGED: dict[int | str, dict[str, Any]] = {
    409: {"description": "somebody changed the alarm meanwhile: look at it again"}
}

Words = Annotated[str, StringConstraints(max_length=2000)]
Some = Annotated[str, StringConstraints(min_length=1, max_length=2000, pattern=r"\S")]
Revision = Annotated[int, Field(ge=1, le=2**62, description="of the alarm as it was looked at")]
Name = Annotated[str, StringConstraints(max_length=64)]


class Acknowledgement(Form):
    """Somebody sees to it."""

    revision: Revision
    note: Words = ""


class Shelving(Form):
    """Nobody wants to hear of it until a time: ``2026-11-21T14:00:00Z`` or ``now+2h``."""

    revision: Revision
    until: Annotated[str, StringConstraints(min_length=1, max_length=64)]
    reason: Some


class Unshelving(Form):
    """Somebody wants to hear of it again."""

    revision: Revision


class Owning(Form):
    """Whose business it is; nobody's with an empty name."""

    revision: Revision
    user: Name


class Noting(Form):
    """A note; it changes nothing, so it needs no revision."""

    text: Some


class Resolving(Form):
    """It is done, and why."""

    revision: Revision
    reason: Some


@routes.get("/alarms", "alarms.read", each=True)
def list_alarms(
    fleet: Fleet,
    who: Who,
    state: Annotated[list[AlarmState], Query(max_length=4, description="several fit")] = [],  # noqa: B006 - FastAPI copies it
    robot: Annotated[str, Query(max_length=64)] = "",
    group: Annotated[str, Query(max_length=64)] = "",
    severity: Annotated[Severity, Query(description="from this one on")] = "warning",
    since: TimeText = "",
    after: Annotated[int, Query(ge=0, le=2**62, description="the last id of the page before")] = 0,
    limit: Limit = 100,
) -> list[AlarmLine]:
    """List alarms, the newest first, of the robots that the caller may see.

    ``since`` asks for those that have changed since then.
    """
    return alarms.list_alarms(fleet, who, state, robot, group, severity, since, after, limit)


@routes.get("/alarms/{id}", "alarms.read", each=True)
def show_alarm(fleet: Fleet, who: Who, id: AlarmNumber) -> AlarmPage:
    """Show an alarm with what suffers from its root, and its history."""
    return alarms.show_alarm(fleet, who, id)


@routes.post("/alarms/{id}/acknowledge", "alarms.write", each=True, responses=_CHANGED)
def acknowledge_alarm(fleet: Fleet, who: Who, id: AlarmNumber, body: Acknowledgement) -> AlarmPage:
    """Say that one sees to it."""
    person = who.person
    step = partial(lifecycle.acknowledged, note=body.note, person=person)
    return _do(fleet, who, id, "acknowledge", body.revision, step, {"note": body.note})


@routes.post("/alarms/{id}/shelve", "alarms.write", each=True, responses=_CHANGED)
def shelve_alarm(fleet: Fleet, who: Who, id: AlarmNumber, body: Shelving) -> AlarmPage:
    """Put an alarm aside until a time: nobody is notified of it."""
    until_ns = query_time_ns(body.until, fleet.clock)
    now_ns = fleet.clock.wall_ns()
    if until_ns is None or until_ns > now_ns + _LONGEST_NS:
        raise UsageError("an alarm is shelved for a year at most", "say for instance now+2h")
    step = partial(lifecycle.shelved, until_ns=until_ns, reason=body.reason)
    details = {"until": format_time(until_ns), "reason": body.reason}
    return _do(fleet, who, id, "shelve", body.revision, step, details)


@routes.post("/alarms/{id}/unshelve", "alarms.write", each=True, responses=_CHANGED)
def unshelve_alarm(fleet: Fleet, who: Who, id: AlarmNumber, body: Unshelving) -> AlarmPage:
    """Take an alarm from the shelf."""
    return _do(fleet, who, id, "unshelve", body.revision, lifecycle.unshelved, {})


@routes.post("/alarms/{id}/own", "alarms.write", each=True, responses=_CHANGED)
def own_alarm(fleet: Fleet, who: Who, id: AlarmNumber, body: Owning) -> AlarmPage:
    """Make an alarm somebody's business."""
    step = partial(lifecycle.owned, owner=body.user)
    return _do(fleet, who, id, "own", body.revision, step, {"user": body.user}, user=body.user)


@routes.post("/alarms/{id}/note", "alarms.write", each=True)
def note_alarm(fleet: Fleet, who: Who, id: AlarmNumber, body: Noting) -> AlarmPage:
    """Add a note to the history of an alarm."""
    step = partial(lifecycle.noted, text=body.text)
    return _do(fleet, who, id, "note", None, step, {"text": body.text})


@routes.post("/alarms/{id}/resolve", "alarms.write", each=True, responses=_CHANGED)
def resolve_alarm(fleet: Fleet, who: Who, id: AlarmNumber, body: Resolving) -> AlarmPage:
    """Close an alarm; it opens again when the robot finds it anew."""
    step = partial(lifecycle.resolved, reason=body.reason)
    return _do(fleet, who, id, "resolve", body.revision, step, {"reason": body.reason})


def _do(
    fleet: Services, who: Caller, number: int, action: str, revision: int | None,
    step: Callable[[Alarm, str, int], Step], details: dict[str, Any], *, user: str = "",
) -> AlarmPage:  # fmt: skip
    """Do something to an alarm as the caller saw it; raises 409 when it is another since.

    Raises UsageError for a ``user`` who has no account.
    """
    principal = who.principal
    name = principal.id if principal.kind == "user" else str(principal)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        alarm = find_alarm(connection, who, number)
        _refuse(connection, who, alarm)
        if revision is not None and revision != alarm.revision:
            raise HTTPException(409, "somebody changed the alarm meanwhile: look at it again")
        if user:
            _refuse_unknown(connection, user)
        register = AlarmRegister(connection)
        changed = register.keep(alarm, step(alarm, name, now_ns))
        agree(register, alarm.number, now_ns)
        who.note(connection, now_ns, f"alarms.{action}", str(alarm.number), details=details)
        page = alarm_page(connection, who, changed)
    fleet.bus.publish(ServerChange("alarm", alarm.robot, {"id": alarm.number}))
    for robot in sorted(register.commanded):
        fleet.bus.publish(ServerChange("command", robot, {"ids": []}))
    return page


def _refuse_unknown(connection: Connection, name: str) -> None:
    """Refuse a name that nobody has, without saying which there are."""
    try:
        find_user(connection, name)
    except UsageError:
        raise UsageError(f"there is no account '{name}'", "ask an admin who there is") from None


def _refuse(connection: Connection, who: Caller, alarm: Alarm) -> None:
    """Raise 403 unless the caller may change alarms of every robot in it."""
    if who.principal.groups is None:
        return
    mine = {robot.id for robot in who.robots(connection, "alarms.write")}
    about = store.robots_of(connection, [alarm.number])[alarm.number]
    if any(row["robot"] not in mine for row in about):
        raise HTTPException(403, "this alarm is about robots of others, too")
