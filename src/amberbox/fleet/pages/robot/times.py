"""How a robot's components were over the last hours, as its page shows it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from amberbox.fleet.pages.robot.tree import branch_id, called
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.pages.wording import readable

Window = Literal["1h", "6h", "24h"]
Lanes = Literal["", "all"]
_TICKS = 4
_SECOND_STEPS = (10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21_600)
"""What lies between two ticks, in s; the smallest that needs no more ticks than there may be."""
_LEAST_WIDE_NS = 60 * NS
_AROUND = 0.25
"""So much of a stretch's length is shown before and behind it in its data."""
_LEAST_NS = 10 * NS


@dataclass(frozen=True, slots=True)
class Row:
    """One stretch that was not fine, in the table beside the drawing."""

    component: str
    name: str
    stretch: Stretch
    href: str


@dataclass(frozen=True, slots=True)
class Times:
    """What is shown: the drawing, what was not fine as a table, how many lanes were fine.

    ``known_from`` is when the first word was said, in RFC 3339, where that was in this time.
    """

    drawing: Element | None
    rows: Sequence[Row]
    shown: int
    fine: int
    complete: bool
    known_from: str = ""


def times(robot: str, found: Timeline, lanes: Lanes, names: Mapping[str, str]) -> Times:
    """Draw the components that were not fine all the time, or all of them.

    Nothing is drawn of the time before the first word of each; ``names`` is what they are called.
    """
    every = [lane for lane in map(_since_known, found.lanes) if not lane.mode and lane.stretches]
    troubled = [lane for lane in every if any(one.level != "ok" for one in lane.stretches)]
    chosen = every if lanes == "all" else troubled
    rows = [
        Row(lane.component, _name(lane, names), one, _data(robot, one))
        for lane in troubled for one in reversed(lane.stretches) if one.level != "ok"
    ]  # fmt: skip
    first = min((lane.stretches[0].from_ for lane in every), key=ns_of, default=found.from_)
    is_later = ns_of(first) > ns_of(found.from_)
    drawn = _drawn(robot, found, first, chosen, names) if chosen else None
    return Times(
        drawn, rows, len(chosen), len(every) - len(troubled), found.complete,
        first if is_later else "",
    )  # fmt: skip


def _since_known(lane: Lane) -> Lane:
    """Return a lane without what was before the first word of it."""
    known = (place for place, one in enumerate(lane.stretches) if one.level != "unknown")
    stretches = lane.stretches[next(known, len(lane.stretches)) :]
    return Lane(component=lane.component, mode=lane.mode, stretches=stretches)


def _drawn(
    robot: str, found: Timeline, first: str, lanes: Sequence[Lane], names: Mapping[str, str]
) -> Element:
    to = ns_of(found.to)
    start = max(min(ns_of(first), to - _LEAST_WIDE_NS), ns_of(found.from_))
    label = catalogue().text("robot.time.label", n=len(lanes))
    return drawing.timeline(
        [_lane(robot, lane, names) for lane in lanes], Axis(start, to), label=label,
        ticks=list(_ticks(start, to)), name="states", words=drawing_words(),
    )  # fmt: skip


def _ticks(start: int, to: int) -> Iterator[drawing.Tick]:
    """Yield times that lie round figures before the end: that is the same in every time zone."""
    steps = (step for step in _SECOND_STEPS if (to - start) // (step * NS) <= _TICKS)
    step = next(steps, _SECOND_STEPS[-1])
    for n in range((to - start) // (step * NS) + 1):
        yield drawing.Tick(to - n * step * NS, _ago(n * step))


def _ago(seconds: int) -> str:
    if not seconds:
        return catalogue().text("robot.time.now")
    if seconds % 60:
        return catalogue().text("robot.time.s_ago", n=seconds)
    if seconds < 7200 and seconds % 3600:
        return catalogue().text("robot.time.min_ago", n=seconds // 60)
    return catalogue().text("robot.time.h_ago", n=f"{seconds / 3600:g}")


def _lane(robot: str, lane: Lane, names: Mapping[str, str]) -> drawing.Lane:
    stretches = tuple(
        drawing.Stretch(ns_of(one.from_), ns_of(one.to), one.level, _said(one), _data(robot, one))
        for one in lane.stretches
    )
    return drawing.Lane(
        lane.component, _name(lane, names), stretches, f"#{branch_id(lane.component)}"
    )


def _name(lane: Lane, names: Mapping[str, str]) -> str:
    return names.get(lane.component) or called(lane.component)


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
