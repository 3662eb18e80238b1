"""A fault tree solved: for each of its parts a diagram of decisions and one of cut sets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from amberbox.diagnosis.faulttree.bdd import Diagram, reachable
from amberbox.diagnosis.faulttree.budget import Budget, ExhaustedError, check
from amberbox.diagnosis.faulttree.graph import FALSE, TRUE, Graph
from amberbox.diagnosis.faulttree.minimal import (
    Family,
    minimal_solutions,
    minimal_solutions_up_to,
)
from amberbox.diagnosis.faulttree.modules import Part, split
from amberbox.diagnosis.faulttree.ordering import orders

_FIRST_ALLOWANCE = 60_000
_FEWEST_ORDERS = 3
_GROWTH = 4
_COLLECT_ABOVE = 200_000


@dataclass(frozen=True, slots=True)
class Nodes:
    """A finished diagram: nodes from 2 on, branches before what uses them; 0 and 1 as ever."""

    levels: tuple[int, ...]
    highs: tuple[int, ...]
    lows: tuple[int, ...]

    @property
    def root(self) -> int:
        """Return the node that all others are below of."""
        return len(self.levels) - 1

    def __len__(self) -> int:
        return len(self.levels)

    def inner(self) -> Iterator[tuple[int, int, int]]:
        """Yield level, high and low branch of each node from 2 on."""
        return zip(self.levels[2:], self.highs[2:], self.lows[2:], strict=True)


@dataclass(frozen=True, slots=True)
class Solved:
    """One part: ``leaves`` by level are names of events or numbers of earlier parts."""

    leaves: tuple[str | int, ...]
    decisions: Nodes


def solve(graph: Graph, top: int, budget: Budget) -> list[Solved]:
    """Return the decision diagrams of all parts of a graph, the top one last.

    Raises ExhaustedError when the budget does not suffice.
    """
    solved: list[Solved] = []
    numbers: dict[int, int] = {}
    held = 0
    for part in split(graph, top):
        left = replace(budget, nodes=max(0, budget.nodes - held))
        order, decisions = _decisions(graph, part, left)
        leaves = tuple(
            numbers[leaf] if leaf in numbers else graph.vertices[leaf].event for leaf in order
        )
        numbers[part.vertex] = len(solved)
        solved.append(Solved(leaves, decisions))
        held += len(decisions)
    return solved


def cut_sets_of(solved: Sequence[Solved], limit: int | None, budget: Budget) -> list[Nodes]:
    """Return the diagrams of minimal cut sets of all parts.

    With ``limit`` those of more events are left out, but for some in parts that are found to
    have too many only when put together. Raises ExhaustedError when the budget does not suffice.
    """
    found: list[Nodes] = []
    smallest: list[int] = []
    held = 0
    for part in solved:
        weights = [smallest[leaf] if isinstance(leaf, int) else 1 for leaf in part.leaves]
        family = Family(replace(budget, nodes=max(0, budget.nodes - held)))
        bdd = _opened(part.decisions)
        if limit is None:
            root = minimal_solutions(bdd, part.decisions.root, family)
        else:
            root = minimal_solutions_up_to(bdd, part.decisions.root, family, limit, weights)
        check(budget, held + len(family))
        found.append(closed(family, root))
        smallest.append(_smallest(found[-1], weights))
        held += len(found[-1])
    return found


def closed(diagram: Diagram, root: int) -> Nodes:
    """Keep what is below a node, in few tuples."""
    if root < 2:
        return Nodes(tuple(diagram.levels[: root + 1]), (0, 1)[: root + 1], (0, 1)[: root + 1])
    stay = reachable(diagram.highs, diagram.lows, [root])
    moved = {0: 0, 1: 1} | {node: number for number, node in enumerate(stay, 2)}
    levels = (*diagram.levels[:2], *(diagram.levels[node] for node in stay))
    highs = (0, 1, *(moved[diagram.highs[node]] for node in stay))
    lows = (0, 1, *(moved[diagram.lows[node]] for node in stay))
    return Nodes(levels, highs, lows)


def _opened(nodes: Nodes) -> Diagram:
    return Diagram(Budget(), list(nodes.levels), list(nodes.highs), list(nodes.lows))


def _smallest(sets: Nodes, weights: Sequence[int]) -> int:
    """Return the order of the smallest set; of no set at all, more than any other."""
    none = 1 << 30
    best = [none, 0]
    for node in range(2, len(sets)):
        high = best[sets.highs[node]] + weights[sets.levels[node]]
        best.append(min(high, best[sets.lows[node]]))
    return best[sets.root]


def _decisions(graph: Graph, part: Part, budget: Budget) -> tuple[tuple[int, ...], Nodes]:
    """Build the diagram of a part: try all orders with few nodes, the better half with more.

    Better are those that came further through the gates before their nodes were used up.
    """
    candidates = orders(graph, part)
    allowance = _FIRST_ALLOWANCE
    while True:
        reached: list[int] = []
        for order in candidates:
            nodes = min(allowance, budget.nodes)
            try:
                return order, _build(graph, part, order, replace(budget, nodes=nodes))
            except ExhaustedError as error:
                if nodes == budget.nodes or budget.deadline():
                    raise
                reached.append(error.done)
        ranked = sorted(zip(reached, candidates, strict=True), key=lambda entry: -entry[0])
        candidates = [order for _, order in ranked[: max(_FEWEST_ORDERS, len(ranked) // 2)]]
        allowance *= _GROWTH


def _build(graph: Graph, part: Part, order: Sequence[int], budget: Budget) -> Nodes:
    bdd = Diagram(budget)
    made = {FALSE: 0, TRUE: 1}
    made |= {leaf: bdd.stored(level, 1, 0) for level, leaf in enumerate(order)}
    uses = _uses(graph, part)
    collected = _COLLECT_ABOVE
    for done, number in enumerate(part.inner):
        try:
            _add(bdd, graph, number, made)
        except ExhaustedError as error:
            raise ExhaustedError(error.reason, done) from error
        for entry in graph.vertices[number].inputs:
            uses[entry] -= 1
            if not uses[entry]:
                del made[entry]
        if len(bdd) > collected:
            moved = bdd.compact(made.values())
            made = {key: moved[node] for key, node in made.items()}
            collected = max(_COLLECT_ABOVE, 2 * len(bdd))
    return closed(bdd, made[part.vertex])


def _add(bdd: Diagram, graph: Graph, number: int, made: dict[int, int]) -> None:
    """Make the diagram of one gate of those of its inputs."""
    vertex = graph.vertices[number]
    inputs = [made[entry] for entry in vertex.inputs]
    made[number] = _gate(bdd, vertex.kind, inputs, vertex.count)
    check(bdd.budget, len(bdd))
    bdd.forget()


def _uses(graph: Graph, part: Part) -> dict[int, int]:
    uses: dict[int, int] = {}
    for number in part.inner:
        for entry in graph.vertices[number].inputs:
            uses[entry] = uses.get(entry, 0) + 1
    return uses


def _gate(bdd: Diagram, kind: str, inputs: Sequence[int], count: int) -> int:
    if kind == "and":
        return bdd.all_of(inputs)
    if kind == "or":
        return bdd.any_of(inputs)
    if kind == "atleast":
        return bdd.at_least(count, inputs)
    if kind == "not":
        return bdd.negation(inputs[0])
    return bdd.exclusive(inputs[0], inputs[1])
