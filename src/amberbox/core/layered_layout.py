"""Layered layout of a graph: boxes in ranks, few crossings, lines that cross no box."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

Turn: TypeAlias = Literal[0, 90, 180, 270]  # where an arrow points: right, down, left, up

Links = Sequence[tuple[int, int]]  # links between boxes by their numbers


def backward(count: int, links: Links) -> set[int]:
    """Return the links (by place) that close a circle when boxes are walked in their order."""
    outgoing: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for place, (start, end) in enumerate(links):
        outgoing[start].append((end, place))
    state = [0] * count
    found: set[int] = set()
    for box in _entrances(count, links):
        if not state[box]:
            _walk(box, outgoing, state, found)
    return found


def _entrances(count: int, links: Links) -> list[int]:
    """Return the numbers of the boxes, those without an incoming link first."""
    reached = {end for start, end in links if start != end}
    return sorted(range(count), key=lambda box: box in reached)


def _walk(
    box: int, outgoing: Sequence[list[tuple[int, int]]], state: list[int], found: set[int]
) -> None:
    """Walk in depth: a link to a box that is still open (1) leads back."""
    state[box] = 1
    path = [(box, iter(outgoing[box]))]
    while path:
        here, links = path[-1]
        for end, place in links:
            if state[end] == 1:
                found.add(place)
            elif not state[end]:
                state[end] = 1
                path.append((end, iter(outgoing[end])))
                break
        else:
            state[here] = 2
            path.pop()


def ranks(
    count: int, links: Links, first: Collection[int] = (), last: Collection[int] = ()
) -> list[int]:
    """Return the rank of each box: one after the last box that leads to it.

    ``links`` have no cycle. Boxes of ``last`` without an outgoing link are in the last rank; other
    boxes with more outgoing than incoming links are as close to their targets as possible, except
    those of ``first``.
    """
    outgoing: list[list[int]] = [[] for _ in range(count)]
    waiting = [0] * count
    for start, end in links:
        outgoing[start].append(end)
        waiting[end] += 1
    entering = list(waiting)
    found = [0] * count
    order = [box for box in range(count) if not waiting[box]]
    for box in order:
        for end in outgoing[box]:
            found[end] = max(found[end], found[box] + 1)
            waiting[end] -= 1
            if not waiting[end]:
                order.append(end)
    _to_the_end(found, outgoing, last)
    for box in reversed(order):
        if len(outgoing[box]) > entering[box] and box not in first:
            found[box] = min(found[end] for end in outgoing[box]) - 1
    return _from_zero(found)


def _to_the_end(found: list[int], outgoing: Sequence[Sequence[int]], last: Collection[int]) -> None:
    movable = [box for box in last if not outgoing[box]]
    others = max((rank for box, rank in enumerate(found) if box not in set(movable)), default=-1)
    end = max(others + 1, max((found[box] for box in movable), default=0))
    for box in movable:
        found[box] = end


def _from_zero(found: list[int]) -> list[int]:
    """Number the ranks that are used from 0, without holes."""
    used = {rank: place for place, rank in enumerate(sorted(set(found)))}
    return [used[rank] for rank in found]


SWEEPS = 4  # how often all ranks are put in order, down and up each time (Sugiyama et al. 1981).

Near = Sequence[Sequence[int]]  # the neighbours of each item in the rank before it or after it

Order = list[list[int]]  # the items of each rank


def ordered(ranks: Order, above: Near, below: Near) -> Order:
    """Return the ranks in the best order that was found; the given order breaks ties."""
    best = order = _by_walk(ranks, below)
    fewest = crossings(order, below, len(above))
    for _ in range(SWEEPS):
        if not fewest:
            break
        order = swept(swept(order, above, below, down=True), above, below, down=False)
        count = crossings(order, below, len(above))
        if count >= fewest:
            break
        best, fewest = order, count
    return best


def crossings(order: Order, below: Near, count: int) -> int:
    """Return how many pairs of lines between neighbouring ranks cross."""
    places = _places(order, count)
    total = 0
    for items in order:
        ends: list[int] = []
        for item in items:
            targets = sorted([places[end] for end in below[item]])
            for place in targets:  # those of one item do not cross each other
                total += len(ends) - bisect_right(ends, place)
            for place in targets:
                insort(ends, place)
    return total


def _by_walk(ranks: Order, below: Near) -> Order:
    """Return the ranks in the order of a depth-first walk, so that connected boxes are adjacent."""
    rank_of = {item: rank for rank, items in enumerate(ranks) for item in items}
    order: Order = [[] for _ in ranks]
    seen: set[int] = set()
    for entrance in (item for items in ranks for item in items):
        waiting = [entrance]
        while waiting:
            item = waiting.pop()
            if item not in seen:
                seen.add(item)
                order[rank_of[item]].append(item)
                waiting += reversed(below[item])
    return order


def swept(order: Order, above: Near, below: Near, *, down: bool, edge: int = 0) -> Order:
    """Return the ranks, each sorted by the middles of its neighbours in the one before.

    The first and the last ``edge`` ranks keep their order.
    """
    swept = list(order)
    near = above if down else below
    first, last = max(edge, down), len(order) - max(edge, not down)
    for rank in range(first, last) if down else range(last - 1, first - 1, -1):
        before = {item: place for place, item in enumerate(swept[rank - 1 if down else rank + 1])}
        middles = {item: _middle(near[item], before) for item in swept[rank]}
        swept[rank] = _sorted(swept[rank], middles)
    return swept


def _middle(items: Sequence[int], places: dict[int, int]) -> float | None:
    return sum(places[item] for item in items) / len(items) if items else None


def _sorted(items: list[int], middles: dict[int, float | None]) -> list[int]:
    """Sort by the middles; an item without one keeps its place."""
    moving = iter(sorted(
        (item for item in items if middles[item] is not None), key=lambda i: middles[i] or 0.0
    ))  # fmt: skip
    return [item if middles[item] is None else next(moving) for item in items]


def _places(order: Order, count: int) -> list[int]:
    places = [0] * count
    for items in order:
        for place, item in enumerate(items):
            places[item] = place
    return places


PASSES = 6
STRAIGHT = 8.0  # weight of aligning a lane with a lane, relative to a box with a box


def spread(order: Order, above: Near, below: Near, sizes: Sequence[float], gaps: float,
           lanes: Sequence[bool]) -> list[float]:  # fmt: skip
    """Return the middle of each item, the least upper edge at 0.

    ``sizes`` are how much room each takes, ``gaps`` how much is between two boxes; beside a lane
    half of it is enough.
    """
    middles = [0.0] * len(sizes)
    steps = [_steps(items, sizes, gaps, lanes) for items in order]
    for items, offsets in zip(order, steps, strict=True):
        for item, offset in zip(items, offsets, strict=True):
            middles[item] = offset - offsets[-1] / 2
    for turn in range(PASSES):
        down = turn % 2 == 0
        pairs = list(zip(order, steps, strict=True))
        for items, offsets in pairs if down else reversed(pairs):
            near = _near(turn, above, below)
            _settle(items, offsets, near, middles, lanes)
    edge = min((middle - size / 2 for middle, size in zip(middles, sizes, strict=True)), default=0)
    return [middle - edge for middle in middles]


def _near(turn: int, above: Near, below: Near) -> tuple[Near, ...]:
    """Return the neighbours that count: the rank before in the pass's direction, at last both."""
    if turn >= PASSES - 2:
        return (above, below)
    return (above,) if turn % 2 == 0 else (below,)


def _steps(
    items: Sequence[int], sizes: Sequence[float], gaps: float, lanes: Sequence[bool]
) -> list[float]:
    """Return the least distance of each item from the first one, middle to middle."""
    offsets = [0.0]
    for before, item in pairwise(items):
        gap = gaps / 2 if lanes[before] or lanes[item] else gaps
        offsets.append(offsets[-1] + (sizes[before] + sizes[item]) / 2 + gap)
    return offsets[: len(items)]


def _settle(
    items: Sequence[int], offsets: Sequence[float], near: Sequence[Near], middles: list[float],
    lanes: Sequence[bool],
) -> None:  # fmt: skip
    wishes, weights = [], []
    for item, offset in zip(items, offsets, strict=True):
        wish, weight = _wish(item, near, middles, lanes)
        wishes.append(wish - offset)
        weights.append(weight)
    for item, offset, place in zip(items, offsets, rising(wishes, weights), strict=True):
        middles[item] = place + offset


def _wish(
    item: int, near: Sequence[Near], middles: Sequence[float], lanes: Sequence[bool]
) -> tuple[float, float]:
    """Return the preferred middle of an item and its weight; without neighbours where it is."""
    total = weight = 0.0
    for side in near:
        for other in side[item]:
            pull = STRAIGHT if lanes[item] and lanes[other] else 1.0
            total += pull * middles[other]
            weight += pull
    return (total / weight, weight) if weight else (middles[item], 0.1)


def rising(wishes: Sequence[float], weights: Sequence[float]) -> list[float]:
    """Return the rising sequence nearest to the wished places in least squares.

    Neighbours that would overtake each other are pooled (pool adjacent violators; Ayer et al.
    1955).
    """
    pools: list[tuple[float, float, int]] = []
    for wish, weight in zip(wishes, weights, strict=True):
        mean, mass, count = wish, weight, 1
        while pools and pools[-1][0] > mean:
            other, more, members = pools.pop()
            mean = (mean * mass + other * more) / (mass + more)
            mass, count = mass + more, count + members
        pools.append((mean, mass, count))
    return [mean for mean, _, count in pools for _ in range(count)]


LANE = 4.0
PORT = 9.0  # how far apart lines enter a box at most


@dataclass(frozen=True, slots=True)
class LayoutBox:
    """A box of the graph with its size."""

    id: str
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class LayoutGaps:
    """The space between ranks, and between boxes of one rank."""

    ranks: float = 64
    boxes: float = 16


@dataclass(frozen=True, slots=True)
class LinkRoute:
    """The line of a link: its path, where its arrow ends, and whether it closes a circle."""

    path: str
    tip: tuple[float, float]
    turn: Turn
    broken: bool = False


@dataclass(frozen=True, slots=True)
class GraphLayout:
    """Upper left corners of boxes by id, the route of each link in the order of the links."""

    width: float
    height: float
    corners: Mapping[str, tuple[float, float]]
    routes: tuple[LinkRoute, ...]


NO_GAPS = LayoutGaps()


def layered(
    boxes: Sequence[LayoutBox], links: Sequence[tuple[str, str]], *, down: bool = False,
    gaps: LayoutGaps = NO_GAPS, first: Collection[str] = (), last: Collection[str] = (),
) -> GraphLayout:  # fmt: skip
    """Lay out boxes and the links between them, left to right or top down.

    Boxes of ``first`` without an incoming link are in the first rank, boxes of ``last`` without an
    outgoing link in the last. Boxes without any link are in rows after all others. Raises KeyError
    for a link to an unknown box.
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
    boxes: Sequence[LayoutBox], links: Sequence[tuple[str, str]],
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
    passes = with_lanes(turned, rank_of, rows)
    above, below = neighbours(passes, sum(map(len, rows)))
    sizes = [box.width if down else box.height for box in boxes]
    sizes += [LANE] * (len(above) - len(sizes))
    return _Plan(ordered(rows, above, below), above, below, passes, broken, sizes)


def with_lanes(
    links: Sequence[tuple[int, int]], rank_of: Sequence[int], rows: list[list[int]]
) -> list[list[int]]:
    """Return the items from start to end of each link; lanes are added to the rows.

    A lane is where the links from one box pass a rank.
    """
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


def neighbours(
    passes: Sequence[Sequence[int]], count: int
) -> tuple[list[list[int]], list[list[int]]]:
    """Return which items lead to each item, and to which each leads."""
    above: list[list[int]] = [[] for _ in range(count)]
    below: list[list[int]] = [[] for _ in range(count)]
    for start, end in dict.fromkeys(pair for items in passes for pair in pairwise(items)):
        if start != end:
            above[end].append(start)
            below[start].append(end)
    return above, below


@dataclass(frozen=True, slots=True)
class _Spot:
    """Position of an item: from ``near`` to ``far`` along the ranks, and its centre across them.

    ``edge`` is where its rank ends.
    """

    near: float
    far: float
    edge: float
    middle: float
    size: float


def _placed(
    plan: _Plan, boxes: Sequence[LayoutBox], gaps: LayoutGaps, *, down: bool
) -> GraphLayout:
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
    return GraphLayout(*(size if down else size[::-1]), corners, routes)


def _depth(box: LayoutBox, *, down: bool) -> float:
    return box.height if down else box.width


def _corner(spot: _Spot, *, down: bool) -> tuple[float, float]:
    across = spot.middle - spot.size / 2
    return (across, spot.near) if down else (spot.near, across)


def _routes(plan: _Plan, spots: Mapping[int, _Spot], *, down: bool) -> Iterator[LinkRoute]:
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
        yield LinkRoute(_path(run, down=down), run[-1], back if broken else ahead, broken)


Point = tuple[float, float]


def _points(items: Sequence[int], spots: Mapping[int, _Spot], port: float) -> list[Point]:
    """Return where a line passes: out of its box, in and out of each lane, into its box."""
    start, end = spots[items[0]], spots[items[-1]]
    lanes = (spots[item] for item in items[1:-1])
    through = [(along, lane.middle) for lane in lanes for along in (lane.near, lane.far)]
    out = dict.fromkeys(((start.far, start.middle), (start.edge, start.middle)))
    return [*out, *through, (end.near, port)]


def _loop(spot: _Spot) -> list[Point]:
    """Return the line from a box to itself: out at its far end and back at its side."""
    return [(spot.far, spot.middle + spot.size / 4), (spot.far, spot.middle - spot.size / 4)]


def _ports(plan: _Plan, spots: Mapping[int, _Spot]) -> list[float]:
    """Return where each line enters its box: side by side, in the order of their origins."""
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


def _with_rows(layout: GraphLayout, boxes: Sequence[LayoutBox], gaps: LayoutGaps) -> GraphLayout:
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
    return GraphLayout(wide, y + row, corners, layout.routes)
