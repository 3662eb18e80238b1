"""Walks through diagrams of cut sets, part by part, without recursion."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

from amberbox.diagnosis.faulttree.compiled import Nodes

_NEVER = (float("inf"), 0)
Cost = tuple[float, int]
"""What an event still costs: first what counts, then how many events are missing."""


class _Chosen(NamedTuple):
    """The events taken so far, the last one first."""

    event: str
    before: _Chosen | None


class _Open(NamedTuple):
    """A node to go on with when a part is finished, those after it, and what all of these need.

    ``orders`` are the numbers of events it can take, as bits; ``cost`` the least it can cost.
    """

    part: int
    node: int
    after: _Open | None
    orders: int
    cost: Cost


def walk(
    leaves: Sequence[Sequence[str | int]], sets: Sequence[Nodes], order: int
) -> Iterator[frozenset[str]]:
    """Yield the sets of exactly ``order`` events."""
    orders = _orders(leaves, sets)
    waiting: list[tuple[int, int, int, _Chosen | None, _Open | None]] = []

    def go(part: int, node: int, left: int, chosen: _Chosen | None, after: _Open | None) -> None:
        possible = orders[part][node]
        if left >= 0 and (_both(possible, after.orders) if after else possible) >> left & 1:
            waiting.append((part, node, left, chosen, after))

    last = len(sets) - 1
    go(last, sets[last].root, order, None, None)
    while waiting:
        part, node, left, chosen, after = waiting.pop()
        if node == 1:
            if after is None:
                yield _listed(chosen)
            else:
                go(after.part, after.node, left, chosen, after.after)
            continue
        leaf, high = leaves[part][sets[part].levels[node]], sets[part].highs[node]
        go(part, sets[part].lows[node], left, chosen, after)
        if isinstance(leaf, str):
            go(part, high, left - 1, _Chosen(leaf, chosen), after)
        else:
            possible = orders[part][high]
            possible = _both(possible, after.orders) if after else possible
            go(leaf, sets[leaf].root, left, chosen, _Open(part, high, after, possible, _NEVER))


def cheapest(
    leaves: Sequence[Sequence[str | int]], sets: Sequence[Nodes], cost: Callable[[str], Cost]
) -> Iterator[tuple[Cost, frozenset[str]]]:
    """Yield sets with the sum of the costs of their events, the cheapest first.

    Best first with the exact rest, so that little more is looked at than what is returned. Sets
    of infinite cost are left out.
    """
    least = _least(leaves, sets, cost)
    waiting: list[tuple[Cost, int, Cost, int, int, _Chosen | None, _Open | None]] = []
    pushed = 0

    def go(part: int, node: int, spent: Cost, chosen: _Chosen | None, after: _Open | None) -> None:
        nonlocal pushed
        rest = _plus(least[part][node], after.cost) if after else least[part][node]
        estimate = _plus(spent, rest)
        if estimate[0] < _NEVER[0]:
            pushed += 1
            heapq.heappush(waiting, (estimate, -pushed, spent, part, node, chosen, after))

    last = len(sets) - 1
    go(last, sets[last].root, (0.0, 0), None, None)
    while waiting:
        _, _, spent, part, node, chosen, after = heapq.heappop(waiting)
        if node == 1:
            if after is None:
                yield spent, _listed(chosen)
            else:
                go(after.part, after.node, spent, chosen, after.after)
            continue
        leaf, high = leaves[part][sets[part].levels[node]], sets[part].highs[node]
        go(part, sets[part].lows[node], spent, chosen, after)
        if isinstance(leaf, str):
            go(part, high, _plus(spent, cost(leaf)), _Chosen(leaf, chosen), after)
        else:
            rest = _plus(least[part][high], after.cost) if after else least[part][high]
            go(leaf, sets[leaf].root, spent, chosen, _Open(part, high, after, 0, rest))


def _orders(leaves: Sequence[Sequence[str | int]], sets: Sequence[Nodes]) -> list[list[int]]:
    """Return, by part and node, which numbers of events its sets have, as bits."""
    of_part: list[list[int]] = []
    for names, nodes in zip(leaves, sets, strict=True):
        own = [of_part[leaf][-1] if isinstance(leaf, int) else 2 for leaf in names]
        values = [0, 1][: len(nodes)]
        for level, high, low in nodes.inner():
            values.append(_both(own[level], values[high]) | values[low])
        of_part.append(values)
    return of_part


def _least(
    leaves: Sequence[Sequence[str | int]], sets: Sequence[Nodes], cost: Callable[[str], Cost]
) -> list[list[Cost]]:
    """Return, by part and node, what its cheapest set costs."""
    of_part: list[list[Cost]] = []
    for names, nodes in zip(leaves, sets, strict=True):
        own = [of_part[leaf][-1] if isinstance(leaf, int) else cost(leaf) for leaf in names]
        values = [_NEVER, (0.0, 0)][: len(nodes)]
        for level, high, low in nodes.inner():
            values.append(min(_plus(own[level], values[high]), values[low]))
        of_part.append(values)
    return of_part


@lru_cache(maxsize=4096)
def _both(left: int, right: int) -> int:
    """Return the sums of a number of one and a number of the other, all as bits."""
    result = 0
    while right:
        lowest = right & -right
        result |= left * lowest
        right ^= lowest
    return result


def _plus(left: Cost, right: Cost) -> Cost:
    return left[0] + right[0], left[1] + right[1]


def _listed(chosen: _Chosen | None) -> frozenset[str]:
    events = []
    while chosen is not None:
        events.append(chosen.event)
        chosen = chosen.before
    return frozenset(events)
