"""Where everything stands: boxes in columns, lanes between them, and the curves that join them.

A line that passes a column runs through a lane of its own there, so that no line crosses a box.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from amberbox.core.sureness import percent
from amberbox.diagnosis.explanation.columns import Columns, Link, Slot, columns_of
from amberbox.diagnosis.explanation.explanation import Explanation, Graph, Node
from amberbox.diagnosis.explanation.lettering import SIZE, SMALL, width, wrapped
from amberbox.diagnosis.explanation.words import date_and_clock

MARGIN = 16.0
PAD = 8.0
BOX = 280.0
BETWEEN = 76.0
APART = 12.0
LANE = 4.0
LINE = 17.0
SMALL_LINE = 14.0

HEADS = {"cause": "What may be broken", "lost": "What fails with it", "symptom": "What is seen"}


@dataclass(frozen=True, slots=True)
class Line:
    """A line of text; ``x`` is its left end, ``y`` its base line."""

    kind: str
    text: str
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Box:
    """A box; ``share`` fills a bar at its lower edge."""

    kind: str
    x: float
    y: float
    width: float
    height: float
    share: float | None = None


@dataclass(frozen=True, slots=True)
class Stroke:
    """A curve between two columns; ``tip`` is where its arrow ends."""

    path: str
    missing: bool = False
    leading: bool = False
    tip: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Drawing:
    """All that is drawn, in pixels from the upper left corner."""

    width: float
    height: float
    boxes: tuple[Box, ...]
    lines: tuple[Line, ...]
    strokes: tuple[Stroke, ...]


def drawn(explanation: Explanation) -> Drawing:
    """Lay an explanation out."""
    graph = explanation.graph
    columns = columns_of(graph)
    wide = 2 * MARGIN + len(columns.slots) * BOX + (len(columns.slots) - 1) * BETWEEN
    head = list(_head(explanation, wide - 2 * MARGIN))
    top = max((line.y for line in head), default=0.0) + 1.6 * LINE
    letters = {node.id: lettered(node) for node in graph.nodes}
    places = _places(columns, letters, top + LINE / 2)
    boxes = [_box(node, letters[node.id], places) for node in graph.nodes]
    lines = [line for node in graph.nodes for line in _letters(letters[node.id], places[node.id])]
    bottom = max((box.y + box.height for box in boxes), default=top)
    notes = list(_notes(graph, columns, bottom + LINE))
    high = max((line.y for line in (*head, *notes)), default=0.0)
    return Drawing(
        wide,
        max(high, bottom) + MARGIN,
        tuple(boxes),
        (*head, *_column_heads(columns, top), *lines, *notes),
        tuple(_strokes(columns, places)),
    )


@dataclass(frozen=True, slots=True)
class Lettered:
    """The lines of a box and how high they make it."""

    node: Node
    main: tuple[str, ...]
    small: tuple[str, ...]
    height: float


def lettered(node: Node) -> Lettered:
    """Break the texts of a node into lines."""
    number = "" if node.probability is None else f"{percent(node.probability)}: "
    mark = {"contradicted": "should show, and does not: ", "unexplained": "not explained: "}
    text = f"{mark.get(node.mark, number)}{node.text}"
    main = tuple(wrapped(text, BOX - 2 * PAD, SIZE))
    small = tuple(wrapped(node.small, BOX - 2 * PAD, SMALL)) if node.small else ()
    bar = 0.0 if node.probability is None else 12.0
    height = 2 * PAD + LINE * len(main) + SMALL_LINE * len(small) + bar
    return Lettered(node, main, small, height)


Place = tuple[float, float, float]
"""Left, upper edge and height of a box or a lane."""


def _places(columns: Columns, letters: Mapping[str, Lettered], top: float) -> dict[str, Place]:
    """Stack every column, and put them at the same middle."""
    heights = [[_height(slot, letters) for slot in slots] for slots in columns.slots]
    totals = [sum(of) + APART * max(0, len(of) - 1) for of in heights]
    tallest = max(totals, default=0.0)
    places = {}
    for number, slots in enumerate(columns.slots):
        x = MARGIN + number * (BOX + BETWEEN)
        y = top + (tallest - totals[number]) / 2
        for slot, height in zip(slots, heights[number], strict=True):
            places[slot.id] = (x, y, height)
            y += height + APART
    return places


def _height(slot: Slot, letters: Mapping[str, Lettered]) -> float:
    return LANE if slot.lane else letters[slot.id].height


def _box(node: Node, letters: Lettered, places: Mapping[str, Place]) -> Box:
    x, y, height = places[node.id]
    return Box(node.mark or node.kind, x, y, BOX, height, node.probability)


def _letters(letters: Lettered, place: Place) -> Iterator[Line]:
    x, y, _ = place
    y += PAD
    for text in letters.main:
        y += LINE
        yield Line("", text, x + PAD, y - 4)
    for text in letters.small:
        y += SMALL_LINE
        yield Line("small", text, x + PAD, y - 4)


def _head(explanation: Explanation, most: float) -> Iterator[Line]:
    y = MARGIN
    for text in wrapped(explanation.headline, most, SIZE, bold=True):
        y += LINE
        yield Line("title", text, MARGIN, y - 4)
    when = f"{explanation.robot}, {date_and_clock(explanation.at_ns)}"
    for text in wrapped(when, most, SIZE):
        y += LINE
        yield Line("note", text, MARGIN, y - 4)


def _column_heads(columns: Columns, y: float) -> Iterator[Line]:
    for number, kind in enumerate(columns.kinds):
        if kind not in columns.kinds[:number]:
            yield Line("note", HEADS[kind], MARGIN + number * (BOX + BETWEEN), y)


def _notes(graph: Graph, columns: Columns, y: float) -> Iterator[Line]:
    """Say how much is not shown, below its column."""
    for more, number in ((graph.more_causes, 0), (graph.more_symptoms, len(columns.slots) - 1)):
        if more:
            yield Line("note", f"and {more} more", MARGIN + number * (BOX + BETWEEN), y)


def _strokes(columns: Columns, places: Mapping[str, Place]) -> Iterator[Stroke]:
    """Yield the lines, those of what leads last, so that they lie above the others."""
    for slot in (slot for slots in columns.slots for slot in slots if slot.lane):
        x, y, height = places[slot.id]
        yield Stroke(f"M{x:g} {y + height / 2:.1f}h{BOX:g}", leading=slot.leading)
    entries = _entries(columns.links, places)
    for link in sorted(columns.links, key=lambda link: link.leading):
        x, y, height = places[link.start]
        end_x, end_y, end_height = places[link.end]
        x, y, end_y = x + BOX, y + height / 2, end_y + end_height * entries[link]
        bend = BETWEEN / 2
        curve = f"C{x + bend:g} {y:.1f} {end_x - bend:g} {end_y:.1f} {end_x:g} {end_y:.1f}"
        tip = None if link.into_lane else (end_x, end_y)
        yield Stroke(f"M{x:g} {y:.1f}{curve}", link.missing, link.leading, tip)


def _entries(links: Sequence[Link], places: Mapping[str, Place]) -> dict[Link, float]:
    """Return at what share of a box's height each line enters it, in the order they come."""
    into: dict[str, list[Link]] = {}
    for link in links:
        into.setdefault(link.end, []).append(link)
    entries = {}
    for of in into.values():
        for place, link in enumerate(sorted(of, key=lambda link: places[link.start][1]), 1):
            entries[link] = place / (len(of) + 1)
    return entries


def text_width(line: Line) -> float:
    """Return how wide a line of text is at most."""
    size = SMALL if line.kind == "small" else SIZE
    return width(line.text, size, bold=line.kind == "title")
