"""Draw an explanation as one self-contained SVG image."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from amberbox.core.layered_layout import neighbours, ranks, swept, with_lanes
from amberbox.core.svg import SIZE, SMALL, SVG, SvgElement, element, title, wrap_text
from amberbox.core.units import percent
from amberbox.diagnosis.report.explanation import CausalGraph, Explanation, GraphNode, NodeKind
from amberbox.diagnosis.report.wording import date_and_clock

PASSES = 4  # how often columns are put in order by where their neighbours stand


@dataclass(frozen=True, slots=True)
class _Link:
    """A line from one column to the next, between items of the layout."""

    start: int
    end: int
    missing: bool = False
    leading: bool = False
    into_lane: bool = False


@dataclass(frozen=True, slots=True)
class _Columns:
    """Nodes by their numbers, then lanes, from left to right and top to bottom, and the lines.

    ``lanes`` is true for each lane of a leading hypothesis.
    """

    items: list[list[int]]
    kinds: tuple[NodeKind, ...]
    links: tuple[_Link, ...]
    lanes: Mapping[int, bool]


def _columns_of(graph: CausalGraph) -> _Columns:
    """Put causes left, symptoms right, and lost functions between them by their distance.

    The first column keeps its order, the most probable causes first, and so does the last, present
    symptoms first.
    """
    numbers = {node.id: number for number, node in enumerate(graph.nodes)}
    pairs = [(numbers[edge.start], numbers[edge.end]) for edge in graph.edges]
    symptoms = [number for number, node in enumerate(graph.nodes) if node.kind == "symptom"]
    levels = ranks(len(numbers), pairs, range(len(numbers)), symptoms)
    items: list[list[int]] = [[] for _ in range(max(levels, default=0) + 1)]
    for number, level in enumerate(levels):
        items[level].append(number)
    passes = with_lanes(pairs, levels, items)
    above, below = neighbours(passes, sum(map(len, items)))
    for turn in range(PASSES):
        items = swept(items, above, below, down=turn % 2 == 0, edge=1)
    between: list[NodeKind] = ["lost"] * (len(items) - 2)
    kinds: list[NodeKind] = ["cause", *between, "symptom"]
    leading = {edge.start for edge in graph.edges if edge.leading}
    links: dict[_Link, None] = {}
    lanes: dict[int, bool] = {}
    for edge, through in zip(graph.edges, passes, strict=True):
        lanes.update(dict.fromkeys(through[1:-1], edge.start in leading))
        for start, end in pairwise(through[:-1]):
            links[_Link(start, end, leading=lanes[end], into_lane=True)] = None
        links[_Link(through[-2], through[-1], edge.missing, edge.leading)] = None
    return _Columns(items, tuple(kinds[: len(items)]), tuple(links), lanes)


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


def layout(explanation: Explanation) -> Drawing:
    """Lay an explanation out."""
    graph = explanation.graph
    columns = _columns_of(graph)
    wide = 2 * MARGIN + len(columns.items) * BOX + (len(columns.items) - 1) * BETWEEN
    head = list(_head(explanation, wide - 2 * MARGIN))
    top = max((line.y for line in head), default=0.0) + 1.6 * LINE
    texts = [_texts(node) for node in graph.nodes]
    heights = [_height(node, *of) for node, of in zip(graph.nodes, texts, strict=True)]
    spots = _stacked(columns, heights, top + LINE / 2)
    boxes = [
        Box(node.mark or node.kind, spots[n].x, spots[n].y, BOX, heights[n], node.probability)
        for n, node in enumerate(graph.nodes)
    ]
    lines = [line for n, of in enumerate(texts) for line in _inside(spots[n], *of)]
    bottom = max((box.y + box.height for box in boxes), default=top)
    notes = list(_notes(graph, columns, bottom + LINE))
    high = max((line.y for line in (*head, *notes)), default=0.0)
    return Drawing(
        wide,
        max(high, bottom) + MARGIN,
        tuple(boxes),
        (*head, *_column_heads(columns, top), *lines, *notes),
        tuple(_strokes(columns, spots)),
    )


def _texts(node: GraphNode) -> tuple[list[str], list[str]]:
    """Break the texts of a node into lines, large and small ones."""
    number = "" if node.probability is None else f"{percent(node.probability)}: "
    mark = {"contradicted": "should show, and does not: ", "unexplained": "not explained: "}
    text = f"{mark.get(node.mark, number)}{node.text}"
    small = wrap_text(node.small, BOX - 2 * PAD, SMALL) if node.small else []
    return wrap_text(text, BOX - 2 * PAD, SIZE), small


def _height(node: GraphNode, main: Sequence[str], small: Sequence[str]) -> float:
    bar = 0.0 if node.probability is None else 12.0
    return 2 * PAD + LINE * len(main) + SMALL_LINE * len(small) + bar


class _Spot(NamedTuple):
    """Left, upper edge and height of a box or a lane."""

    x: float
    y: float
    height: float


def _stacked(columns: _Columns, of_boxes: Sequence[float], top: float) -> dict[int, _Spot]:
    """Stack every column, and put them at the same middle."""
    heights = [[LANE if i in columns.lanes else of_boxes[i] for i in of] for of in columns.items]
    totals = [sum(of) + APART * max(0, len(of) - 1) for of in heights]
    tallest = max(totals, default=0.0)
    spots = {}
    for number, items in enumerate(columns.items):
        y = top + (tallest - totals[number]) / 2
        for item, height in zip(items, heights[number], strict=True):
            spots[item] = _Spot(MARGIN + number * (BOX + BETWEEN), y, height)
            y += height + APART
    return spots


def _inside(spot: _Spot, main: Sequence[str], small: Sequence[str]) -> Iterator[Line]:
    y = spot.y + PAD
    for text in main:
        y += LINE
        yield Line("", text, spot.x + PAD, y - 4)
    for text in small:
        y += SMALL_LINE
        yield Line("small", text, spot.x + PAD, y - 4)


def _head(explanation: Explanation, most: float) -> Iterator[Line]:
    y = MARGIN
    when = f"{explanation.robot}, {date_and_clock(explanation.at_ns)}"
    for kind, words in (("title", explanation.headline), ("note", when)):
        for text in wrap_text(words, most, SIZE, bold=kind == "title"):
            y += LINE
            yield Line(kind, text, MARGIN, y - 4)


def _column_heads(columns: _Columns, y: float) -> Iterator[Line]:
    for number, kind in enumerate(columns.kinds):
        if kind not in columns.kinds[:number]:
            yield Line("note", HEADS[kind], MARGIN + number * (BOX + BETWEEN), y)


def _notes(graph: CausalGraph, columns: _Columns, y: float) -> Iterator[Line]:
    """Yield how much is not shown, below its column."""
    for more, number in ((graph.more_causes, 0), (graph.more_symptoms, len(columns.items) - 1)):
        if more:
            yield Line("note", f"and {more} more", MARGIN + number * (BOX + BETWEEN), y)


def _strokes(columns: _Columns, spots: Mapping[int, _Spot]) -> Iterator[Stroke]:
    """Yield the lines, those of leading hypotheses last, so that they are drawn above the
    others.
    """
    for item in (item for items in columns.items for item in items if item in columns.lanes):
        x, y, height = spots[item]
        yield Stroke(f"M{x:g} {y + height / 2:.1f}h{BOX:g}", leading=columns.lanes[item])
    entries = _entries(columns.links, spots)
    for link in sorted(columns.links, key=lambda link: link.leading):
        x, y, height = spots[link.start]
        end_x, end_y, end_height = spots[link.end]
        x, y, end_y = x + BOX, y + height / 2, end_y + end_height * entries[link]
        bend = BETWEEN / 2
        curve = f"C{x + bend:g} {y:.1f} {end_x - bend:g} {end_y:.1f} {end_x:g} {end_y:.1f}"
        tip = None if link.into_lane else (end_x, end_y)
        yield Stroke(f"M{x:g} {y:.1f}{curve}", link.missing, link.leading, tip)


def _entries(links: Sequence[_Link], spots: Mapping[int, _Spot]) -> dict[_Link, float]:
    """Return the height at which each line enters a box, as a share of it, in the order of
    origins.
    """
    into: dict[int, list[_Link]] = {}
    for link in links:
        into.setdefault(link.end, []).append(link)
    entries = {}
    for of in into.values():
        for place, link in enumerate(sorted(of, key=lambda link: spots[link.start].y), 1):
            entries[link] = place / (len(of) + 1)
    return entries


LIGHT = (
    ("text", "font-family:Helvetica,Arial,'Liberation Sans',sans-serif;fill:#1b1f24"),
    (".ground", "fill:#ffffff"),
    (".title", "font-weight:bold"),
    (".note,.small", "fill:#57606a"),
    (".box", "fill:#f6f8fa;stroke:#57606a;stroke-width:1"),
    (".leading,.present", "fill:#fff1d6;stroke:#8a4b00;stroke-width:2"),
    (".unexplained", "fill:#fde7f3;stroke:#99286e;stroke-width:2"),
    (".contradicted", "fill:#ffffff;stroke:#57606a;stroke-width:1.5;stroke-dasharray:5 4"),
    (".lost", "fill:#e7f0fb;stroke:#1f5fa8"),
    (".bar", "fill:#d0d7de"),
    (".share", "fill:#b35c00"),
    (".edge", "fill:none;stroke:#8c959f;stroke-width:1.2"),
    (".strong", "stroke:#8a4b00;stroke-width:1.8"),
    (".missing", "stroke-dasharray:5 4"),
    (".tip", "fill:#8c959f"),
    (".strongtip", "fill:#8a4b00"),
)
# Colours by kind; every rule counts only in images of ours, as pages may hold several
DARK = (
    ("text", "fill:#e6edf3"),
    (".ground", "fill:#0d1117"),
    (".note,.small", "fill:#a5afba"),
    (".box", "fill:#161b22;stroke:#8b949e"),
    (".leading,.present", "fill:#3a2500;stroke:#e0a13a"),
    (".unexplained", "fill:#3b1230;stroke:#e58ac0"),
    (".contradicted", "fill:#0d1117;stroke:#8b949e"),
    (".lost", "fill:#0f2440;stroke:#6ea8ec"),
    (".bar", "fill:#30363d"),
    (".share", "fill:#e0a13a"),
    (".edge", "stroke:#768390"),
    (".strong", "stroke:#e0a13a"),
    (".tip", "fill:#768390"),
    (".strongtip", "fill:#e0a13a"),
)


_PAPER = (
    "@page why{size:landscape;margin:10mm}"
    "@media print{:root.why{page:why;width:100%;height:auto;max-height:95vh}}"
)


def style() -> str:
    """Return the style sheet: light, and dark where the screen is; on paper as wide as that."""
    dark = f"@media screen and (prefers-color-scheme:dark){{{_rules(DARK)}}}"
    return f"{_rules(LIGHT)}{dark}{_PAPER}"


def _rules(rules: Sequence[tuple[str, str]]) -> str:
    return "".join(
        f"{','.join(f'.why {name}' for name in names.split(','))}{{{body}}}\n"
        for names, body in rules
    )


def as_svg(explanation: Explanation) -> str:
    """Draw causes on the left, lost functions in the middle, symptoms on the right.

    The image is self-contained and contains no script. It is as large as its contents, and follows
    the light or dark setting of the screen.
    """
    drawing = layout(explanation)
    size = {"width": f"{drawing.width:g}", "height": f"{drawing.height:g}"}
    parts = (
        title(explanation.headline),
        element("desc", _description(explanation)),
        f"<style>{style()}</style>",  # the only text that is written as it is
        element("rect", class_="ground", **size),
        *("".join(map(str, _drawn_stroke(stroke))) for stroke in drawing.strokes),
        *("".join(map(str, _drawn_box(box))) for box in drawing.boxes),
        *(
            element(
                "text", line.text, class_=line.kind, x=f"{line.x:g}", y=f"{line.y:g}",
                font_size=SMALL if line.kind == "small" else SIZE,
            )
            for line in drawing.lines
        ),
    )  # fmt: skip
    root = element(
        "svg", "", xmlns=SVG, viewBox=f"0 0 {' '.join(size.values())}", role="img", **size,
        class_="why",
    )  # fmt: skip
    return "\n".join((str(root).removesuffix("</svg>"), *map(str, parts), "</svg>", ""))


def _description(explanation: Explanation) -> str:
    """Return the contents of the image in words."""
    seen = [seen.text for seen in explanation.because]
    causes = [node.text for node in explanation.graph.nodes if node.kind == "cause"]
    return f"Possible causes: {'; '.join(causes)}. Symptoms explained: {'; '.join(seen)}."


def _drawn_stroke(stroke: Stroke) -> Iterator[SvgElement]:
    names = f"edge{' strong' * stroke.leading}{' missing' * stroke.missing}"
    yield element("path", class_=names, d=stroke.path)
    if stroke.tip is not None:
        x, y = stroke.tip
        kind = "strongtip" if stroke.leading else "tip"
        yield element("path", class_=kind, d=f"M{x:g} {y:g}l-7 -3.5v7z")


def _drawn_box(box: Box) -> Iterator[SvgElement]:
    x, y, height = f"{box.x:g}", f"{box.y:g}", f"{box.height:g}"
    wide = f"{box.width:g}"
    yield element("rect", class_=f"box {box.kind}", x=x, y=y, width=wide, height=height, rx=5)
    if box.share is not None:
        x, y, most = f"{box.x + 8:g}", f"{box.y + box.height - 12:g}", box.width - 16
        for kind, wide in (("bar", f"{most:g}"), ("share", f"{most * box.share:.1f}")):
            yield element("rect", class_=kind, x=x, y=y, height=5, width=wide)
