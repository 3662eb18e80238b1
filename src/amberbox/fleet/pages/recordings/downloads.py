"""Downloads: asking for extracts of robots' data, and what has become of those asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, get_args
from urllib.parse import urlencode

from fastapi import Query, Request, Response

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Caller, Fleet, Who
from amberbox.fleet.api.downloads import Download, list_downloads
from amberbox.fleet.api.forms import shown
from amberbox.fleet.jobs import ledger
from amberbox.fleet.jobs.jobs import SETTING
from amberbox.fleet.jobs.ledger import OPEN, Job
from amberbox.fleet.jobs.wanted import Downloads, Format, Wanted
from amberbox.fleet.options.options import read
from amberbox.fleet.pages import figures
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.services import Services

routes = Pages()

FORMATS: Sequence[Format] = get_args(Format)
_PAGE = 50
_NONE: list[str] = []
_HOUR_NS = 3600 * NS

Names = Annotated[list[Annotated[str, Query(max_length=300)]], Query(max_length=200)]
Text = Annotated[str, Query(max_length=64)]


@dataclass(frozen=True, slots=True)
class Begun:
    """What the form begins with: it stands in the address."""

    robots: Sequence[str] = field(default=())
    missions: Sequence[str] = field(default=())
    items: Sequence[str] = field(default=())
    from_: str = ""
    to: str = ""
    format: str = "csv"


@dataclass(frozen=True, slots=True)
class Line:
    """A download as it is shown; times are RFC 3339, ``again`` is the form filled in with it."""

    about: Download
    start: str | None
    to: str | None
    until: str | None
    again: str

    @property
    def is_open(self) -> bool:
        """Tell whether it is still being made."""
        return self.about.state in OPEN


@routes.get("/downloads", "data.download", each=True)
def show(
    request: Request, fleet: Fleet, who: Who, robot: Names = _NONE, mission: Names = _NONE,
    item: Names = _NONE, from_: Annotated[Text, Query(alias="from")] = "", to: Text = "",
    format: Text = "csv", after: Text = "", all: bool = False,
) -> Response:  # fmt: skip
    """Show one's downloads, and the form for a new one."""
    options = _options(fleet)
    begun = Begun(robot, mission, item, from_, to, format if format in FORMATS else "csv")
    return render(
        request, "recordings/downloads.html", begun=begun, formats=FORMATS,
        robots=_robots(fleet, who), is_begun=bool(robot or mission or item or from_),
        options=options, **_listed(fleet, who, options, after, all=all),
    )  # fmt: skip


@routes.get("/pieces/downloads", "data.download", each=True)
def show_list(
    request: Request, fleet: Fleet, who: Who, after: Text = "", all: bool = False
) -> Response:
    """Show the list of downloads alone."""
    shown = _listed(fleet, who, _options(fleet), after, all=all)
    return render(request, "recordings/downloads_list.html", **shown)


def _robots(fleet: Services, who: Caller) -> list[str]:
    with fleet.database.reading() as connection:
        return [robot.id for robot in who.robots(connection, "data.download")]


def _options(fleet: Services) -> Downloads:
    with fleet.database.reading() as connection:
        return read(connection, SETTING, Downloads)


def _listed(
    fleet: Services, who: Caller, options: Downloads, after: str, *, all: bool
) -> Mapping[str, Any]:
    found = list_downloads(fleet, who, limit=_PAGE + 1, after=after, all=all)
    with fleet.database.reading() as connection:
        jobs = ledger.find_all(connection, [one.id for one in found[:_PAGE]])
    lines = [_line(one, jobs[one.id], options) for one in found[:_PAGE] if one.id in jobs]
    return {
        "lines": lines, "more": found[_PAGE - 1].id if len(found) > _PAGE else "",
        "after": after, "all": all, "called": _called,
        "is_admin": who.may("users.read"), "size": figures.size, "percent": figures.percent,
    }  # fmt: skip


def _called(missions: Sequence[str]) -> list[str]:
    """Return what missions are called on the page: those that can be chosen there, in words."""
    words = catalogue().texts
    return [words.get(f"downloads.quick.{name.replace(':', '_')}", name) for name in missions]


def _line(one: Download, job: Job, options: Downloads) -> Line:
    ended_ns = job.ended_ns if job.state == "done" else None
    until = None if ended_ns is None else format_time(ended_ns + int(options.kept_h * _HOUR_NS))
    wanted = job.wanted
    return Line(one, shown(wanted.from_ns), shown(wanted.to_ns), until, _again(wanted))


def _again(wanted: Wanted) -> str:
    """Return the address of the form, filled in with what was wanted before."""
    query = [("robot", name) for name in wanted.robots]
    query += [("mission", name) for name in wanted.missions]
    query += [("item", name) for name in dict.fromkeys([*wanted.items, *wanted.variables])]
    span = ("from", shown(wanted.from_ns)), ("to", shown(wanted.to_ns))
    query += [(name, time) for name, time in span if time]
    return f"/downloads?{urlencode([*query, ('format', wanted.format)])}#new"
