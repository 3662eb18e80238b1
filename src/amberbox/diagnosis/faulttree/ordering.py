"""Orders of the variables of a decision diagram: on them depends whether it is small or huge.

None is good for all trees, and no figure foretells which is good for one, so there are several to
try: walks from left to right with different inputs first; by how high in the tree an event is
used, which suits long chains of needs; and each of them improved by moving every variable to the
middle of the gates that use it (Aloul, Markov & Sakallah, "FORCE", 2003).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from amberbox.diagnosis.faulttree.graph import Graph
from amberbox.diagnosis.faulttree.modules import Part

_ROUNDS = 20


def orders(graph: Graph, part: Part) -> list[tuple[int, ...]]:
    """Return orders of the leaves of a part; those that are most often good come first."""
    inputs = {number: graph.vertices[number].inputs for number in part.inner}
    if len(part.leaves) < 3 or len(part.inner) < 2:
        return [part.leaves]
    uses, sizes = _uses(inputs), _sizes(inputs)
    shared_first = _walk(part.vertex, inputs, lambda entry: -uses[entry])
    large_first = _walk(part.vertex, inputs, lambda entry: -sizes.get(entry, 0))
    small_first = _walk(part.vertex, inputs, lambda entry: sizes.get(entry, 0))
    plain = _walk(part.vertex, inputs, lambda entry: 0)
    heights = _by_place(plain, inputs, _heights(inputs), max)
    middles = _by_place(plain, inputs, _heights(inputs), _mean)
    depths = _by_place(plain, inputs, _depths(part.vertex, inputs), max)
    found = [shared_first, large_first, heights, plain, depths, small_first, middles]
    improvable = (shared_first, plain, heights, depths, large_first)
    found += [_forced(order, inputs) for order in improvable]
    return list(dict.fromkeys(found))


def _uses(inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by vertex how many gates use it."""
    uses: dict[int, int] = {}
    for entries in inputs.values():
        for entry in entries:
            uses[entry] = uses.get(entry, 0) + 1
    return uses


def _sizes(inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by gate how much is below it, what is shared counted again and again."""
    sizes: dict[int, int] = {}
    for number, entries in inputs.items():  # inputs come before what uses them
        sizes[number] = 1 + sum(sizes.get(entry, 1) for entry in entries)
    return sizes


def _heights(inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by gate the longest way down."""
    heights: dict[int, int] = {}
    for number, entries in inputs.items():
        heights[number] = 1 + max(heights.get(entry, 0) for entry in entries)
    return heights


def _depths(top: int, inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by gate the longest way up, negative: what is near the top is the highest."""
    depths = {top: 0}
    for number in reversed(list(inputs)):
        for entry in inputs[number]:
            depths[entry] = min(depths.get(entry, 0), depths[number] - 1)
    return depths


def _mean(values: Sequence[int]) -> float:
    return sum(values) / len(values)


def _by_place(
    order: Sequence[int],
    inputs: Mapping[int, Sequence[int]],
    places: Mapping[int, int],
    among: Callable[[Sequence[int]], float],
) -> tuple[int, ...]:
    """Sort leaves by how high the gates stand that use them, the highest first."""
    users: dict[int, list[int]] = {leaf: [] for leaf in order}
    for number, entries in inputs.items():
        for entry in entries:
            if entry in users:
                users[entry].append(places[number])
    return tuple(sorted(order, key=lambda leaf: -among(users[leaf])))


def _walk(
    top: int, inputs: Mapping[int, Sequence[int]], key: Callable[[int], float]
) -> tuple[int, ...]:
    leaves: dict[int, None] = {}
    seen: set[int] = set()
    waiting = [top]
    while waiting:
        number = waiting.pop()
        if number not in inputs:
            leaves[number] = None
        elif number not in seen:
            seen.add(number)
            waiting += sorted(inputs[number], key=key)[::-1]  # ties stay left to right
    return tuple(leaves)


def _forced(order: tuple[int, ...], inputs: Mapping[int, Sequence[int]]) -> tuple[int, ...]:
    """Improve an order: gates to the middle of what they join, what they join towards the gates."""
    best, best_span = order, _span(order, inputs)
    for _ in range(_ROUNDS):
        order = _moved(order, inputs)
        span = _span(order, inputs)
        if span >= best_span:
            break
        best, best_span = order, span
    return best


def _moved(order: tuple[int, ...], inputs: Mapping[int, Sequence[int]]) -> tuple[int, ...]:
    place = {leaf: float(n) for n, leaf in enumerate(order)}
    pulls: dict[int, list[float]] = {leaf: [] for leaf in order}
    for number, entries in inputs.items():
        place[number] = sum(place[entry] for entry in entries) / len(entries)
        for entry in entries:
            if entry in pulls:
                pulls[entry].append(place[number])
    return tuple(sorted(order, key=lambda leaf: sum(pulls[leaf]) / len(pulls[leaf])))


def _span(order: Sequence[int], inputs: Mapping[int, Sequence[int]]) -> int:
    """Add up how far the events of each gate lie apart."""
    ranges = {leaf: (n, n) for n, leaf in enumerate(order)}
    total = 0
    for number, entries in inputs.items():
        first = min(ranges[entry][0] for entry in entries)
        last = max(ranges[entry][1] for entry in entries)
        ranges[number] = first, last
        total += last - first
    return total
