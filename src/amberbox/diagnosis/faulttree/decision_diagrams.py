"""Binary decision diagrams of fault trees, and zero-suppressed ones of their minimal cut sets.

None of it uses recursion; it stops when the budget of nodes or time is spent.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.contracts import Budget
from amberbox.diagnosis.faulttree.graph import (
    FALSE,
    TRUE,
    FaultGraph,
    FaultGraphVertex,
    FaultTreeModule,
    variable_orders,
)

CHECK_EVERY = 4096  # steps between two checks of the deadline; a power of two
# The most nodes that are held at a time by default, of up to 200 bytes each
MOST_NODES = 2_400_000


class ExhaustedError(Exception):
    """A budget was used up; ``reason`` names it, in words for the result.

    ``done`` counts the operations on two diagrams that were begun; ``order`` is the most promising
    order of the variables.
    """

    def __init__(self, reason: str, done: int = 0, order: tuple[int, ...] = ()) -> None:
        super().__init__(reason)
        self.reason = reason
        self.done = done
        self.order = order


def check_budget(budget: Budget, held: int) -> None:
    """Raise ExhaustedError when ``held`` nodes are too many or time is up."""
    most = budget.most_nodes(MOST_NODES)
    if held > most:
        raise ExhaustedError(f"more than {most:,} nodes")
    if budget.is_over():
        raise ExhaustedError("the time was up")


BELOW = 1 << 30  # the level of the two constants: below all variables

_SHIFT = 32
_MASK = (1 << _SHIFT) - 1
_LOOK = CHECK_EVERY - 1
_SHARE_OF_CACHE = 4


@dataclass
class Diagram:
    """Nodes of a diagram: the level of the variable, and its true and false branches.

    The budget bounds the number of nodes and cached results together. ``steps`` counts operations
    on two nodes: every order of the variables needs the same number of them for a tree.
    """

    budget: Budget
    levels: list[int] = field(default_factory=lambda: [BELOW, BELOW])
    highs: list[int] = field(default_factory=lambda: [0, 1])
    lows: list[int] = field(default_factory=lambda: [0, 1])
    tables: dict[int, dict[int, int]] = field(default_factory=dict)
    caches: tuple[dict[int, int], dict[int, int]] = field(default_factory=lambda: ({}, {}))
    steps: int = 0

    def __len__(self) -> int:
        return len(self.levels)

    def node(self, level: int, high: int, low: int) -> int:
        """Return the node of a decision; none is needed when both branches are the same."""
        return low if high == low else self.stored(level, high, low)

    def stored(self, level: int, high: int, low: int) -> int:
        """Return the one node of these branches."""
        table = self.tables.setdefault(level, {})
        found = table.setdefault(high << _SHIFT | low, len(self.levels))
        if found == len(self.levels):
            self.levels.append(level)
            self.highs.append(high)
            self.lows.append(low)
        return found

    def conjunction(self, left: int, right: int) -> int:
        """Return the AND of two nodes."""
        return self._combine(left, right, 0)

    def disjunction(self, left: int, right: int) -> int:
        """Return the OR of two nodes."""
        return self._combine(left, right, 1)

    def negation(self, root: int) -> int:
        """Return the NOT of a node."""
        opposite = {0: 1, 1: 0}
        for node in reachable(self.highs, self.lows, [root]):
            high, low = opposite[self.highs[node]], opposite[self.lows[node]]
            opposite[node] = self.node(self.levels[node], high, low)
        check_budget(self.budget, len(self))
        return opposite[root]

    def exclusive(self, left: int, right: int) -> int:
        """Return the XOR of two nodes."""
        only_left = self.conjunction(left, self.negation(right))
        return self.disjunction(only_left, self.conjunction(self.negation(left), right))

    def all_of(self, nodes: Iterable[int]) -> int:
        """Return the AND of many nodes, those with the lowest variables first."""
        result = 1
        for node in self._from_below(nodes):
            result = self.conjunction(node, result)
        return result

    def any_of(self, nodes: Iterable[int]) -> int:
        """Return the OR of many nodes, as ``all_of`` does the AND."""
        result = 0
        for node in self._from_below(nodes):
            result = self.disjunction(node, result)
        return result

    def at_least(self, count: int, nodes: Sequence[int]) -> int:
        """Return the node that is true when ``count`` or more of the nodes are."""
        reached = [1] + [0] * count  # [k]: k or more of those seen so far
        left = len(nodes)
        for node in self._from_below(nodes):
            left -= 1
            for k in range(count, max(0, count - left - 1), -1):
                one_more = self.conjunction(node, reached[k - 1])
                reached[k] = self.disjunction(one_more, reached[k])
        return reached[count]

    def _from_below(self, nodes: Iterable[int]) -> list[int]:
        return sorted(nodes, key=lambda node: self.levels[node], reverse=True)

    def _combine(self, left: int, right: int, absorbing: int) -> int:  # noqa: C901 (one hot loop)
        """Compute AND (``absorbing`` 0) or OR (1) of two nodes.

        ``todo`` is a stack of pairs to compute, as one number, and below them, inverted, the pair
        whose two branches they are. The code is one loop because most of the time is spent in it.
        """
        self.steps += 1
        levels, highs, lows, tables = self.levels, self.highs, self.lows, self.tables
        cache = self.caches[absorbing]
        todo = [left << _SHIFT | right if left < right else right << _SHIFT | left]
        done: list[int] = []
        while todo:
            key = todo.pop()
            if key < 0:
                key = ~key
                f, g = levels[key >> _SHIFT], levels[key & _MASK]
                high, low = done.pop(), done.pop()
                if high == low:
                    result = low
                else:
                    level = f if f < g else g
                    table = tables.get(level)
                    if table is None:
                        table = tables[level] = {}
                    pair = high << _SHIFT | low
                    result = table.get(pair, -1)
                    if result < 0:
                        result = table[pair] = len(levels)
                        levels.append(level)
                        highs.append(high)
                        lows.append(low)
                cache[key] = result
                if not len(cache) & _LOOK:
                    check_budget(self.budget, len(levels) + len(cache))
                done.append(result)
                continue
            f, g = key >> _SHIFT, key & _MASK
            if f < 2:
                done.append(absorbing if f == absorbing else g)
                continue
            if f == g:
                done.append(f)
                continue
            known = cache.get(key, -1)
            if known >= 0:
                done.append(known)
                continue
            if levels[f] == levels[g]:
                f1, f0, g1, g0 = highs[f], lows[f], highs[g], lows[g]
            elif levels[f] < levels[g]:
                f1, f0, g1, g0 = highs[f], lows[f], g, g
            else:
                f1, f0, g1, g0 = f, f, highs[g], lows[g]
            todo.append(~key)
            todo.append(f1 << _SHIFT | g1 if f1 < g1 else g1 << _SHIFT | f1)
            todo.append(f0 << _SHIFT | g0 if f0 < g0 else g0 << _SHIFT | f0)
        return done[0]

    def forget(self) -> None:
        """Drop remembered results when they take a good part of the budget."""
        for cache in self.caches:
            if len(cache) > self.budget.most_nodes(MOST_NODES) // _SHARE_OF_CACHE:
                cache.clear()

    def compact(self, roots: Iterable[int]) -> dict[int, int]:
        """Keep only the nodes below ``roots``; return the new number of every remaining node."""
        levels, highs, lows = self.levels, self.highs, self.lows
        stay = reachable(highs, lows, roots)
        self.levels, self.highs, self.lows, self.tables = [BELOW, BELOW], [0, 1], [0, 1], {}
        for cache in self.caches:
            cache.clear()
        moved = {0: 0, 1: 1}
        for node in stay:
            moved[node] = self.stored(levels[node], moved[highs[node]], moved[lows[node]])
        return moved


def reachable(highs: Sequence[int], lows: Sequence[int], roots: Iterable[int]) -> list[int]:
    """Return the nodes below ``roots`` without the two constants, branches first."""
    seen = {0, 1}
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting += (highs[node], lows[node])
    return sorted(seen - {0, 1})


class ZeroSuppressedDiagram(Diagram):
    """A diagram of sets of which none contains another."""

    def node(self, level: int, high: int, low: int) -> int:
        """Return the node of a variable; none is needed when no set contains it."""
        return low if high == 0 else self.stored(level, high, low)

    def without(self, sets: int, others: int) -> int:
        """Return the sets that contain none of the others.

        ``todo`` is a stack of pairs to compute as one number, and inverted the operations on
        results: even numbers make the node of a pair, odd ones remove further sets from the last
        result.
        """
        levels, highs, lows = self.levels, self.highs, self.lows
        cache = self.caches[0]
        todo = [sets << _SHIFT | others]
        done: list[int] = []
        while todo:
            key = todo.pop()
            if key < 0:
                key = ~key
                if key & 1:
                    todo.append(done.pop() << _SHIFT | key >> 1)
                    continue
                key >>= 1
                low, high = done.pop(), done.pop()
                level = levels[key >> _SHIFT]
                result = cache[key] = low if high == 0 else self.stored(level, high, low)
                if not len(cache) & _LOOK:
                    check_budget(self.budget, len(levels) + len(cache))
                done.append(result)
                continue
            f, g = key >> _SHIFT, key & _MASK
            level = levels[f]
            while levels[g] < level:  # sets with a variable that none of ours has
                g = lows[g]
            if f == 0 or g == 0 or f == g or g == 1:
                done.append(f if g == 0 else 0)
                continue
            if f == 1:
                done.append(1)
                continue
            key = f << _SHIFT | g
            known = cache.get(key, -1)
            if known >= 0:
                done.append(known)
            elif levels[g] == level:
                todo += (~(key << 1), lows[f] << _SHIFT | lows[g])
                todo += (~(lows[g] << 1 | 1), highs[f] << _SHIFT | highs[g])
            else:
                todo += (~(key << 1), lows[f] << _SHIFT | g, highs[f] << _SHIFT | g)
        return done[0]


def minimal_solutions(bdd: Diagram, root: int, family: ZeroSuppressedDiagram) -> int:
    """Return the minimal sets of events that make ``root`` true while all others do not happen.

    For a coherent tree these are its minimal cut sets; with NOT and XOR they are the positive
    parts of its minimal solutions.
    """
    sets = {0: 0, 1: 1}
    for node in reachable(bdd.highs, bdd.lows, [root]):
        high, low = sets[bdd.highs[node]], sets[bdd.lows[node]]
        sets[node] = family.node(bdd.levels[node], family.without(high, low), low)
        family.forget()
    return sets[root]


def minimal_solutions_up_to(
    bdd: Diagram, root: int, family: ZeroSuppressedDiagram, limit: int, orders: Sequence[int]
) -> int:
    """Return those minimal solutions that have at most ``limit`` events.

    ``orders`` is, by level, the least number of events of a variable.
    """
    needed: dict[int, set[int]] = {root: {limit}}
    inner = reachable(bdd.highs, bdd.lows, [root])
    for node in reversed(inner):
        for left in needed[node]:
            needed.setdefault(bdd.lows[node], set()).add(left)
            needed.setdefault(bdd.highs[node], set()).add(left - orders[bdd.levels[node]])
    sets: dict[tuple[int, int], int] = {}
    for node in (0, 1, *inner):
        for left in needed.get(node, ()):
            sets[node, left] = _limited(bdd, node, left, family, sets, orders)
        family.forget()
    return sets[root, limit]


def _limited(
    bdd: Diagram,
    node: int,
    left: int,
    family: ZeroSuppressedDiagram,
    sets: dict[tuple[int, int], int],
    orders: Sequence[int],
) -> int:
    if node < 2 or left < 0:
        return node if left >= 0 else 0
    level = bdd.levels[node]
    high = sets[bdd.highs[node], left - orders[level]]
    low = sets[bdd.lows[node], left]
    return family.node(level, family.without(high, low), low)


# Nodes that orders of the variables are tried with, and how many orders; then the best get all
_TRIALS = (60_000, 99), (300_000, 4)
_BEST_ORDERS = 2
# A part of whose operations the trials did less than this will hardly be solved: it gets less time
_HOPEFUL = 0.9
_TIME_OF_HOPELESS = 0.25
_COLLECT_ABOVE = 200_000


@dataclass(frozen=True, slots=True)
class DiagramNodes:
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
class SolvedModule:
    """One part: ``leaves`` by level are names of events or numbers of earlier parts."""

    leaves: tuple[str | int, ...]
    decisions: DiagramNodes


def solve(
    graph: FaultGraph, parts: Iterable[FaultTreeModule], budget: Budget
) -> Iterator[SolvedModule]:
    """Yield the decision diagrams of the parts of a graph (``split_modules``), the top one last.

    Raises ExhaustedError when the budget does not suffice.
    """
    numbers: dict[int, int] = {}
    held = 0
    for part in parts:
        left = _left(budget, held)
        order, decisions = _decisions(graph, part, left)
        leaves = tuple(
            numbers[leaf] if leaf in numbers else graph.vertices[leaf].event for leaf in order
        )
        numbers[part.vertex] = len(numbers)
        held += len(decisions)
        yield SolvedModule(leaves, decisions)


def cut_sets_of(
    solved: Sequence[SolvedModule], limit: int | None, budget: Budget
) -> list[DiagramNodes]:
    """Return the diagrams of minimal cut sets of all parts.

    With ``limit`` those of more events are left out, but for some in parts that are found to
    have too many only when put together. Raises ExhaustedError when the budget does not suffice.
    """
    found: list[DiagramNodes] = []
    smallest: list[int] = []
    held = 0
    for part in solved:
        weights = [smallest[leaf] if isinstance(leaf, int) else 1 for leaf in part.leaves]
        family = ZeroSuppressedDiagram(_left(budget, held))
        nodes = part.decisions
        bdd = Diagram(Budget(), list(nodes.levels), list(nodes.highs), list(nodes.lows))
        if limit is None:
            root = minimal_solutions(bdd, part.decisions.root, family)
        else:
            root = minimal_solutions_up_to(bdd, part.decisions.root, family, limit, weights)
        check_budget(budget, held + len(family))
        found.append(finish_diagram(family, root))
        smallest.append(_smallest(found[-1], weights))
        held += len(found[-1])
    return found


def _left(budget: Budget, held: int) -> Budget:
    return replace(budget, nodes=max(0, budget.most_nodes(MOST_NODES) - held))


def finish_diagram(diagram: Diagram, root: int) -> DiagramNodes:
    """Keep the nodes below a node, in few tuples."""
    if root < 2:
        return DiagramNodes(
            tuple(diagram.levels[: root + 1]), (0, 1)[: root + 1], (0, 1)[: root + 1]
        )
    stay = reachable(diagram.highs, diagram.lows, [root])
    moved = {0: 0, 1: 1} | {node: number for number, node in enumerate(stay, 2)}
    levels = (*diagram.levels[:2], *(diagram.levels[node] for node in stay))
    highs = (0, 1, *(moved[diagram.highs[node]] for node in stay))
    lows = (0, 1, *(moved[diagram.lows[node]] for node in stay))
    return DiagramNodes(levels, highs, lows)


def _smallest(sets: DiagramNodes, weights: Sequence[int]) -> int:
    """Return the order of the smallest set; of no set at all, more than any other."""
    none = 1 << 30
    best = [none, 0]
    for node in range(2, len(sets)):
        high = best[sets.highs[node]] + weights[sets.levels[node]]
        best.append(min(high, best[sets.lows[node]]))
    return best[sets.root]


def _decisions(
    graph: FaultGraph, part: FaultTreeModule, budget: Budget
) -> tuple[tuple[int, ...], DiagramNodes]:
    """Build the diagram of a part: try all orders with few nodes, the best ones with more.

    An order is better if more of the operations were done before its nodes were used up.
    """
    candidates = variable_orders(graph, part)
    hopeful = _HOPEFUL * sum(operations_of_gate(graph.vertices[number]) for number in part.inner)
    most = budget.most_nodes(MOST_NODES)
    reason = ""
    for allowance, count in (*_TRIALS, (most, _BEST_ORDERS)):
        reached: list[int] = []
        for order in candidates[:count]:
            nodes = min(allowance, most)
            try:
                return order, _build(graph, part, order, replace(budget, nodes=nodes))
            except ExhaustedError as error:
                reason = error.reason
                if budget.is_over():
                    raise ExhaustedError(reason, error.done, candidates[0]) from error
                reached.append(error.done)
        ranked = sorted(zip(reached, candidates, strict=False), key=lambda entry: -entry[0])
        candidates = [order for _, order in ranked]
        if allowance >= most:
            break
        if allowance == _TRIALS[-1][0] and ranked[0][0] < hopeful:
            budget = budget.until(_TIME_OF_HOPELESS)
    raise ExhaustedError(reason, 0, candidates[0])


def _build(
    graph: FaultGraph, part: FaultTreeModule, order: Sequence[int], budget: Budget
) -> DiagramNodes:
    bdd = Diagram(budget)
    made = {FALSE: 0, TRUE: 1}
    made |= {leaf: bdd.stored(level, 1, 0) for level, leaf in enumerate(order)}
    uses = _uses(graph, part)
    collected = _COLLECT_ABOVE
    for number in part.inner:
        try:
            _add(bdd, graph, number, made)
        except ExhaustedError as error:
            raise ExhaustedError(error.reason, bdd.steps) from error
        for entry in graph.vertices[number].inputs:
            uses[entry] -= 1
            if not uses[entry]:
                del made[entry]
        if len(bdd) > collected:
            moved = bdd.compact(made.values())
            made = {key: moved[node] for key, node in made.items()}
            collected = max(_COLLECT_ABOVE, 2 * len(bdd))
    return finish_diagram(bdd, made[part.vertex])


def _add(bdd: Diagram, graph: FaultGraph, number: int, made: dict[int, int]) -> None:
    """Make the diagram of one gate of those of its inputs."""
    vertex = graph.vertices[number]
    inputs = [made[entry] for entry in vertex.inputs]
    made[number] = gate_of_diagrams(bdd, vertex.kind, inputs, vertex.count)
    check_budget(bdd.budget, len(bdd))
    bdd.forget()


def operations_of_gate(vertex: FaultGraphVertex) -> int:
    """Return how many operations on two diagrams make the one of a gate."""
    size, count = len(vertex.inputs), vertex.count
    if vertex.kind == "atleast":
        return 2 * sum(min(count, size - place) for place in range(size))
    return {"not": 0, "xor": 3}.get(vertex.kind, size)


def _uses(graph: FaultGraph, part: FaultTreeModule) -> dict[int, int]:
    uses: dict[int, int] = {}
    for number in part.inner:
        for entry in graph.vertices[number].inputs:
            uses[entry] = uses.get(entry, 0) + 1
    return uses


def gate_of_diagrams(bdd: Diagram, kind: str, inputs: Sequence[int], count: int) -> int:
    """Return the node of a gate of these inputs."""
    if kind == "and":
        return bdd.all_of(inputs)
    if kind == "or":
        return bdd.any_of(inputs)
    if kind == "atleast":
        return bdd.at_least(count, inputs)
    return bdd.negation(inputs[0]) if kind == "not" else bdd.exclusive(inputs[0], inputs[1])
