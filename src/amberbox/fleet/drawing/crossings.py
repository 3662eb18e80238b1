"""The order of boxes in their ranks, so that few lines cross (barycentre sweeps)."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Sequence

SWEEPS = 4
"""How often all ranks are put in order, down and up each time (Sugiyama et al. 1981)."""

Near = Sequence[Sequence[int]]
"""The neighbours of each item in the rank before it or after it."""

Order = list[list[int]]
"""The items of each rank."""


def ordered(ranks: Order, above: Near, below: Near) -> Order:
    """Return the ranks in the best order that was found; the given order breaks ties."""
    best = order = _by_walk(ranks, below)
    fewest = crossings(order, below, len(above))
    for _ in range(SWEEPS):
        if not fewest:
            break
        order = _swept(_swept(order, above, below, down=True), above, below, down=False)
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
    """Return the ranks in the order of a walk in depth: what belongs together comes together."""
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


def _swept(order: Order, above: Near, below: Near, *, down: bool) -> Order:
    """Return the ranks, each sorted by the middles of its neighbours in the one before."""
    swept = list(order)
    near = above if down else below
    numbers = range(1, len(order)) if down else range(len(order) - 2, -1, -1)
    for rank in numbers:
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
