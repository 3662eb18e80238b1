"""Charts: timelines of states, coverage bars, sparklines, and the criticality matrix."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Literal, TypeAlias

from amberbox.core.svg import (
    SIZE,
    SMALL,
    SvgElement,
    Value,
    box,
    classes,
    element,
    fluid,
    group,
    lettering,
    linked,
    root,
    title,
    width,
)
from amberbox.server.drawing.symbols import DrawingTexts, bars, dots, hatching


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """The range of a drawing in any unit (usually nanoseconds); ``to`` is after ``start``."""

    start: float
    to: float

    def __post_init__(self) -> None:
        """Raise ValueError for an empty range."""
        if not self.to > self.start:
            raise ValueError("an axis ends after it starts")

    def share(self, at: float) -> float:
        """Return the position of a time, from 0 to 1; times outside are moved to the edge."""
        return min(1.0, max(0.0, (at - self.start) / (self.to - self.start)))

    def place(self, at: float) -> str:
        """Return the position of a time in percent, as text."""
        return f"{100 * self.share(at):.3f}%"

    def length(self, start: float, to: float, least: float = 0.0) -> str:
        """Return the length of an interval in percent, as text; at least the share ``least``."""
        return f"{100 * max(least, self.share(to) - self.share(start)):.3f}%"

    def covers(self, start: float, to: float) -> bool:
        """Return whether an interval overlaps the axis."""
        return start <= self.to and to >= self.start


# Width of the names, left of x = 0; the style sheet pads the drawing by as much
LEFT = 180.0
# Smallest width of the lanes, at which words must fit into their intervals
NARROWEST = 460.0
TOP, SIGNS, LANE, TIMELINE_BAR, THIN = 22.0, 20.0, 30.0, 18.0, 6.0
# Smallest share of the width for an interval, so that short ones are visible
TIMELINE_LEAST = 0.002

GAP = "gap"
ORDER = (GAP, "ok", "unknown", "stale", "warn", "error")  # from back to front


@dataclass(frozen=True, slots=True)
class StateInterval:
    """``level`` from ``start`` to ``to``; level ``gap``: unknown. ``text`` is the reason."""

    start: int
    to: int
    level: str
    text: str = ""
    href: str = ""


@dataclass(frozen=True, slots=True)
class TimelineLane:
    """A component and its intervals."""

    id: str
    name: str
    stretches: tuple[StateInterval, ...]
    href: str = ""


@dataclass(frozen=True, slots=True)
class AxisTick:
    """A time and its label."""

    at: int
    label: str


@dataclass(frozen=True, slots=True)
class TimelineMarker:
    """An event on the timeline; ``kind``: ``alarm``, ``incident``, ``mission`` or ``note``."""

    at: int
    kind: str
    text: str
    href: str = ""


def timeline(
    lanes: Sequence[TimelineLane], axis: TimeAxis, *, label: str, ticks: Sequence[AxisTick] = (),
    markers: Sequence[TimelineMarker] = (), name: str = "timeline", words: DrawingTexts,
) -> SvgElement:  # fmt: skip
    """Draw lanes of states over time; the width adapts to the page.

    ``name`` is the prefix of ids in the drawing and must be unique in the page. Each interval
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


def _patterns(name: str) -> SvgElement:
    return element(
        "defs",
        hatching(f"{name}-gap", "gap", 6),
        hatching(f"{name}-warn", "warn", 8),
        dots(f"{name}-stale", "stale"),
        bars(f"{name}-unknown", "unknown"),
    )


def _rule(y: float) -> SvgElement:
    """Return the line above a lane."""
    return element("line", class_="grid", x1=-LEFT, x2="100%", y1=y, y2=y)


def _name(lane: TimelineLane, y: float) -> SvgElement:
    text = lettering(
        lane.name, (2 - LEFT, y + LANE / 2 + 4.5), LEFT - 14, class_="lane-name", data_id=lane.id
    )
    return linked(lane.href, text)


def _grid(axis: TimeAxis, ticks: Sequence[AxisTick], high: float) -> Iterator[SvgElement]:
    for tick in ticks:
        x = axis.place(tick.at)
        share = axis.share(tick.at)
        side = "end" if share > 0.95 else "" if share < 0.05 else "middle"
        yield element("line", class_="grid", x1=x, x2=x, y1=TOP - 6, y2=high)
        yield element("text", tick.label, x=x, y=11, class_=classes("small", "num", side))


def _lane(
    lane: TimelineLane, axis: TimeAxis, y: float, name: str, words: DrawingTexts
) -> SvgElement:
    shown = [stretch for stretch in lane.stretches if axis.covers(stretch.start, stretch.to)]
    shown.sort(key=lambda stretch: ORDER.index(_level(stretch)))
    return group(
        *(_stretch(stretch, axis, y + LANE / 2, name, words) for stretch in shown),
        class_="lane",
        data_id=lane.id,
    )


def _level(stretch: StateInterval) -> str:
    return stretch.level if stretch.level in ORDER else "unknown"


def _stretch(
    stretch: StateInterval, axis: TimeAxis, middle: float, name: str, words: DrawingTexts
) -> SvgElement:
    level = _level(stretch)
    x, wide = axis.place(stretch.start), axis.length(stretch.start, stretch.to, TIMELINE_LEAST)
    level_word = words.level(level)
    about = f"{level_word}: {stretch.text}" if stretch.text else level_word
    part = group(
        title(about),
        _bar(level, name, middle, x=x, width=wide),
        _word(level_word, stretch, axis, middle) if level != "ok" else None,
        class_=f"stretch state-{level}",
        data_from=stretch.start,
        data_to=stretch.to,
    )
    return linked(stretch.href, part)


def _bar(level: str, name: str, middle: float, **place: Value) -> SvgElement:
    """Return a bar: thin for level ok, else filled with the pattern of its level."""
    high = THIN if level == "ok" else TIMELINE_BAR
    fill = f"url(#{name}-{level})" if level in (GAP, "warn", "stale", "unknown") else None
    shape = f"bar bar-{level}"
    return element("rect", class_=shape, y=middle - high / 2, height=high, rx=3, fill=fill, **place)


def _word(
    text_of_level: str, stretch: StateInterval, axis: TimeAxis, middle: float
) -> SvgElement | None:
    """Return the word in an interval, if it fits at the smallest width; else None."""
    room = (axis.share(stretch.to) - axis.share(stretch.start)) * NARROWEST
    long = width(text_of_level, SMALL) + 12
    if long > room:
        return None
    x = axis.place(max(stretch.start, axis.start))
    back = element("rect", class_="word-back", x=4, y=middle - 7, width=long - 6, height=14, rx=3)
    text = element("text", text_of_level, x=7, y=middle + 4, class_="word")
    return element("svg", back, text, x=x, overflow="visible")


_SHAPES = {
    "alarm": "M0-6L6.5 5.5H-6.5z",
    "incident": "M-5.5-5.5H5.5V5.5H-5.5z",
    "mission": "M-5-6H6L2.5-2L6 2H-3V7H-5z",
}
_ROUND = "M0-5.5a5.5 5.5 0 1 1 0 11a5.5 5.5 0 1 1 0-11z"


def _marker(marker: TimelineMarker, axis: TimeAxis, high: float) -> SvgElement:
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


# Height of the bar, and of the strip with incidents below it
COVERAGE_BAR, STRIP = 14.0, 5.0
LEAST = 0.002

Kind: TypeAlias = Literal["recorded", "filtered", "deleted", "lost", "incident"]
# From back to front
KINDS: tuple[Kind, ...] = ("recorded", "filtered", "deleted", "lost", "incident")


@dataclass(frozen=True, slots=True)
class CoverageInterval:
    """An interval of one kind from ``start`` to ``to``; ``text`` has details."""

    start: int
    to: int
    kind: Kind
    text: str = ""
    href: str = ""


def coverage(
    stretches: Sequence[CoverageInterval], axis: TimeAxis, *, label: str, name: str = "coverage",
    words: DrawingTexts,
) -> SvgElement:  # fmt: skip
    """Draw a coverage bar, blank where there is no interval.

    ``name`` is the prefix of ids in the drawing and must be unique in the page.
    """
    shown = [stretch for stretch in stretches if axis.covers(stretch.start, stretch.to)]
    shown.sort(key=lambda stretch: KINDS.index(stretch.kind))
    ground = element(
        "rect", class_="ground", x=0, y=0.5, width="100%", height=COVERAGE_BAR - 1, rx=3
    )
    parts = (_coverage_interval(stretch, axis, name, words) for stretch in shown)
    return fluid(
        "coverage", COVERAGE_BAR + STRIP + 2, label, (_coverage_patterns(name), ground, *parts)
    )


def coverage_swatch(kind: Kind, *, name: str, words: DrawingTexts) -> SvgElement:
    """Return a sample of a kind for a legend; ``name`` is the prefix of its ids."""
    bar = _coverage_bar(kind, name, x=0, width=24)
    return element(
        "svg", _coverage_patterns(name), bar, class_="drawing coverage swatch", role="img",
        width=24, height=COVERAGE_BAR + STRIP + 2, aria_label=_coverage_word(kind, words),
    )  # fmt: skip


def _coverage_patterns(name: str) -> SvgElement:
    return element(
        "defs",
        hatching(f"{name}-lost", "lost", 6),
        dots(f"{name}-filtered", "filtered", 5),
        bars(f"{name}-deleted", "deleted", 5),
    )


def _coverage_interval(
    stretch: CoverageInterval, axis: TimeAxis, name: str, words: DrawingTexts
) -> SvgElement:
    kind_word = _coverage_word(stretch.kind, words)
    place = axis.place(stretch.start)
    wide = axis.length(stretch.start, stretch.to, LEAST)
    part = group(
        title(f"{kind_word}: {stretch.text}" if stretch.text else kind_word),
        _coverage_bar(stretch.kind, name, x=place, width=wide),
        class_="stretch",
        data_from=stretch.start,
        data_to=stretch.to,
    )
    return linked(stretch.href, part)


def _coverage_bar(kind: Kind, name: str, **place: Value) -> SvgElement:
    incident = kind == "incident"
    fill = f"url(#{name}-{kind})" if kind in ("lost", "filtered", "deleted") else None
    return element(
        "rect", class_=f"bar cover-{kind}", y=COVERAGE_BAR + 2 if incident else 0.0,
        height=STRIP if incident else COVERAGE_BAR, rx=2, fill=fill, **place,
    )  # fmt: skip


def _coverage_word(kind: Kind, words: DrawingTexts) -> str:
    known: dict[Kind, str] = {
        "recorded": words.recorded,
        "filtered": words.filtered,
        "deleted": words.deleted,
        "lost": words.lost,
        "incident": words.incident,
    }
    return known[kind]


MOST = 100
PAD = 3.0

Point = tuple[float, float]


def spark(
    values: Sequence[float | None], *, label: str, size: tuple[float, float] = (96, 24)
) -> SvgElement:
    """Draw a line through equidistant values.

    None and values that are not finite leave a gap. Of more than 100 values, minimum and maximum of
    each part are drawn.
    """
    points = list(_points(_reduced(values), size))
    line = element("path", class_="spark-line", d="".join(_runs(points)))
    last = next((point for point in reversed(points) if point), None)
    dot = element("circle", class_="spark-dot", cx=last[0], cy=last[1], r=2) if last else None
    return root("spark", size, label, (line if last else None, dot))


def _reduced(values: Sequence[float | None]) -> list[float | None]:
    """Return at most 100 values: minimum and maximum of each part, in their order."""
    known = [value if value is not None and math.isfinite(value) else None for value in values]
    if len(known) <= MOST:
        return known
    parts = MOST // 2
    edges = [len(known) * part // parts for part in range(parts + 1)]
    pieces = (known[start:end] for start, end in pairwise(edges))
    return [value for piece in pieces for value in _extremes(piece)]


def _extremes(piece: Sequence[float | None]) -> tuple[float | None, float | None]:
    places = [place for place, value in enumerate(piece) if value is not None]
    if not places:
        return (None, None)
    found = {place: value for place in places if (value := piece[place]) is not None}
    ends = sorted((min(found, key=found.__getitem__), max(found, key=found.__getitem__)))
    return piece[ends[0]], piece[ends[1]]


def _points(values: Sequence[float | None], size: tuple[float, float]) -> Iterator[Point | None]:
    known = [value for value in values if value is not None]
    low, high = min(known, default=0.0), max(known, default=0.0)
    step = (size[0] - 2 * PAD) / max(1, len(values) - 1)
    for place, value in enumerate(values):
        if value is None:
            yield None
            continue
        share = value / 2 - low / 2, high / 2 - low / 2  # halves: no overflow
        part = share[0] / share[1] if share[1] else 0.5
        yield PAD + place * step, size[1] - PAD - part * (size[1] - 2 * PAD)


def _runs(points: Sequence[Point | None]) -> Iterator[str]:
    """Yield the path of each run without a gap; a single value becomes a short line."""
    for known, run in groupby(points, key=lambda point: point is not None):
        if not known:
            continue
        places = [f"{point[0]:.1f} {point[1]:.1f}" for point in run if point]
        yield f"M{'L'.join(places)}" if len(places) > 1 else f"M{places[0]}h.1"


MARGIN = 4.0
CELL = (66.0, 42.0)
APART = 4.0
HEAD = 40.0
ZONES = 4


@dataclass(frozen=True, slots=True)
class MatrixCell:
    """The number of failure modes, and a link to them; ``chosen`` marks the cell."""

    count: int
    href: str = ""
    chosen: bool = False


@dataclass(frozen=True, slots=True)
class MatrixChart:
    """A criticality matrix: rows from frequent to rare, columns from harmless to fatal.

    ``cells`` are by row and column label; missing ones are empty.
    """

    rows: Sequence[str]
    columns: Sequence[str]
    cells: Mapping[tuple[str, str], MatrixCell]


def criticality_matrix(matrix: MatrixChart, *, label: str, words: DrawingTexts) -> SvgElement:
    """Draw the matrix; a cell is darker the more severe and the more frequent it is."""
    left = _left(matrix, words)
    wide = left + len(matrix.columns) * (CELL[0] + APART)
    high = HEAD + len(matrix.rows) * (CELL[1] + APART)
    cells = (
        _cell(matrix, row, column, left, words)
        for row in range(len(matrix.rows))
        for column in range(len(matrix.columns))
    )
    parts = group(*_headings(matrix, left, words), *cells, at=(MARGIN, MARGIN))
    return root("matrix", (wide + 2 * MARGIN, high + 2 * MARGIN), label, (parts,))


def criticality_zone(row: int, column: int, rows: int, columns: int) -> int:
    """Return the criticality of a cell from 1 to 4: by its distance to the worst corner."""
    share = (rows - 1 - row) / max(1, rows - 1) + column / max(1, columns - 1)
    return min(ZONES, 1 + int(share / 2 * ZONES))


def _left(matrix: MatrixChart, words: DrawingTexts) -> float:
    """Return the width of the labels of rows, in pixels."""
    longest = max((width(row, SIZE) for row in matrix.rows), default=0.0)
    return min(190.0, max(longest, width(words.occurrence, SMALL, bold=True)) + 12)


def _headings(matrix: MatrixChart, left: float, words: DrawingTexts) -> Iterator[SvgElement]:
    yield element("text", words.occurrence, x=0, y=HEAD - 10, class_="heading")
    yield element("text", words.severity, x=left, y=10, class_="heading")
    for place, column in enumerate(matrix.columns):
        x = left + place * (CELL[0] + APART) + CELL[0] / 2
        yield lettering(column, (x, HEAD - 10), CELL[0], class_="middle")
    for place, row in enumerate(matrix.rows):
        y = HEAD + place * (CELL[1] + APART) + CELL[1] / 2 + 4.5
        yield lettering(row, (0, y), left - 8)


def _cell(
    matrix: MatrixChart, row: int, column: int, left: float, words: DrawingTexts
) -> SvgElement:
    names = matrix.rows[row], matrix.columns[column]
    cell = matrix.cells.get(names, MatrixCell(0))
    worth = criticality_zone(row, column, len(matrix.rows), len(matrix.columns))
    text = f"{words.modes.format(n=cell.count)}: {names[0]}, {names[1]}"
    part = group(
        title(text),
        box(0, 0, CELL, 6, class_="box"),
        element(
            "text", str(cell.count) if cell.count else "·", x=CELL[0] / 2, y=CELL[1] / 2 + 6,
            class_="count",
        ),
        at=(left + column * (CELL[0] + APART), HEAD + row * (CELL[1] + APART)),
        class_=classes(
            "cell", f"zone-{worth}", "" if cell.count else "none", "chosen" if cell.chosen else ""
        ),
    )  # fmt: skip
    return linked(cell.href if cell.count else "", part)
