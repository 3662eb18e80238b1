"""Alarms: which there are, what is known of one, and what people do about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from fastapi import HTTPException, Path, Query
from pydantic import Field, StringConstraints
from sqlalchemy import Connection

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts.users import find_user
from amberbox.fleet.alarms import listing, machine
from amberbox.fleet.alarms.alarm import Alarm, State, Step
from amberbox.fleet.alarms.listing import Wanted
from amberbox.fleet.alarms.register import Register
from amberbox.fleet.api.access import Caller, Fleet, Routes, Who
from amberbox.fleet.api.alarmlines import AlarmLine, AlarmPage, Consequence, Happening, line_of
from amberbox.fleet.api.forms import Form, Limit, TimeText, shown, time_of
from amberbox.fleet.bus import Change
from amberbox.fleet.services import Services
from amberbox.monitoring.plan import Severity

routes = Routes("alarms")

_COUNTED = ("opened", "away", "back")
"""Lines of a common alarm's history that count or name robots, also those of others."""
_LONGEST_NS = 366 * 86_400 * NS
_CHANGED: dict[int | str, dict[str, Any]] = {
    409: {"description": "somebody changed the alarm meanwhile: look at it again"}
}

Number = Annotated[int, Path(ge=1, le=2**62, description="the id of an alarm")]
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


@dataclass(frozen=True, slots=True)
class Asked:
    """One action on one alarm, by somebody."""

    number: int
    action: str
    revision: int | None
    step: Callable[[Connection, Alarm, str, int], Step]
    details: dict[str, Any]


Deed: TypeAlias = Callable[[Connection, Alarm, str, int], Step]


@routes.get("/alarms", "alarms.read", each=True)
def list_alarms(
    fleet: Fleet,
    who: Who,
    state: Annotated[list[State], Query(max_length=4, description="several fit")] = [],  # noqa: B006 - FastAPI copies it
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
    since_ns = time_of(since, fleet.clock)
    with fleet.database.reading() as connection:
        seen = _seen(connection, who, robot, group)
        wanted = Wanted(seen, state, severity, since_ns, after, limit)
        return _lines(connection, who, listing.fitting(connection, wanted))


@routes.get("/alarms/{id}", "alarms.read", each=True)
def show_alarm(fleet: Fleet, who: Who, id: Number) -> AlarmPage:
    """Show an alarm with what suffers from its root, and its history."""
    with fleet.database.reading() as connection:
        return _page(connection, who, _find(connection, who, id))


@routes.post("/alarms/{id}/acknowledge", "alarms.write", each=True, responses=_CHANGED)
def acknowledge_alarm(fleet: Fleet, who: Who, id: Number, body: Acknowledgement) -> AlarmPage:
    """Say that one sees to it."""

    def step(_: Connection, alarm: Alarm, name: str, now_ns: int) -> Step:
        person = who.principal.owner or who.principal.id
        return machine.acknowledged(alarm, name, now_ns, body.note, person)

    return _do(fleet, who, Asked(id, "acknowledge", body.revision, step, {"note": body.note}))


@routes.post("/alarms/{id}/shelve", "alarms.write", each=True, responses=_CHANGED)
def shelve_alarm(fleet: Fleet, who: Who, id: Number, body: Shelving) -> AlarmPage:
    """Put an alarm aside until a time: nobody is notified of it."""
    until_ns = time_of(body.until, fleet.clock)
    now_ns = fleet.clock.wall_ns()
    if until_ns is None or until_ns > now_ns + _LONGEST_NS:
        raise UsageError("an alarm is shelved for a year at most", "say for instance now+2h")

    def step(_: Connection, alarm: Alarm, name: str, now_ns: int) -> Step:
        return machine.shelved(alarm, name, now_ns, until_ns, body.reason)

    details = {"until": format_time(until_ns), "reason": body.reason}
    return _do(fleet, who, Asked(id, "shelve", body.revision, step, details))


@routes.post("/alarms/{id}/unshelve", "alarms.write", each=True, responses=_CHANGED)
def unshelve_alarm(fleet: Fleet, who: Who, id: Number, body: Unshelving) -> AlarmPage:
    """Take an alarm from the shelf."""

    def step(_: Connection, alarm: Alarm, name: str, now_ns: int) -> Step:
        return machine.unshelved(alarm, name, now_ns)

    return _do(fleet, who, Asked(id, "unshelve", body.revision, step, {}))


@routes.post("/alarms/{id}/own", "alarms.write", each=True, responses=_CHANGED)
def own_alarm(fleet: Fleet, who: Who, id: Number, body: Owning) -> AlarmPage:
    """Make an alarm somebody's business."""

    def step(connection: Connection, alarm: Alarm, name: str, now_ns: int) -> Step:
        if body.user:
            _refuse_nobody(connection, body.user)
        return machine.owned(alarm, name, now_ns, body.user)

    return _do(fleet, who, Asked(id, "own", body.revision, step, {"user": body.user}))


@routes.post("/alarms/{id}/note", "alarms.write", each=True)
def note_alarm(fleet: Fleet, who: Who, id: Number, body: Noting) -> AlarmPage:
    """Add a note to the history of an alarm."""

    def step(_: Connection, alarm: Alarm, name: str, now_ns: int) -> Step:
        return machine.noted(alarm, name, now_ns, body.text)

    return _do(fleet, who, Asked(id, "note", None, step, {"text": body.text}))


@routes.post("/alarms/{id}/resolve", "alarms.write", each=True, responses=_CHANGED)
def resolve_alarm(fleet: Fleet, who: Who, id: Number, body: Resolving) -> AlarmPage:
    """Close an alarm; it opens again when the robot finds it anew."""

    def step(_: Connection, alarm: Alarm, name: str, now_ns: int) -> Step:
        return machine.resolved(alarm, name, now_ns, body.reason)

    return _do(fleet, who, Asked(id, "resolve", body.revision, step, {"reason": body.reason}))


def _do(fleet: Services, who: Caller, asked: Asked) -> AlarmPage:
    """Do something to an alarm as the caller saw it; raises 409 when it is another since."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        alarm = _find(connection, who, asked.number)
        _refuse(connection, who, alarm)
        if asked.revision is not None and asked.revision != alarm.revision:
            raise HTTPException(409, "somebody changed the alarm meanwhile: look at it again")
        step = asked.step(connection, alarm, _name(who), now_ns)
        changed = Register(connection).keep(alarm, step)
        who.note(connection, now_ns, f"alarms.{asked.action}", str(alarm.number),
                 details=asked.details)  # fmt: skip
        page = _page(connection, who, changed)
    fleet.bus.publish(Change("alarm", alarm.robot, {"id": alarm.number}))
    return page


def _refuse_nobody(connection: Connection, name: str) -> None:
    """Refuse a name that nobody has, without saying which there are."""
    try:
        find_user(connection, name)
    except UsageError:
        raise UsageError(f"there is no account '{name}'", "ask an admin who there is") from None


def _name(who: Caller) -> str:
    principal = who.principal
    return principal.id if principal.kind == "user" else str(principal)


def _seen(connection: Connection, who: Caller, robot: str, group: str) -> frozenset[str] | None:
    """Return the robots whose alarms are asked for, and may be seen; None for all there are."""
    if who.principal.groups is None and not robot and not group:
        return None
    return frozenset(
        one.id
        for one in who.robots(connection, "alarms.read")
        if robot in ("", one.id) and (not group or group in one.groups)
    )


def _find(connection: Connection, who: Caller, number: int) -> Alarm:
    """Return an alarm; 404 also for one of robots that the caller may not see."""
    alarm = Register(connection).alarm(number)
    if alarm is None or not _line(connection, who, alarm).robots:
        raise HTTPException(404, "there is no such alarm, or not for you")
    return alarm


def _refuse(connection: Connection, who: Caller, alarm: Alarm) -> None:
    """Raise 403 unless the caller may change alarms of every robot in it."""
    if who.principal.groups is None:
        return
    mine = {robot.id for robot in who.robots(connection, "alarms.write")}
    about = listing.robots_of(connection, [alarm.number])[alarm.number]
    if any(row["robot"] not in mine for row in about):
        raise HTTPException(403, "this alarm is about robots of others, too")


def _line(connection: Connection, who: Caller, alarm: Alarm) -> AlarmLine:
    return _lines(connection, who, [alarm])[0]


def _lines(connection: Connection, who: Caller, alarms: list[Alarm]) -> list[AlarmLine]:
    """Return alarms as they are shown, of their robots those that the caller may see."""
    mine = _seen(connection, who, "", "")
    robots = listing.robots_of(connection, [alarm.number for alarm in alarms])
    return [
        line_of(
            alarm, [row for row in robots[alarm.number] if mine is None or row["robot"] in mine]
        )
        for alarm in alarms
    ]


def _page(connection: Connection, who: Caller, alarm: Alarm) -> AlarmPage:
    return AlarmPage(
        _line(connection, who, alarm),
        [
            Consequence(
                component=row["component"], level=row["level"], reason=row["reason"],
                from_=format_time(row["from_ns"]), to=shown(row["to_ns"]),
            )
            for row in listing.consequences_of(connection, alarm.number)
        ],
        [
            Happening(format_time(row["at_ns"]), row["who"], row["what"], row["text"])
            for row in listing.history_of(connection, alarm.number)
            if alarm.robot or who.principal.groups is None or row["what"] not in _COUNTED
        ],
    )  # fmt: skip
