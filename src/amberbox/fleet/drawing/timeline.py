"""How components were over time: a lane for each, a stretch for each level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from amberbox.diagnosis.explanation.lettering import SMALL, width
from amberbox.fleet.drawing.axis import Axis
from amberbox.fleet.drawing.marks import bars, dots, hatching
from amberbox.fleet.drawing.svg import (
    Element,
    Value,
    classes,
    element,
    fluid,
    group,
    lettering,
    linked,
    title,
)  # fmt: skip
from amberbox.fleet.drawing.words import Words

LEFT = 180.0
"""How wide the names are: the style sheet pads the drawing by as much, names stand left of 0."""
NARROWEST = 460.0
"""How wide the lanes are at least: words stand in stretches that have room for them then."""
TOP, SIGNS, LANE, BAR, THIN = 22.0, 20.0, 30.0, 18.0, 6.0
LEAST = 0.002
"""The least part of the width that a stretch takes, so that short ones are seen."""

GAP = "gap"
ORDER = (GAP, "ok", "unknown", "stale", "warn", "error")
"""What is drawn over what."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """``level`` from ``start`` to ``to``; level ``gap``: nothing is known. ``text`` says why."""

    start: int
    to: int
    level: str
    text: str = ""
    href: str = ""


@dataclass(frozen=True, slots=True)
class Lane:
    """A component and its stretches."""

    id: str
    name: str
    stretches: tuple[Stretch, ...]
    href: str = ""


@dataclass(frozen=True, slots=True)
class Tick:
    """A time with the label that it has."""

    at: int
    label: str


@dataclass(frozen=True, slots=True)
class Marker:
    """Something that happened: ``kind`` is ``alarm``, ``incident``, ``mission``, ``note``."""

    at: int
    kind: str
    text: str
    href: str = ""


def timeline(
    lanes: Sequence[Lane], axis: Axis, *, label: str, ticks: Sequence[Tick] = (),
    markers: Sequence[Marker] = (), name: str = "timeline", words: Words,
) -> Element:  # fmt: skip
    """Draw lanes of states over time, as wide as there is room.

    ``name`` begins the ids in the drawing: one that no other drawing of the page has. Each stretch
    carries ``data-from`` and ``data-to``, each marker ``data-at``, as they were given.
    """
    top = TOP + (SIGNS if markers else 0.0)
    high = top + LANE * len(lanes)
    parts = (
        _patterns(name),
        *(_rule(top + LANE * place) for place in range(len(lanes))),
        *(_name(lane, top + LANE * place) for place, lane in enumerate(lanes)),
        *_grid(axis, ticks, high),
        *(_lane(lane, axis, top + LANE * i, name, words) for i, lane in enumerate(lanes)),
        *(_marker(marker, axis, high) for marker in markers if axis.covers(marker.at, marker.at)),
    )
    return fluid("timeline", high + 8, label, parts)


def swatch(level: str, *, name: str, words: Words) -> Element:
    """Return a sample of a level (or ``gap``) for a legend; ``name`` begins its ids."""
    known = level if level in ORDER else "unknown"
    bar = _bar(known, name, 13, x=1, width=22)
    parts = (_patterns(name), bar)
    return element(
        "svg", *parts, class_="drawing timeline swatch", role="img", width=24, height=26,
        aria_label=words.level(known),
    )  # fmt: skip


def _patterns(name: str) -> Element:
    return element(
        "defs",
        hatching(f"{name}-gap", "gap", 6),
        hatching(f"{name}-warn", "warn", 8),
        dots(f"{name}-stale", "stale"),
        bars(f"{name}-unknown", "unknown"),
    )


def _rule(y: float) -> Element:
    """Return the line above a lane."""
    return element("line", class_="grid", x1=-LEFT, x2="100%", y1=y, y2=y)


def _name(lane: Lane, y: float) -> Element:
    text = lettering(
        lane.name, (2 - LEFT, y + LANE / 2 + 4.5), LEFT - 14, class_="lane-name", data_id=lane.id
    )
    return linked(lane.href, text)


def _grid(axis: Axis, ticks: Sequence[Tick], high: float) -> Iterator[Element]:
    for tick in ticks:
        x = axis.place(tick.at)
        share = axis.share(tick.at)
        side = "end" if share > 0.95 else "" if share < 0.05 else "middle"
        yield element("line", class_="grid", x1=x, x2=x, y1=TOP - 6, y2=high)
        yield element("text", tick.label, x=x, y=11, class_=classes("small", "num", side))


def _lane(lane: Lane, axis: Axis, y: float, name: str, words: Words) -> Element:
    shown = [stretch for stretch in lane.stretches if axis.covers(stretch.start, stretch.to)]
    shown.sort(key=lambda stretch: ORDER.index(_level(stretch)))
    return group(
        *(_stretch(stretch, axis, y + LANE / 2, name, words) for stretch in shown),
        class_="lane",
        data_id=lane.id,
    )


def _level(stretch: Stretch) -> str:
    return stretch.level if stretch.level in ORDER else "unknown"


def _stretch(stretch: Stretch, axis: Axis, middle: float, name: str, words: Words) -> Element:
    level = _level(stretch)
    x, wide = axis.place(stretch.start), axis.length(stretch.start, stretch.to, LEAST)
    said = words.level(level)
    about = f"{said}: {stretch.text}" if stretch.text else said
    part = group(
        title(about),
        _bar(level, name, middle, x=x, width=wide),
        _word(said, stretch, axis, middle) if level != "ok" else None,
        class_=f"stretch state-{level}",
        data_from=stretch.start,
        data_to=stretch.to,
    )
    return linked(stretch.href, part)


def _bar(level: str, name: str, middle: float, **place: Value) -> Element:
    """Return a bar: thin where all is fine, filled with the pattern of its level elsewhere."""
    high = THIN if level == "ok" else BAR
    fill = f"url(#{name}-{level})" if level in (GAP, "warn", "stale", "unknown") else None
    shape = f"bar bar-{level}"
    return element("rect", class_=shape, y=middle - high / 2, height=high, rx=3, fill=fill, **place)


def _word(said: str, stretch: Stretch, axis: Axis, middle: float) -> Element | None:
    """Return the word in a stretch, if it has room for it at any width."""
    room = (axis.share(stretch.to) - axis.share(stretch.start)) * NARROWEST
    long = width(said, SMALL) + 12
    if long > room:
        return None
    x = axis.place(max(stretch.start, axis.start))
    back = element("rect", class_="word-back", x=4, y=middle - 7, width=long - 6, height=14, rx=3)
    text = element("text", said, x=7, y=middle + 4, class_="word")
    return element("svg", back, text, x=x, overflow="visible")


_SHAPES = {
    "alarm": "M0-6L6.5 5.5H-6.5z",
    "incident": "M-5.5-5.5H5.5V5.5H-5.5z",
    "mission": "M-5-6H6L2.5-2L6 2H-3V7H-5z",
}
_ROUND = "M0-5.5a5.5 5.5 0 1 1 0 11a5.5 5.5 0 1 1 0-11z"


def _marker(marker: Marker, axis: Axis, high: float) -> Element:
    known = marker.kind if marker.kind in _SHAPES else "note"
    sign = element("path", class_="sign", d=_SHAPES.get(marker.kind, _ROUND))
    part = element(
        "svg",
        title(marker.text),
        element("line", class_="stem", x1=0, x2=0, y1=TOP + 12, y2=high),
        group(sign, at=(0, TOP + 6)),
        class_=f"marker marker-{known}", x=axis.place(marker.at), overflow="visible",
        data_at=marker.at,
    )  # fmt: skip
    return linked(marker.href, part)
