"""Orders of the variables of a decision diagram: on them depends whether it is small or huge.

Candidates are walks from left to right with different inputs first, and each of them improved by
moving every variable to the middle of the gates that use it (Aloul, Markov & Sakallah, "FORCE",
2003). They are tried with the one first whose gates span the fewest other variables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from amberbox.diagnosis.faulttree.graph import Graph
from amberbox.diagnosis.faulttree.modules import Part

_ROUNDS = 20


def orders(graph: Graph, part: Part) -> list[tuple[int, ...]]:
    """Return orders of the leaves of a part, the most promising one first."""
    inputs = {number: graph.vertices[number].inputs for number in part.inner}
    if len(part.leaves) < 3 or len(part.inner) < 2:
        return [part.leaves]
    walks = [_walk(part.vertex, inputs, key) for key in _keys(inputs)]
    forced = [_forced(order, inputs) for order in walks]
    distinct = dict.fromkeys([*walks, *forced])
    return sorted(distinct, key=lambda order: _span(order, inputs))


def _keys(inputs: Mapping[int, Sequence[int]]) -> list[Callable[[int], float]]:
    """Return by what the inputs of a gate may be sorted before they are walked."""
    uses: dict[int, int] = {}
    for entries in inputs.values():
        for entry in entries:
            uses[entry] = uses.get(entry, 0) + 1
    sizes: dict[int, int] = {}
    for number, entries in inputs.items():  # inputs come before what uses them
        sizes[number] = 1 + sum(sizes.get(entry, 1) for entry in entries)
    return [
        lambda entry: 0,
        lambda entry: sizes.get(entry, 0),
        lambda entry: -sizes.get(entry, 0),
        lambda entry: -uses.get(entry, 0),
    ]


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
