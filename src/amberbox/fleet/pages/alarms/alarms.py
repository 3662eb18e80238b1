"""Alarms: what is wrong where, who sees to it, and what people say about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import Depends, Query, Request, Response
from sqlalchemy import Connection

from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Caller, Fleet, Who
from amberbox.fleet.api.alarms import Number
from amberbox.fleet.api.forms import TimeText, time_of
from amberbox.fleet.pages.alarms.search import STEP, TABS, Look, Sort, Tab, Wanted, found
from amberbox.fleet.pages.alarms.view import diagnosis_of, items, links_of, whole
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services
from amberbox.monitoring.plan import Severity

routes = Pages()

PERIODS = ("now-1h", "now-24h", "now-7d", "now-30d")
"""Periods that are offered; any other stands in the address."""
_MOST = 1_000

Text = Annotated[str, Query(max_length=128)]
Name = Annotated[str, Query(max_length=64)]


def looked_for(
    state: Tab = "open", q: Text = "", robot: Name = "", team: Name = "",
    severity: Severity = "warning",
    since: Annotated[TimeText, Query(alias="from")] = "",
    until: Annotated[TimeText, Query(alias="to")] = "",
    sort: Sort = "worst", n: Annotated[int, Query(ge=1, le=_MOST)] = STEP,
) -> Look:  # fmt: skip
    """Return what somebody looks for, as the address says it."""
    return Look(state, q.strip(), robot, team, severity, since, until, sort, n)


Looked = Annotated[Look, Depends(looked_for)]


@routes.get("/alarms", "alarms.read", each=True)
def show(request: Request, fleet: Fleet, who: Who, look: Looked) -> Response:
    """Show the alarms that fit, by what people made of them."""
    return render(request, "alarms/alarms.html", **_listed(fleet, who, look))


@routes.get("/pieces/alarms", "alarms.read", each=True)
def show_list(request: Request, fleet: Fleet, who: Who, look: Looked) -> Response:
    """Show the list of alarms alone."""
    return render(request, "alarms/list.html", **_listed(fleet, who, look))


@routes.get("/pieces/alarm-count", "alarms.read", each=True)
def show_count(request: Request) -> Response:
    """Show alone how many alarms are open."""
    return render(request, "alarms/count.html")


@routes.get("/alarms/{id}", "alarms.read", each=True)
def show_one(request: Request, fleet: Fleet, who: Who, id: Number) -> Response:
    """Show all of one alarm, with the diagnosis that explains it."""
    more = ("alarms", "diagnosis")
    return render(request, "alarms/alarm.html", strings=more, **_all_of(fleet, who, id))


@routes.get("/pieces/alarms/{id}", "alarms.read", each=True)
def show_parts(request: Request, fleet: Fleet, who: Who, id: Number) -> Response:
    """Show the parts of an alarm that change, alone."""
    return render(request, "alarms/alarm_parts.html", **_all_of(fleet, who, id))


def _all_of(fleet: Services, who: Caller, number: int) -> Mapping[str, Any]:
    shown = whole(fleet, who, number)
    explained = diagnosis_of(fleet, who, shown.item.line)
    links = links_of(shown.item.line, explained.card, format_time(fleet.clock.wall_ns()))
    return {"shown": shown, "explained": explained, "card": explained.card, "links": links}


def _listed(fleet: Services, who: Caller, look: Look) -> Mapping[str, Any]:
    since_ns, until_ns = time_of(look.since, fleet.clock), time_of(look.until, fleet.clock)
    with fleet.database.reading() as connection:
        known = who.robots(connection, "alarms.read")
        every = who.principal.groups is None
        seen = None if every else frozenset(robot.id for robot in known)
        wanted = Wanted(look, _robots(connection, who, look, seen), seen, since_ns, until_ns)
        answer = found(connection, wanted)
        shown = items(connection, fleet, who, answer.alarms)
    return {
        "look": look, "items": shown, "counts": answer.counts, "tabs": TABS,
        "periods": PERIODS, "more": answer.counts[look.state] > len(shown) and look.n < _MOST,
        "robots": [robot.id for robot in known], "step": STEP,
        "teams": sorted({group for robot in known for group in robot.groups}),
        "may": any(item.may for item in shown),
    }  # fmt: skip


def _robots(
    connection: Connection, who: Caller, look: Look, seen: frozenset[str] | None
) -> frozenset[str] | None:
    """Return the robots whose alarms are looked for; None for all."""
    if not look.robot and not look.team:
        return seen
    return frozenset(
        robot.id for robot in who.robots(connection, "alarms.read")
        if look.robot in ("", robot.id) and (not look.team or look.team in robot.groups)
    )  # fmt: skip
