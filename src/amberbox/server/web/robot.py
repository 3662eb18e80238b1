"""The page of one robot: components, timeline, events, diagnosis, battery and panels."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias
from urllib.parse import quote

import msgspec
from fastapi import Query, Request, Response

from amberbox.core.api import (
    Card,
    Component,
    Event,
    Lane,
    Mode,
    Output,
    StatusTree,
    Stretch,
    Timeline,
)
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.svg import SvgElement
from amberbox.core.timestamps import format_time, ns_of
from amberbox.diagnosis.report.wording import readable
from amberbox.server import annotations as server_annotations
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.data.query import WORKER, RowQuery, arguments
from amberbox.server.drawing import charts as drawing
from amberbox.server.drawing.charts import TimeAxis, spark
from amberbox.server.http.auth import Fleet, OfRobot, Who
from amberbox.server.live.records import format_moment
from amberbox.server.services.commands import remedies
from amberbox.server.services.context import Caller, Services, query_time_ns
from amberbox.server.services.robots import (
    current_status,
    list_events,
    read_card,
    read_link,
    read_status,
    read_timeline,
    status_now,
    status_without_folder,
)
from amberbox.server.web import components
from amberbox.server.web.components import Show, branch_id, called, failing, groups
from amberbox.server.web.diagnosis_card import DiagnosisCard, current_card
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue, data_href, drawing_words, moment_href

Window = Literal["1h", "6h", "24h"]
Lanes = Literal["", "all"]
_TICKS = 4
_SECOND_STEPS = (10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21_600)
"""Distances between two ticks, in s; the smallest with few enough ticks is used."""
_LEAST_WIDE_NS = 60 * NS
_AROUND = 0.25
"""So much of a stretch's length is shown before and behind it in its data."""
_LEAST_NS = 10 * NS


@dataclass(frozen=True, slots=True)
class StateRow:
    """An interval in which a component was not ok, in the table beside the drawing."""

    component: str
    name: str
    stretch: Stretch
    href: str


@dataclass(frozen=True, slots=True)
class TimelineView:
    """The timeline: the drawing, a table of what was not ok, how many lanes were always ok.

    ``known_from`` is the time of the first status (RFC 3339) if that is inside the window.
    """

    drawing: SvgElement | None
    rows: Sequence[StateRow]
    shown: int
    fine: int
    complete: bool
    known_from: str = ""


def times(robot: str, found: Timeline, lanes: Lanes, names: Mapping[str, str]) -> TimelineView:
    """Return the timeline of components that were not ok all the time, or of all.

    Nothing is drawn before the first status of a component; ``names`` are the components' names.
    """
    every = [lane for lane in map(_since_known, found.lanes) if not lane.mode and lane.stretches]
    troubled = [lane for lane in every if any(one.level != "ok" for one in lane.stretches)]
    chosen = every if lanes == "all" else troubled
    rows = [
        StateRow(lane.component, _name(lane, names), one, _data(robot, one))
        for lane in troubled for one in reversed(lane.stretches) if one.level != "ok"
    ]  # fmt: skip
    first = min((lane.stretches[0].from_ for lane in every), key=ns_of, default=found.from_)
    is_later = ns_of(first) > ns_of(found.from_)
    drawn = _drawn(robot, found, first, chosen, names) if chosen else None
    return TimelineView(
        drawn, rows, len(chosen), len(every) - len(troubled), found.complete,
        first if is_later else "",
    )  # fmt: skip


def _since_known(lane: Lane) -> Lane:
    """Return a lane without the time before its first status."""
    known = (place for place, one in enumerate(lane.stretches) if one.level != "unknown")
    stretches = lane.stretches[next(known, len(lane.stretches)) :]
    return Lane(component=lane.component, mode=lane.mode, stretches=stretches)


def _drawn(
    robot: str, found: Timeline, first: str, lanes: Sequence[Lane], names: Mapping[str, str]
) -> SvgElement:
    to = ns_of(found.to)
    start = max(min(ns_of(first), to - _LEAST_WIDE_NS), ns_of(found.from_))
    label = catalogue().text("robot.time.label", n=len(lanes))
    return drawing.timeline(
        [_lane(robot, lane, names) for lane in lanes], TimeAxis(start, to), label=label,
        ticks=list(_ticks(start, to)), name="states", words=drawing_words(),
    )  # fmt: skip


def _ticks(start: int, to: int) -> Iterator[drawing.AxisTick]:
    """Yield ticks at round distances before the end, which are round in every time zone."""
    steps = (step for step in _SECOND_STEPS if (to - start) // (step * NS) <= _TICKS)
    step = next(steps, _SECOND_STEPS[-1])
    for n in range((to - start) // (step * NS) + 1):
        yield drawing.AxisTick(to - n * step * NS, _ago(n * step))


def _ago(seconds: int) -> str:
    if not seconds:
        return catalogue().text("robot.time.now")
    if seconds % 60:
        return catalogue().text("robot.time.s_ago", n=seconds)
    if seconds < 7200 and seconds % 3600:
        return catalogue().text("robot.time.min_ago", n=seconds // 60)
    return catalogue().text("robot.time.h_ago", n=f"{seconds / 3600:g}")


def _lane(robot: str, lane: Lane, names: Mapping[str, str]) -> drawing.TimelineLane:
    stretches = tuple(
        drawing.StateInterval(
            ns_of(one.from_), ns_of(one.to), one.level, _interval_text(one), _data(robot, one)
        )
        for one in lane.stretches
    )
    return drawing.TimelineLane(
        lane.component, _name(lane, names), stretches, f"#{branch_id(lane.component)}"
    )


def _name(lane: Lane, names: Mapping[str, str]) -> str:
    return names.get(lane.component) or called(lane.component)


def _interval_text(one: Stretch) -> str:
    words_ = [one.reason or readable(one.state)]
    if one.changes:
        words_.append(catalogue().text("robot.time.changes", n=one.changes))
    return ", ".join(filter(None, words_))


def _data(robot: str, one: Stretch) -> str:
    """Return the address of the data in an interval, with a margin on both sides."""
    start, to = ns_of(one.from_), ns_of(one.to)
    around = max(int((to - start) * _AROUND), _LEAST_NS)
    return data_href(robot, format_time(start - around), format_time(to + around))


routes = PageRoutes()

EVENTS = 30
_KINDS_OF = 300
"""Number of the newest events from which the selectable kinds are collected."""
_POINTS = 300
_NOTED = 5
"""Number of the newest events of a link."""
_ACTIONS = ("items.read", "diagnoses.read", "diagnoses.write", "incidents.write", "missions.write",
            "robots.write")  # fmt: skip
NOTHING: list[str] = []
NO_FILLS: Mapping[str, str] = {}

Text = Annotated[str, Query(max_length=128)]
Chosen = Annotated[list[Annotated[str, Query(max_length=256)]], Query(alias="open", max_length=500)]


@dataclass(frozen=True, slots=True)
class RobotQuery:
    """Query of the page of a robot, as in the address."""

    q: str = ""
    show: Show = "all"
    chosen: Sequence[str] = ()
    window: Window = "1h"
    lanes: Lanes = ""
    kind: str = ""


@routes.get("/robots/{robot}", "status.read")
def show(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, q: Text = "", show: Show = "all",
    chosen: Chosen = NOTHING, window: Window = "1h", lanes: Lanes = "", kind: Text = "",
) -> Response:  # fmt: skip
    """Show the page of a robot."""
    look = RobotQuery(q, show, chosen, window, lanes, kind)
    known, card = status_now(fleet, robot), read_card(fleet, robot)
    tree = known or status_without_folder(fleet, robot)
    may = {name: who.may(name, robot) for name in _ACTIONS}
    return _show(
        request, "robot/robot.html", card=card, look=look, may=may, **_tree(fleet, tree, look),
        **_graph(tree), **_panels(tree, card), **_now(fleet, who, robot),
        fill=_fills(request, robot) if known is None else {},
        has_files=_has_files(fleet, who, robot, card), robot=robot,
        seen=_times(fleet, robot, look, tree), **_events(fleet, robot, kind, may["items.read"]),
        diagnosis=_diagnosis(fleet, robot) if may["diagnoses.read"] else None,
        strings=("diagnosis",),
    )  # fmt: skip


@routes.get("/pieces/robots/{robot}/head", "status.read")
def show_head(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Return the fragment with status and connection: the head of all pages of a robot."""
    return _show(request, "robot/head.html", card=read_card(fleet, robot))


@routes.get("/pieces/robots/{robot}/tree", "status.read")
def show_tree(
    request: Request, fleet: Fleet, robot: OfRobot, q: Text = "", show: Show = "all",
    chosen: Chosen = NOTHING,
) -> Response:  # fmt: skip
    """Return the fragment with the tree of components."""
    tree, card = read_status(fleet, robot), read_card(fleet, robot)
    return _show(
        request, "robot/tree.html", card=card, **_tree(fleet, tree, RobotQuery(q, show, chosen))
    )


@routes.get("/pieces/robots/{robot}/graph", "status.read")
def show_graph(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Return the fragment with the dependency graph."""
    tree = read_status(fleet, robot)
    return _show(request, "robot/graph.html", tree=tree, **_graph(tree))


@routes.get("/pieces/robots/{robot}/timeline", "status.read")
def show_timeline(
    request: Request, fleet: Fleet, robot: OfRobot, window: Window = "1h", lanes: Lanes = ""
) -> Response:
    """Return the fragment with the timeline."""
    look = RobotQuery(window=window, lanes=lanes)
    tree = status_now(fleet, robot) or status_without_folder(fleet, robot)
    seen = _times(fleet, robot, look, tree)
    return _show(request, "robot/timeline.html", robot=robot, look=look, seen=seen)


@routes.get("/pieces/robots/{robot}/events", "items.read")
def show_events(request: Request, fleet: Fleet, robot: OfRobot, kind: Text = "") -> Response:
    """Return the fragment with the newest events."""
    found = _events(fleet, robot, kind, may=True)
    return _show(request, "robot/events.html", robot=robot, **found)


@routes.get("/pieces/robots/{robot}/now", "status.read")
def show_now(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Return the fragment with current missions and the connection."""
    return _show(request, "robot/now.html", card=read_card(fleet, robot), **_now(fleet, who, robot))


@routes.get("/pieces/robots/{robot}/panels", "status.read")
def show_panels(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Return the fragment with battery and groups of like components."""
    tree, card = read_status(fleet, robot), read_card(fleet, robot)
    return _show(request, "robot/panels.html", card=card, **_panels(tree, card))


@routes.get("/pieces/robots/{robot}/files", "folder.read")
def show_files(request: Request, fleet: Fleet, robot: OfRobot) -> Response:
    """Return the fragment with the files of the robot's present folder."""
    config_hash = fleet.folders.current(robot.id)
    files = fleet.folders.files(robot.id, config_hash) or ()
    found = {"robot": robot.id, "config_hash": config_hash, "files": files}
    return _show(request, "robot/files.html", **found)


@routes.get("/pieces/robots/{robot}/battery", "items.read")
async def show_battery(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Return the fragment with the battery in the last hour."""
    try:
        found = await battery_hour(fleet, who, robot.id)
    except AmberboxError:  # workers are busy; the present value is on the page
        found = None
    return _show(request, "robot/trend.html", hour=found)


def _show(request: Request, template: str, **shown: Any) -> Response:
    return render(request, template, rt=components, **{"fill": NO_FILLS, **shown})


def _tree(fleet: Services, tree: StatusTree, look: RobotQuery) -> Mapping[str, Any]:
    of_components: dict[str, dict[str, None]] = {}
    for cause, actions in remedies(fleet, tree.robot).items():
        of_components.setdefault(cause.partition("#")[0], {}).update(dict.fromkeys(actions))
    return {
        "tree": tree, "remedies": of_components,
        "branches": components.branches(tree, look.q, look.show, look.chosen),
        "names": components.names(tree.components),
    }  # fmt: skip


def _graph(tree: StatusTree) -> Mapping[str, Any]:
    label = catalogue().text("robot.graph.label", robot=tree.robot)
    return {
        "drawn": components.graph(tree.components, label),
        "lines": components.as_list(tree.components),
    }


def _times(fleet: Services, robot: KnownRobot, look: RobotQuery, tree: StatusTree) -> TimelineView:
    found = read_timeline(fleet, robot, f"now-{look.window}", "now", points=_POINTS)
    return times(robot.id, found, look.lanes, components.names(tree.components))


def _events(fleet: Services, robot: KnownRobot, kind: str, may: bool) -> Mapping[str, Any]:
    if not may:
        return {"events": None, "kinds": [], "kind": ""}
    newest = list_events(fleet, robot, limit=_KINDS_OF)
    found = newest if not kind else list_events(fleet, robot, kind=kind, limit=EVENTS)
    kinds = sorted({one.kind for one in newest} | ({kind} if kind else set()))
    shown = [(one, _href(fleet, robot.id, one)) for one in reversed(found[-EVENTS:])]
    return {"events": shown, "kinds": kinds, "kind": kind}


def _href(fleet: Services, robot: str, event: Event) -> str:
    """Return the address of the data around an event."""
    at_ns = query_time_ns(event.at or "", fleet.clock)
    return "" if at_ns is None else moment_href(robot, (), at_ns)


def _diagnosis(fleet: Services, robot: KnownRobot) -> DiagnosisCard:
    return current_card(fleet, robot.id, current_status(fleet, robot))


def _now(fleet: Services, who: Who, robot: KnownRobot) -> Mapping[str, Any]:
    with fleet.database.reading() as connection:
        ours = [
            one for one in server_annotations.missions(connection, robot.id) if one.to_ns is None
        ]
    return {
        "link": read_link(fleet, robot, limit=_NOTED),
        "missions": [(one, format_moment(one.from_ns)) for one in reversed(ours)],
        "may_begin": who.may("missions.write", robot),
    }  # fmt: skip


def _panels(tree: StatusTree, card: Card) -> Mapping[str, Any]:
    shown = card.battery.output if card.battery else ""
    return {"groups": groups(tree.components), "battery": _battery(tree, shown)}


def _battery(tree: StatusTree, shown: str) -> BatteryOutputs | None:
    found = (one for one in tree.components if "battery" in one.component.casefold())
    return battery_outputs(next(found, None), shown)


def _fills(request: Request, robot: KnownRobot) -> Mapping[str, str]:
    """Return the addresses of the fragments that wait for the robot's folder."""
    base = f"/pieces/robots/{quote(robot.id, safe='')}"
    tree = f"{base}/tree?{request.url.query}"
    return {"tree": tree, "panels": f"{base}/panels", "graph": f"{base}/graph"}


def _has_files(fleet: Services, who: Who, robot: KnownRobot, card: Card) -> bool:
    """Return whether the server has the robot's folder and the caller may read it."""
    is_here = card.config_hash and not fleet.folders.wants(robot.id, card.config_hash)
    return bool(is_here) and who.may("folder.read", robot)


BACK_NS = 3600 * NS
POINTS = 60
CHARGE = "charge"
_UNITS: Mapping[str, str] = {
    "%": CHARGE, "V": "voltage", "mV": "voltage", "A": "current", "mA": "current",
    "°C": "temperature", "degC": "temperature", "K": "temperature",
}  # fmt: skip
_NAMES: Mapping[str, tuple[str, ...]] = {
    "temperature": ("temp",), "voltage": ("volt",), "current": ("current", "amp"),
    CHARGE: ("percent", "charge", "soc", "level"),
}  # fmt: skip
"""Parts of names that indicate the measured quantity if no unit does, in order of precedence."""
_ORDER = (CHARGE, "voltage", "current", "temperature")
_CHARGING = re.compile(r"(^|[._])(is_)?(charging|docked|plugged(_in)?)$")
_NUMBERS = ("float", "double", "int", "uint")
_SMALL = (84.0, 22.0)

Found: TypeAlias = "dict[str, Any]"
Key: TypeAlias = "tuple[Mode, Output]"


@dataclass(frozen=True, slots=True)
class BatteryOutputs:
    """The outputs of a battery's component: measured quantities, and others, such as checks."""

    component: Component
    measured: Sequence[Key]
    rest: Sequence[Key]

    @property
    def checks(self) -> int:
        """Return the number of outputs with an expectation."""
        return sum(bool(output.expected) for _, output in self.rest)

    @property
    def failing(self) -> bool:
        """Return whether an output fails."""
        return any(failing(mode, output) for mode, output in self.rest)


@dataclass(frozen=True, slots=True)
class BatteryTrend:
    """The course of one quantity: first and last value with unit, and a line."""

    quantity: str
    first: str
    last: str
    drawing: SvgElement


@dataclass(frozen=True, slots=True)
class BatteryHour:
    """The battery in the last hour; ``charging``: whether it was charging at the end."""

    trends: Sequence[BatteryTrend]
    charging: bool | None = None


def battery_outputs(component: Component | None, shown: str) -> BatteryOutputs | None:
    """Return the sorted outputs of a battery; the output ``shown`` is left out."""
    if component is None:
        return None
    measured: list[Key] = []
    rest: list[Key] = []
    for mode in component.modes:
        for output in mode.outputs:
            if output.name != shown:
                (measured if _is_measured(output) else rest).append((mode, output))
    return BatteryOutputs(component, measured, rest)


async def battery_hour(fleet: Services, who: Caller, robot: str) -> BatteryHour | None:
    """Return the battery in the last hour; None if nothing of it is recorded."""
    ask = _WorkerQueries(fleet, who, robot)
    items = [one["name"] for one in await ask("items") if "battery" in one["name"].casefold()]
    for item in items:
        columns = (await ask("item", item=item))["columns"]
        chosen, charging = quantities(columns), charging_of(columns)
        names = [one["name"] for one in chosen.values()] + ([charging] if charging else [])
        found = await ask.values(item, names) if chosen else {}
        trends = [_trend(name, one, found.get(one["name"], ())) for name, one in chosen.items()]
        known = [one for one in trends if one is not None]
        if known:
            return BatteryHour(known, _last_flag(found.get(charging, ())))
    return None


def quantities(columns: Sequence[Found]) -> dict[str, Found]:
    """Return a variable for each quantity: of several the one with the shortest name."""
    found: dict[str, Found] = {}
    for one in sorted(columns, key=lambda one: len(one["name"])):
        if one["type"].startswith(_NUMBERS) and (name := quantity_of(one["name"], one["unit"])):
            found.setdefault(name, one)
    return {name: found[name] for name in _ORDER if name in found}


def quantity_of(name: str, unit: str) -> str:
    """Return the quantity that a variable measures, by its unit, else by its name.

    Empty for any other quantity, also if the unit is another than the name suggests.
    """
    if unit:
        return _UNITS.get(unit, "")
    small = name.casefold()
    return next((q for q, parts in _NAMES.items() if any(part in small for part in parts)), "")


def charging_of(columns: Sequence[Found]) -> str:
    """Return the variable that shows whether the battery charges; empty if there is none."""
    flags = (one["name"] for one in columns if one["type"].startswith("bool"))
    return next((name for name in flags if _CHARGING.search(name.casefold())), "")


def _is_measured(output: Output) -> bool:
    """Return whether an output is a measured quantity rather than a check."""
    if output.type not in ("int", "float"):
        return not output.expected
    is_left = components.value_type(output) == components.DURATION or output.unit in (
        "s",
        "min",
        "h",
    )
    return is_left or bool(quantity_of(output.name, components.unit(output)))


def _trend(quantity: str, variable: Found, numbers: Sequence[float | None]) -> BatteryTrend | None:
    known = [value for value in numbers if value is not None]
    if not known:
        return None
    unit = _unit(variable)
    label = catalogue().text(f"robot.battery.trends.{quantity}")
    first, last = (f"{components.number(value)} {unit}".strip() for value in (known[0], known[-1]))
    return BatteryTrend(quantity, first, last, spark(numbers, label=label, size=_SMALL))


def _unit(variable: Found) -> str:
    """Return the unit of a variable: declared, else guessed from its name."""
    name: str = variable["name"]
    return variable["unit"] or components.guessed_unit(name) or ("%" if "percent" in name else "")


def _last_flag(numbers: Sequence[float | None]) -> bool | None:
    known = [value for value in numbers if value is not None]
    return bool(known[-1]) if known else None


@dataclass(frozen=True, slots=True)
class _WorkerQueries:
    fleet: Services
    who: Caller
    robot: str

    async def __call__(self, op: str, **more: str) -> Any:
        about = {"robot": self.robot, **more}
        answer = await self.fleet.worker_pool.ask(f"{WORKER}:{op}", about, origin=self.who.person)
        return msgspec.json.decode(answer)

    async def values(
        self, item: str, variables: Sequence[str]
    ) -> Mapping[str, Sequence[float | None]]:
        """Return values of the last hour in order of time, by variable."""
        now_ns = self.fleet.clock.wall_ns()
        names = list(variables)
        question = RowQuery(self.robot, item, names, now_ns - BACK_NS, now_ns, points=POINTS)
        about = arguments(question)
        answer = await self.fleet.worker_pool.ask(f"{WORKER}:query", about, origin=self.who.person)
        body = msgspec.json.decode(answer[4 + int.from_bytes(answer[:4], "little") :])
        return dict(_series(body, names))


def _series(body: Found, variables: Sequence[str]) -> Iterator[tuple[str, list[float | None]]]:
    columns = [one["name"] for one in body["columns"]]
    for variable in variables:
        place = next((n for n, name in enumerate(columns)
                      if variable in (name, name.rpartition(":")[0])), None)  # fmt: skip
        if place is not None:
            yield variable, [_number(row[place]) for row in body["data"]]


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
