"""A line as small as a word."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise

from amberbox.fleet.drawing.svg import Element, element, root

MOST = 100
PAD = 3.0

Point = tuple[float, float]


def spark(
    values: Sequence[float | None], *, label: str, size: tuple[float, float] = (96, 24)
) -> Element:
    """Draw a line through the values, which lie equally far apart.

    None and what is not finite leave a gap. Of more than 100 values the lowest and the highest of
    each part are kept.
    """
    points = list(_points(_reduced(values), size))
    line = element("path", class_="spark-line", d="".join(_runs(points)))
    last = next((point for point in reversed(points) if point), None)
    dot = element("circle", class_="spark-dot", cx=last[0], cy=last[1], r=2) if last else None
    return root("spark", size, label, (line if last else None, dot))


def _reduced(values: Sequence[float | None]) -> list[float | None]:
    """Return at most 100 values: of each part its extremes, in their order."""
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
        share = value / 2 - low / 2, high / 2 - low / 2  # halves: the range may be all there is
        part = share[0] / share[1] if share[1] else 0.5
        yield PAD + place * step, size[1] - PAD - part * (size[1] - 2 * PAD)


def _runs(points: Sequence[Point | None]) -> Iterator[str]:
    """Yield the path of each run without a gap; a single value is a short line."""
    for known, run in groupby(points, key=lambda point: point is not None):
        if not known:
            continue
        places = [f"{point[0]:.1f} {point[1]:.1f}" for point in run if point]
        yield f"M{'L'.join(places)}" if len(places) > 1 else f"M{places[0]}h.1"
