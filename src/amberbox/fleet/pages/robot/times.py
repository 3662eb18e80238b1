"""How a robot's components were over the last hours, as its page shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time, ns_of
from amberbox.fleet.api.timelines import Lane, Stretch, Timeline
from amberbox.fleet.drawing import timeline as drawing
from amberbox.fleet.drawing.axis import Axis
from amberbox.fleet.drawing.svg import Element
from amberbox.fleet.pages.datalinks import data_href
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.robot.tree import branch_id
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.pages.wording import readable

Window = Literal["1h", "6h", "24h"]
WINDOWS: Mapping[Window, int] = {"1h": 3600 * NS, "6h": 6 * 3600 * NS, "24h": 24 * 3600 * NS}
Lanes = Literal["", "all"]
_PARTS = 4
_AROUND = 0.25
"""So much of a stretch's length is shown before and behind it in its data."""
_LEAST_NS = 10 * NS


@dataclass(frozen=True, slots=True)
class Row:
    """One stretch that was not fine, in the table beside the drawing."""

    component: str
    stretch: Stretch
    href: str


@dataclass(frozen=True, slots=True)
class Times:
    """What is shown: the drawing, what was not fine as a table, how many lanes were fine."""

    drawing: Element | None
    rows: Sequence[Row]
    shown: int
    fine: int
    complete: bool


def times(robot: str, found: Timeline, lanes: Lanes, window: Window) -> Times:
    """Draw the components that were not fine all the time, or all of them."""
    every = [lane for lane in found.lanes if not lane.mode]
    troubled = [lane for lane in every if any(one.level != "ok" for one in lane.stretches)]
    chosen = every if lanes == "all" else troubled
    rows = [
        Row(lane.component, one, _data(robot, one))
        for lane in troubled for one in reversed(lane.stretches) if one.level != "ok"
    ]  # fmt: skip
    drawn = _drawn(robot, found, chosen, window) if chosen else None
    return Times(drawn, rows, len(chosen), len(every) - len(troubled), found.complete)


def _drawn(robot: str, found: Timeline, lanes: Sequence[Lane], window: Window) -> Element:
    start, to = ns_of(found.from_), ns_of(found.to)
    ticks = [
        drawing.Tick(start + (to - start) * part // _PARTS, _ago(window, _PARTS - part))
        for part in range(_PARTS + 1)
    ]
    label = catalogue().text("robot.time.label", n=len(lanes))
    return drawing.timeline(
        [_lane(robot, lane) for lane in lanes], Axis(start, to), label=label, ticks=ticks,
        name="states", words=drawing_words(),
    )  # fmt: skip


def _ago(window: Window, parts: int) -> str:
    """Write how long ago a tick is: that is the same in every time zone."""
    if not parts:
        return catalogue().text("robot.time.now")
    minutes = WINDOWS[window] // NS // 60 * parts // _PARTS
    hours = minutes / 60
    if minutes < 120 and minutes % 60:
        return catalogue().text("robot.time.min_ago", n=minutes)
    return catalogue().text("robot.time.h_ago", n=f"{hours:g}")


def _lane(robot: str, lane: Lane) -> drawing.Lane:
    stretches = tuple(
        drawing.Stretch(ns_of(one.from_), ns_of(one.to), one.level, _said(one), _data(robot, one))
        for one in lane.stretches
    )
    name = readable(lane.component)
    return drawing.Lane(lane.component, name, stretches, f"#{branch_id(lane.component)}")


def _said(one: Stretch) -> str:
    words_ = [one.reason or readable(one.state)]
    if one.changes:
        words_.append(catalogue().text("robot.time.changes", n=one.changes))
    return ", ".join(filter(None, words_))


def _data(robot: str, one: Stretch) -> str:
    """Return where the data of a stretch are shown, with some of what was before and behind."""
    start, to = ns_of(one.from_), ns_of(one.to)
    around = max(int((to - start) * _AROUND), _LEAST_NS)
    return data_href(robot, format_time(start - around), format_time(to + around))
