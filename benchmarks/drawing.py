"""How long it takes to lay out and draw the largest diagrams."""

from __future__ import annotations

import random
from collections.abc import Sequence

from amberbox.core.layered_layout import LayoutBox, layered
from amberbox.server.drawing.graph import ComponentBox, DependencyEdge, dependency_graph
from amberbox.server.web.text import drawing_words
from benchmarks.common import Row, cpu_s

NODES = 500
LINKS = 700
TARGET_MS = 100


def measure() -> list[Row]:
    """Lay out graphs of 500 boxes of three shapes, and draw one."""
    boxes = [LayoutBox(str(number), 180, 46) for number in range(NODES)]
    graphs = {"far links": _far(), "deep": _deep(), "wide": _wide()}
    rows = [_row(f"layout, {kind}", boxes, links) for kind, links in graphs.items()]
    components = [ComponentBox(box.id, f"component {box.id}", "error") for box in boxes]
    edges = [DependencyEdge(start, end) for start, end in _wide()]
    seconds = cpu_s(
        lambda: str(dependency_graph(components, edges, label="all", words=drawing_words()))
    )
    return [*rows, Row("layout and SVG, wide", seconds * 1e3, "ms")]


def _row(name: str, boxes: Sequence[LayoutBox], links: Sequence[tuple[str, str]]) -> Row:
    seconds = cpu_s(lambda: layered(boxes, links))
    note = f"{NODES} boxes, {len(links)} links, target: {TARGET_MS} ms"
    return Row(name, seconds * 1e3, "ms", note=note)


def _far() -> list[tuple[str, str]]:
    """Return links between any boxes."""
    pick = random.Random(1)
    pairs = [sorted(pick.sample(range(NODES), 2)) for _ in range(LINKS)]
    return _unique(pairs)


def _deep() -> list[tuple[str, str]]:
    """Return links between boxes that are near: some sixty ranks."""
    pick = random.Random(2)
    starts = [pick.randrange(NODES - 20) for _ in range(LINKS)]
    return _unique([[start, start + pick.randrange(1, 20)] for start in starts])


def _wide() -> list[tuple[str, str]]:
    """Return links of a tree with some more: five ranks."""
    pick = random.Random(3)
    ends = [*range(1, NODES), *(pick.randrange(3, NODES) for _ in range(LINKS - NODES))]
    return _unique([[pick.randrange(end // 3 + 1), end] for end in ends])


def _unique(pairs: Sequence[Sequence[int]]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((str(start), str(end)) for start, end in pairs if start != end))
