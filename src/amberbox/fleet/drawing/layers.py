"""Layered layout: boxes in ranks, lines between them that cross no box.

Ranks by longest path, order by barycentres, places by least squares (after Sugiyama, Tagawa, Toda:
Methods for visual understanding of hierarchical system structures, 1981). A line that passes a
rank runs through a lane of its own there; lines from one box share their lanes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from amberbox.fleet.drawing.crossings import ordered
from amberbox.fleet.drawing.marks import Turn
from amberbox.fleet.drawing.ranks import backward, ranks
from amberbox.fleet.drawing.spread import spread

LANE = 4.0
PORT = 9.0
"""How far apart lines enter a box at most."""


@dataclass(frozen=True, slots=True)
class Box:
    """Something that takes room."""

    id: str
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Gaps:
    """How much is left between ranks, and between boxes of one rank."""

    ranks: float = 64
    boxes: float = 16


@dataclass(frozen=True, slots=True)
class Route:
    """The line of a link: its path, where its arrow ends, and whether it closes a circle."""

    path: str
    tip: tuple[float, float]
    turn: Turn
    broken: bool = False


@dataclass(frozen=True, slots=True)
class Layout:
    """Upper left corners of boxes by id, the route of each link in the order of the links."""

    width: float
    height: float
    corners: Mapping[str, tuple[float, float]]
    routes: tuple[Route, ...]


NO_GAPS = Gaps()


def layered(
    boxes: Sequence[Box], links: Sequence[tuple[str, str]], *, down: bool = False,
    gaps: Gaps = NO_GAPS, first: Collection[str] = (), last: Collection[str] = (),
) -> Layout:  # fmt: skip
    """Lay out boxes and the links between them, left to right or top down.

    Boxes of ``first`` to which nothing leads stand in the first rank, those of ``last`` from which
    nothing leads in the last. Boxes without a link stand in rows after all others.
    Raises KeyError for a link to a box that there is not.
    """
    joined = {name for link in links for name in link}.union(first, last)
    main = [box for box in boxes if box.id in joined]
    single = [box for box in boxes if box.id not in joined]
    plan = _plan(main, links, (first, last), down=down)
    layout = _placed(plan, main, gaps, down=down)
    return _with_rows(layout, single, gaps) if single else layout


@dataclass(frozen=True, slots=True)
class _Plan:
    """Items (boxes, then lanes) by rank in order, and the items that each link passes."""

    order: list[list[int]]
    above: list[list[int]]
    below: list[list[int]]
    passes: list[list[int]]
    broken: set[int]
    sizes: list[float]


def _plan(
    boxes: Sequence[Box], links: Sequence[tuple[str, str]],
    ends: tuple[Collection[str], Collection[str]], *, down: bool,
) -> _Plan:  # fmt: skip
    numbers = {box.id: number for number, box in enumerate(boxes)}
    pairs = [(numbers[start], numbers[end]) for start, end in links]
    broken = backward(len(boxes), pairs)
    turned = [(e, s) if place in broken else (s, e) for place, (s, e) in enumerate(pairs)]
    straight = list(dict.fromkeys((start, end) for start, end in turned if start != end))
    first, last = ({numbers[name] for name in names if name in numbers} for names in ends)
    rank_of = ranks(len(boxes), straight, first, last)
    rows: list[list[int]] = [[] for _ in range(max(rank_of, default=-1) + 1)]
    for number, rank in enumerate(rank_of):
        rows[rank].append(number)
    passes = _passes(turned, rank_of, rows)
    above, below = _neighbours(passes, sum(map(len, rows)))
    sizes = [box.width if down else box.height for box in boxes]
    sizes += [LANE] * (len(above) - len(sizes))
    return _Plan(ordered(rows, above, below), above, below, passes, broken, sizes)


def _passes(
    links: Sequence[tuple[int, int]], rank_of: Sequence[int], rows: list[list[int]]
) -> list[list[int]]:
    """Return the items from start to end of each link; lanes are added to the rows."""
    lanes: dict[tuple[int, int], int] = {}
    count = len(rank_of)
    passes = []
    for start, end in links:
        items = [start]
        for rank in range(rank_of[start] + 1, rank_of[end]):
            if (start, rank) not in lanes:
                lanes[start, rank] = count + len(lanes)
                rows[rank].append(lanes[start, rank])
            items.append(lanes[start, rank])
        passes.append([*items, end])
    return passes


def _neighbours(
    passes: Sequence[Sequence[int]], count: int
) -> tuple[list[list[int]], list[list[int]]]:
    above: list[list[int]] = [[] for _ in range(count)]
    below: list[list[int]] = [[] for _ in range(count)]
    for start, end in dict.fromkeys(pair for items in passes for pair in pairwise(items)):
        if start != end:
            above[end].append(start)
            below[start].append(end)
    return above, below


@dataclass(frozen=True, slots=True)
class _Spot:
    """Where an item stands: along the ranks from ``near`` to ``far``, across in the middle.

    ``edge`` is where its rank ends.
    """

    near: float
    far: float
    edge: float
    middle: float
    size: float


def _placed(plan: _Plan, boxes: Sequence[Box], gaps: Gaps, *, down: bool) -> Layout:
    count = len(boxes)
    lanes = [number >= count for number in range(len(plan.sizes))]
    middles = spread(plan.order, plan.above, plan.below, plan.sizes, gaps.boxes, lanes)
    spots: dict[int, _Spot] = {}
    along = 0.0
    for items in plan.order:
        depth = max((_depth(boxes[i], down=down) for i in items if i < count), default=0.0)
        for item in items:
            long = depth if lanes[item] else _depth(boxes[item], down=down)
            spots[item] = _Spot(along, along + long, along + depth, middles[item], plan.sizes[item])
        along += depth + gaps.ranks
    corners = {box.id: _corner(spots[number], down=down) for number, box in enumerate(boxes)}
    across = max((spot.middle + spot.size / 2 for spot in spots.values()), default=0.0)
    size = (across, max(0.0, along - gaps.ranks))
    routes = tuple(_routes(plan, spots, down=down))
    return Layout(*(size if down else size[::-1]), corners, routes)


def _depth(box: Box, *, down: bool) -> float:
    return box.height if down else box.width


def _corner(spot: _Spot, *, down: bool) -> tuple[float, float]:
    across = spot.middle - spot.size / 2
    return (across, spot.near) if down else (spot.near, across)


def _routes(plan: _Plan, spots: Mapping[int, _Spot], *, down: bool) -> Iterator[Route]:
    ports = _ports(plan, spots)
    for place, items in enumerate(plan.passes):
        broken = place in plan.broken
        points = _points(items, spots, ports[place])
        if items[0] == items[-1]:
            points = _loop(spots[items[0]])
        shown = [point if not down else point[::-1] for point in points]
        ahead: Turn = 90 if down else 0
        back: Turn = 270 if down else 180
        run = shown[::-1] if broken else shown
        yield Route(_path(run, down=down), run[-1], back if broken else ahead, broken)


Point = tuple[float, float]


def _points(items: Sequence[int], spots: Mapping[int, _Spot], port: float) -> list[Point]:
    """Return where a line passes: out of its box, in and out of each lane, into its box."""
    start, end = spots[items[0]], spots[items[-1]]
    lanes = (spots[item] for item in items[1:-1])
    through = [(along, lane.middle) for lane in lanes for along in (lane.near, lane.far)]
    out = dict.fromkeys(((start.far, start.middle), (start.edge, start.middle)))
    return [*out, *through, (end.near, port)]


def _loop(spot: _Spot) -> list[Point]:
    """Return the line of a box to itself: out at its far end and back beside."""
    return [(spot.far, spot.middle + spot.size / 4), (spot.far, spot.middle - spot.size / 4)]


def _ports(plan: _Plan, spots: Mapping[int, _Spot]) -> list[float]:
    """Return where each line enters its box: beside each other, in the order they come."""
    into: dict[int, list[int]] = {}
    for place, items in enumerate(plan.passes):
        into.setdefault(items[-1], []).append(place)
    ports = [0.0] * len(plan.passes)
    for end, places in into.items():
        spot = spots[end]
        step = min(PORT, spot.size * 0.7 / len(places))
        places.sort(key=lambda place: spots[plan.passes[place][-2]].middle)
        for number, place in enumerate(places):
            ports[place] = spot.middle + step * (number - (len(places) - 1) / 2)
    return ports


def _path(points: Sequence[Point], *, down: bool) -> str:
    """Return a smooth line: straight through lanes, curved between ranks."""
    steps = [f"M{_at(points[0])}"]
    for (x, y), (end_x, end_y) in pairwise(points):
        bend_x, bend_y = (x + end_x) / 2, (y + end_y) / 2
        if (x, y)[not down] == (end_x, end_y)[not down]:
            steps.append(f"L{_at((end_x, end_y))}")
        elif (x, y)[down] == (end_x, end_y)[down]:  # a loop beside its box
            steps.append(_bow((x, y), (end_x, end_y), down=down))
        elif down:
            steps.append(f"C{_at((x, bend_y))} {_at((end_x, bend_y))} {_at((end_x, end_y))}")
        else:
            steps.append(f"C{_at((bend_x, y))} {_at((bend_x, end_y))} {_at((end_x, end_y))}")
    return "".join(steps)


def _bow(start: Point, end: Point, *, down: bool) -> str:
    out = (0.0, 28.0) if down else (28.0, 0.0)
    bends = (_at((x + out[0], y + out[1])) for x, y in (start, end))
    return f"C{' '.join(bends)} {_at(end)}"


def _at(point: Point) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _with_rows(layout: Layout, boxes: Sequence[Box], gaps: Gaps) -> Layout:
    """Return the layout with rows of boxes below it."""
    most = max(layout.width, 720.0)
    x, y = 0.0, layout.height + (2 * gaps.boxes if layout.height else 0.0)
    wide, row = layout.width, 0.0
    corners = dict(layout.corners)
    for box in boxes:
        if x and x + box.width > most:
            x, y, row = 0.0, y + row + gaps.boxes, 0.0
        corners[box.id] = (x, y)
        wide, row = max(wide, x + box.width), max(row, box.height)
        x += box.width + gaps.boxes
    return Layout(wide, y + row, corners, layout.routes)
