"""The page of a robot's data: variables, a window of time, plots, and events around them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import numpy as np
from fastapi import HTTPException, Query, Request, Response
from starlette.responses import JSONResponse

from amberbox.core.api import MomentNote, to_json
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import format_time
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.data.query import WORKER, RowQuery, arguments
from amberbox.server.data.recordings import JournalListing, recordings
from amberbox.server.http.auth import Fleet, OfRobot, Who
from amberbox.server.http.forms import ITEM, From, To
from amberbox.server.services.alarms import list_alarms
from amberbox.server.services.context import Caller, Services, robot_span_ns
from amberbox.server.services.recordings import list_gaps, list_incidents, list_missions, list_notes
from amberbox.server.services.robots import read_card, read_timeline
from amberbox.server.web.diagnosis_card import current_card
from amberbox.server.web.page import PageRoutes, render

_GAPS = 20_000
_JOURNALS = 1_000_000
_STEPS = 800
"""Intervals closer to each other than this share of all time are drawn as one."""
_HELD = ("in_columns", "waiting")


@dataclass(frozen=True, slots=True)
class DataInterval:
    """An interval in seconds since 1970; for a gap its kind and its reason."""

    start: float
    end: float
    reason: str = ""
    kind: str = ""


@dataclass(frozen=True, slots=True)
class DataCoverage:
    """The whole time of a robot's data: recorded intervals and gaps.

    Journals without known times do not count; ``start`` and ``end`` are None if there are no
    others.
    """

    start: float | None
    end: float | None
    recorded: Sequence[DataInterval]
    missing: Sequence[DataInterval]


def coverage(fleet: Services, who: Caller, robot: str) -> DataCoverage:
    """Return the coverage of a robot's data; a worker reads the gaps."""
    with fleet.database.reading() as connection:
        journals = recordings(connection, fleet.folder, robot, limit=_JOURNALS)
    every = [*_spans(journals)]
    if not every:
        return DataCoverage(None, None, (), ())
    held = _spans(o for o in journals if o.state in _HELD and o.integrity != "deleted")
    question = arguments(RowQuery(robot, "", limit=_GAPS))
    answer = fleet.worker_pool.ask_now(f"{WORKER}:gaps", question, origin=who.person)
    gaps: list[dict[str, Any]] = msgspec.json.decode(answer)["gaps"]
    starts, ends = (_seconds([gap[name] for gap in gaps]) for name in ("from", "to"))
    reasons, kinds = ([gap[name] for gap in gaps] for name in ("reason", "kind"))
    missing = [DataInterval(*one) for one in zip(starts, ends, reasons, kinds, strict=True)]
    every += [one for one in missing if one.kind == "refused"]
    start, end = min(one.start for one in every), max(one.end for one in every)
    least = (end - start) / _STEPS
    return DataCoverage(start, end, joined(held, least), joined(missing, least))


def joined(stretches: Iterable[DataInterval], least: float) -> list[DataInterval]:
    """Join intervals of one reason whose distance is at most ``least`` (s)."""
    found: list[DataInterval] = []
    for one in sorted(stretches, key=lambda s: (s.reason, s.start)):
        last = found[-1] if found else None
        if last and last.reason == one.reason and one.start - last.end <= least:
            found[-1] = DataInterval(last.start, max(last.end, one.end), one.reason, one.kind)
        else:
            found.append(one)
    return sorted(found, key=lambda s: s.start)


def _seconds(stamps: Sequence[str]) -> list[float]:
    """Return RFC 3339 times in seconds since 1970."""
    read = np.array([stamp.rstrip("Z") for stamp in stamps], "datetime64[ns]").astype(np.int64)
    return [float(one) for one in read / NS]


def _spans(journals: Iterable[JournalListing]) -> Iterator[DataInterval]:
    """Yield the intervals of journals whose times are known."""
    for one in journals:
        if one.from_ns is not None and one.to_ns is not None:
            yield DataInterval(one.from_ns / NS, one.to_ns / NS)


routes = PageRoutes()

_MARKS = 200
_AROUND_GAPS = 1000
_POINTS = 400
_HALF = 2
"""Gaps are loaded for this fraction of the window at each side: small moves need no new request."""

Items = Annotated[
    list[Annotated[str, Query(pattern=ITEM)]],
    Query(alias="item", max_length=64, description="items whose gaps are asked for"),
]
Part = Callable[[], Any]


@dataclass(frozen=True, slots=True)
class _Window:
    """A window of a robot's time, and the caller."""

    fleet: Services
    who: Caller
    robot: KnownRobot
    from_ns: int
    to_ns: int

    def parts(self, items: Sequence[str], marks: bool) -> Iterator[tuple[str, str, Part]]:
        """Yield name, action and function of each part."""
        if items:
            yield "gaps", "data.query", lambda: self.gaps(items)
        if marks:
            yield from self.marks()

    def marks(self) -> Iterator[tuple[str, str, Part]]:
        """Yield the parts with events; alarms are those that changed since the window began."""
        fleet, who, robot = self.fleet, self.who, self.robot
        begin, end = format_time(self.from_ns), format_time(self.to_ns)
        yield (
            "alarms",
            "alarms.read",
            lambda: list_alarms(fleet, who, robot=robot.id, since=begin, limit=_MARKS),
        )
        yield (
            "incidents",
            "incidents.read",
            lambda: list_incidents(fleet, who, robot, begin, end, limit=_MARKS),
        )
        yield (
            "missions",
            "missions.read",
            lambda: list_missions(fleet, who, robot, from_=begin, to=end, limit=_MARKS),
        )
        yield "notes", "missions.read", lambda: self.notes(begin, end)
        yield (
            "timeline",
            "status.read",
            lambda: read_timeline(fleet, robot, begin, end, points=_POINTS),
        )

    def notes(self, begin: str, end: str) -> Sequence[MomentNote]:
        """Return the notes on moments only; those on missions are part of the missions."""
        found = list_notes(self.fleet, self.robot, begin, end, limit=_MARKS)
        return [one for one in found if not one.mission]

    def gaps(self, items: Sequence[str]) -> Mapping[str, Any]:
        more_ns = (self.to_ns - self.from_ns) // _HALF
        ends = max(self.from_ns - more_ns, 0), self.to_ns + more_ns
        begin, end = (format_time(ns) for ns in ends)
        of = {
            item: list_gaps(self.fleet, self.who, self.robot, item, begin, end, limit=_AROUND_GAPS)
            for item in items
        }
        return {"from": ends[0] / NS, "to": ends[1] / NS, "items": of}


@routes.get("/robots/{robot}/data/around", "items.read")
def show_around(
    fleet: Fleet, who: Who, robot: OfRobot, from_: From, to: To,
    items: Items = [], marks: bool = True,  # noqa: B006 - FastAPI copies it
) -> JSONResponse:  # fmt: skip
    """Return gaps of items and, with ``marks``, alarms, incidents, missions, notes and states.

    A part that the caller may not see is left out; one that fails is in ``refused`` with the
    reason. Raises HTTPException for a window without an end.
    """
    from_ns, to_ns = robot_span_ns(fleet, robot.id, from_, to)
    if from_ns is None or to_ns is None:
        raise HTTPException(400, "the window needs a beginning and an end")
    window = _Window(fleet, who, robot, from_ns, to_ns)
    wanted = {
        name: part for name, action, part in window.parts(items, marks) if who.may(action, robot)
    }
    return JSONResponse(to_json(_answered(wanted)))


def _answered(parts: Mapping[str, Part]) -> Mapping[str, Any]:
    """Return the results of all parts; the errors of those that fail are in ``refused``."""
    found: dict[str, Any] = {}
    refused: dict[str, str] = {}
    for name, part in parts.items():
        try:
            found[name] = part()
        except AmberboxError as error:
            refused[name] = error.what
    return {**found, "refused": refused}


_MAY = {
    "download": "data.download", "fetch": "data.fetch", "mark": "incidents.write",
    "note": "missions.write",
}  # fmt: skip


@routes.get("/robots/{robot}/data", "items.read")
def show(request: Request, robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Show the page; its content is loaded afterwards, so that it does not wait for a worker."""
    may = {name: who.may(action, robot) for name, action in _MAY.items()}
    return render(
        request, "data/data.html", strings=("plot",), card=read_card(fleet, robot), may=may,
        named=_named(fleet, robot),
    )  # fmt: skip


@routes.get("/robots/{robot}/data/variables", "items.read")
def list_variables(robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Return all items with their columns, as JSON."""
    answer = fleet.worker_pool.ask_now(
        f"{WORKER}:described", {"robot": robot.id}, origin=who.person
    )
    return Response(answer, media_type="application/json")


@routes.get("/robots/{robot}/data/coverage", "items.read")
def show_coverage(robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Return recorded intervals and gaps as JSON."""
    return JSONResponse(asdict(coverage(fleet, who, robot.id)))


def _named(fleet: Services, robot: KnownRobot) -> Sequence[str]:
    """Return the variables in the reasons of the robot's diagnosis."""
    card = current_card(fleet, robot.id)
    queries = (parse_qs(urlsplit(reason.href).query) for reason in card.why)
    return list(dict.fromkeys(name for query in queries for name in query.get("v", ())))
