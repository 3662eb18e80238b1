"""What there is around values in a window of time, as JSON: one question for all of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import HTTPException, Query
from fastapi.encoders import jsonable_encoder
from starlette.responses import JSONResponse

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Who
from amberbox.fleet.api.alarms import list_alarms
from amberbox.fleet.api.incidents import list_incidents
from amberbox.fleet.api.missions import list_missions
from amberbox.fleet.api.notes import MomentNote, list_notes
from amberbox.fleet.api.query import list_gaps
from amberbox.fleet.api.robots import read_timeline
from amberbox.fleet.api.windows import ITEM, From, To, span_in
from amberbox.fleet.pages.page import Pages
from amberbox.fleet.services import Services

routes = Pages()

_MARKS = 200
_GAPS = 1000
_POINTS = 400
_HALF = 2
"""Gaps are told of a half of the window more at each side: small moves need no new question."""

Items = Annotated[
    list[Annotated[str, Query(pattern=ITEM)]],
    Query(alias="item", max_length=64, description="items whose gaps are asked for"),
]
Part = Callable[[], Any]


@dataclass(frozen=True, slots=True)
class _Window:
    """A window of a robot, and who looks at it."""

    fleet: Services
    who: Caller
    robot: KnownRobot
    from_ns: int
    to_ns: int

    def parts(self, items: Sequence[str], marks: bool) -> Iterator[tuple[str, str, Part]]:
        """Yield the name, the action and what answers of each part."""
        if items:
            yield "gaps", "data.query", lambda: self.gaps(items)
        if marks:
            yield from self.marks()

    def marks(self) -> Iterator[tuple[str, str, Part]]:
        """Yield what happened; of alarms those that changed since the window began."""
        fleet, who, robot = self.fleet, self.who, self.robot
        begin, end = format_time(self.from_ns), format_time(self.to_ns)
        span = {"from_": begin, "to": end}
        about = {"robot": robot.id, "since": begin, "limit": _MARKS}
        yield "alarms", "alarms.read", lambda: list_alarms(fleet, who, **about)
        yield (
            "incidents",
            "incidents.read",
            lambda: list_incidents(fleet, who, robot, **span, limit=_MARKS),
        )
        yield (
            "missions",
            "missions.read",
            lambda: list_missions(fleet, who, robot, **span, limit=_MARKS),
        )
        yield "notes", "missions.read", lambda: self.notes(begin, end)
        yield "timeline", "status.read", lambda: read_timeline(fleet, robot, **span, points=_POINTS)

    def notes(self, begin: str, end: str) -> Sequence[MomentNote]:
        """Return the notes on moments alone; those on missions come with these."""
        found = list_notes(self.fleet, self.robot, begin, end, limit=_MARKS)
        return [one for one in found if not one.mission]

    def gaps(self, items: Sequence[str]) -> Mapping[str, Any]:
        more_ns = (self.to_ns - self.from_ns) // _HALF
        ends = max(self.from_ns - more_ns, 0), self.to_ns + more_ns
        begin, end = (format_time(ns) for ns in ends)
        of = {
            item: list_gaps(self.fleet, self.who, self.robot, item, begin, end, limit=_GAPS)
            for item in items
        }
        return {"from": ends[0] / NS, "to": ends[1] / NS, "items": of}


@routes.get("/robots/{robot}/data/around", "items.read")
def show_around(
    fleet: Fleet, who: Who, robot: OfRobot, from_: From, to: To,
    items: Items = [], marks: bool = True,  # noqa: B006 - FastAPI copies it
) -> JSONResponse:  # fmt: skip
    """Return gaps of items and, with ``marks``, alarms, incidents, missions and states.

    A part that the caller may not see is left out; one that cannot be had now stands in
    ``refused`` with the reason. Raises HTTPException for a window without an end.
    """
    from_ns, to_ns = span_in(fleet, robot.id, from_, to)
    if from_ns is None or to_ns is None:
        raise HTTPException(400, "the window needs a beginning and an end")
    window = _Window(fleet, who, robot, from_ns, to_ns)
    wanted = {
        name: part for name, action, part in window.parts(items, marks) if who.may(action, robot)
    }
    return JSONResponse(jsonable_encoder(_answered(wanted)))


def _answered(parts: Mapping[str, Part]) -> Mapping[str, Any]:
    """Return what parts answer; one that is refused takes no other with it."""
    found: dict[str, Any] = {}
    refused: dict[str, str] = {}
    for name, part in parts.items():
        try:
            found[name] = part()
        except AmberboxError as error:
            refused[name] = error.what
    return {**found, "refused": refused}
