"""Analyse a fault tree: exact probability of the top event, importance, minimal cut sets.

Cut sets are counted, listed by size or cost, and ranked by how close they are to complete.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import islice
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from amberbox.core.config import raise_errors
from amberbox.core.contracts import Budget
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.faulttree.bounded import BoundedSearch, quick_bounds
from amberbox.diagnosis.faulttree.bounds import ProbabilityBounds, least_given, rough_bounds
from amberbox.diagnosis.faulttree.decision_diagrams import (
    DiagramNodes,
    ExhaustedError,
    SolvedModule,
    cut_sets_of,
    solve,
)
from amberbox.diagnosis.faulttree.graph import (
    FaultGraph,
    FaultTreeModule,
    build_fault_graph,
    coherent,
    split_modules,
)
from amberbox.diagnosis.faulttree.probable import ProbableCutSets, repairing_events, union_bounds
from amberbox.diagnosis.faulttree.tree import (
    BooleanConstant,
    FaultTree,
    Name,
    all_of,
    any_of,
    below,
    problems,
)

_NEVER = (float("inf"), 0)
# What an event still costs: first what counts, then how many events are missing
Cost = tuple[float, int]


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


def cut_sets_of_order(
    leaves: Sequence[Sequence[str | int]], sets: Sequence[DiagramNodes], order: int
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
                yield _chosen_events(chosen)
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


def cheapest_cut_sets(
    leaves: Sequence[Sequence[str | int]], sets: Sequence[DiagramNodes], cost: Callable[[str], Cost]
) -> Iterator[tuple[Cost, frozenset[str]]]:
    """Yield sets with the sum of the costs of their events, the cheapest first.

    Best first with the exact remaining cost, so that few other sets are visited. Sets of infinite
    cost are left out.
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
                yield spent, _chosen_events(chosen)
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


def _orders(leaves: Sequence[Sequence[str | int]], sets: Sequence[DiagramNodes]) -> list[list[int]]:
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
    leaves: Sequence[Sequence[str | int]], sets: Sequence[DiagramNodes], cost: Callable[[str], Cost]
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


def _chosen_events(chosen: _Chosen | None) -> frozenset[str]:
    events = []
    while chosen is not None:
        events.append(chosen.event)
        chosen = chosen.before
    return frozenset(events)


_MOST_TERMS = 400
_FEWEST_TERMS = 8
_MOST_WORK = 2_000_000  # nodes looked at: about a second
_SMALLEST_TERM = 1e-13


@dataclass(frozen=True)
class CutSets:
    """The minimal cut sets of a tree, iterable from small to large without listing them all.

    ``leaves`` and ``sets`` are by part (see ``compiled``), the top one last. With
    ``truncated_at`` sets of more events are left out.
    """

    leaves: tuple[tuple[str | int, ...], ...]
    sets: tuple[DiagramNodes, ...]
    truncated_at: int | None = None

    @cached_property
    def by_order(self) -> tuple[int, ...]:
        """Return how many sets have 0, 1, 2, ... events."""
        bits = max(1, int(self._sum(lambda event: 1)).bit_length())
        packed = int(self._sum(lambda event: 1 << bits))  # a polynomial, one slot per order
        counts: list[int] = []
        while packed and (self.truncated_at is None or len(counts) <= self.truncated_at):
            counts.append(packed & ((1 << bits) - 1))
            packed >>= bits
        while counts and not counts[-1]:
            counts.pop()
        return tuple(counts)

    @property
    def count(self) -> int:
        """Return the number of sets (may be too large for ``len``)."""
        return sum(self.by_order)

    def __iter__(self) -> Iterator[frozenset[str]]:
        """Yield the sets, those with the fewest events first."""
        for order, count in enumerate(self.by_order):
            if count:
                yield from cut_sets_of_order(self.leaves, self.sets, order)

    def rare_event_sum(self, of_event: Mapping[str, float]) -> float:
        """Return the sum of the probabilities of the sets: an upper bound, may exceed 1."""
        return self._power_sum(of_event, 1)

    def upper_bound(self, of_event: Mapping[str, float]) -> float | None:
        """Return the min cut upper bound, 1 - product of (1 - probability of each set).

        None if the sets are so probable, or so many, that computing it would take too long.
        """
        logarithm = 0.0
        work = sum(len(sets) for sets in self.sets)
        terms = min(_MOST_TERMS, max(_FEWEST_TERMS, _MOST_WORK // max(1, work)))
        for power in range(1, terms + 1):
            term = self._power_sum(of_event, power) / power
            logarithm += term
            if term <= _SMALLEST_TERM * logarithm:
                return -math.expm1(-logarithm)
            if logarithm > 50.0:  # 1 to the last digit
                return 1.0
        return None

    def _power_sum(self, of_event: Mapping[str, float], power: int) -> float:
        """Return the sum over all sets of their probability to a power."""
        if self.truncated_at is None:
            return float(self._sum(lambda event: of_event[event] ** power))
        size = self.truncated_at + 1
        by_order = self._sum(
            lambda event: np.array([0.0, of_event[event] ** power]),
            np.array([1.0]),
            lambda left, right: np.convolve(left, right)[:size],
            _added,
        )
        return float(np.sum(by_order[:size]))

    def _sum(
        self,
        of_event: Callable[[str], Any],
        one: Any = 1,
        product: Callable[[Any, Any], Any] = lambda left, right: left * right,
        total: Callable[[Any, Any], Any] = lambda left, right: left + right,
    ) -> Any:
        """Return the sum over all sets of the product over their events."""
        of_part: list[Any] = []
        for leaves, sets in zip(self.leaves, self.sets, strict=True):
            own = [of_part[leaf] if isinstance(leaf, int) else of_event(leaf) for leaf in leaves]
            values = [one * 0, one][: len(sets)]
            for level, high, low in sets.inner():
                values.append(total(product(own[level], values[high]), values[low]))
            of_part.append(values[-1])
        return of_part[-1]


def _added(left: Any, right: Any) -> Any:
    """Add two polynomials."""
    if len(left) < len(right):
        left, right = right, left
    result = left.copy()
    result[: len(right)] += right
    return result


# A difference below this share of the whole has lost too many digits and is computed again
_DOUBTFUL = 1e-6


@dataclass(frozen=True, slots=True)
class Importance:
    """How much a basic event e matters for the top event, as SCRAM defines it.

    ``mif`` P(top|e) - P(top|not e), ``cif`` mif * P(e) / P(top), ``dif`` P(e) * raw,
    ``raw`` P(top|e) / P(top), ``rrw`` P(top) / P(top|not e). Where P(top) is 0 all but ``mif``
    are NaN; ``rrw`` is infinite where without e nothing happens.
    """

    mif: float
    cif: float
    dif: float
    raw: float
    rrw: float


def top_probability(solved: Sequence[SolvedModule], of_event: Mapping[str, float]) -> float:
    """Return the exact probability of the top event; basic events are independent."""
    return _values(solved, of_event)[0][-1][-1]


def importance_of(
    solved: Sequence[SolvedModule], of_event: Mapping[str, float]
) -> dict[str, Importance]:
    """Return the importance of the given events, the most important (``cif``) first."""
    nodes, leaves = _values(solved, of_event)
    top = nodes[-1][-1]
    slopes = _slopes(solved, nodes, leaves)
    found = {}
    for event, chance in of_event.items():
        slope = slopes.get(event, 0.0)
        with_it, without = top + (1.0 - chance) * slope, top - chance * slope
        if slope and with_it <= _DOUBTFUL * top:
            with_it = top_probability(solved, {**of_event, event: 1.0})
        if slope and without <= _DOUBTFUL * top:
            without = top_probability(solved, {**of_event, event: 0.0})
        found[event] = _importance(top, chance, with_it, without, slope)
    return dict(sorted(found.items(), key=lambda entry: -_rank(entry[1])))


def _rank(entry: Importance) -> float:
    return entry.mif if math.isnan(entry.cif) else entry.cif


def _importance(
    top: float, chance: float, with_it: float, without: float, slope: float
) -> Importance:
    if top <= 0.0:
        return Importance(slope, math.nan, math.nan, math.nan, math.nan)
    raw = with_it / top
    rrw = top / without if without > 0.0 else math.inf
    return Importance(slope, slope * chance / top, chance * raw, raw, rrw)


def _values(
    solved: Sequence[SolvedModule], of_event: Mapping[str, float]
) -> tuple[list[list[float]], list[list[float]]]:
    """Return, by part, the probability of each node and of each leaf."""
    nodes: list[list[float]] = []
    leaves: list[list[float]] = []
    for part in solved:
        own = [nodes[leaf][-1] if isinstance(leaf, int) else of_event[leaf] for leaf in part.leaves]
        nodes.append(_of_nodes(part.decisions, own))
        leaves.append(own)
    return nodes, leaves


def _of_nodes(decisions: DiagramNodes, leaves: Sequence[float]) -> list[float]:
    values = [0.0, 1.0][: len(decisions)]
    for level, high, low in decisions.inner():
        chance = leaves[level]
        values.append(chance * values[high] + (1.0 - chance) * values[low])
    return values


def _slopes(
    solved: Sequence[SolvedModule],
    nodes: Sequence[Sequence[float]],
    leaves: Sequence[Sequence[float]],
) -> dict[str, float]:
    """Return by event how fast the top's probability grows with it: one pass from the top."""
    of_part = [0.0] * (len(solved) - 1) + [1.0]
    of_event: dict[str, float] = {}
    for number in reversed(range(len(solved))):
        part = solved[number]
        own = _leaf_slopes(part.decisions, of_part[number], nodes[number], leaves[number])
        for leaf, slope in zip(part.leaves, own, strict=True):
            if isinstance(leaf, int):
                of_part[leaf] += slope
            else:
                of_event[leaf] = of_event.get(leaf, 0.0) + slope
    return of_event


def _leaf_slopes(
    decisions: DiagramNodes, weight: float, values: Sequence[float], leaves: Sequence[float]
) -> list[float]:
    reached = [0.0] * len(decisions)
    reached[-1] = weight
    slopes = [0.0] * len(leaves)
    for node in range(len(decisions) - 1, 1, -1):
        level, high, low = decisions.levels[node], decisions.highs[node], decisions.lows[node]
        chance, share = leaves[level], reached[node]
        slopes[level] += share * (values[high] - values[low])
        reached[high] += share * chance
        reached[low] += share * (1.0 - chance)
    return slopes


@dataclass(frozen=True)
class Analysis:
    """The results for the top event of a fault tree.

    ``top_probability`` is exact for independent basic events; None when an event has no probability
    (they are in ``without_probability``) or the budget ended. ``cut_sets`` is None when the budget
    ended; those of a tree that is not ``coherent`` are the positive parts of its minimal solutions.
    ``truncated_at`` is the order limit if there was one: then larger cut sets are not counted.
    ``incomplete`` names the budget and what it ended; empty if the analysis is complete.

    What is not known exactly is bounded: ``bounds`` of the probability (both are the exact one
    where that is known), and ``probable`` instead of ``cut_sets``: those that are most probable.
    They are None only where no time was left.
    """

    tree: FaultTree
    gates: tuple[str, ...]
    events: tuple[str, ...]
    coherent: bool
    top_probability: float | None = None
    cut_sets: CutSets | None = None
    importance: Mapping[str, Importance] = field(default_factory=dict)
    truncated_at: int | None = None
    incomplete: str = ""
    without_probability: tuple[str, ...] = ()
    bounds: ProbabilityBounds | None = None
    probable: ProbableCutSets | None = None

    @property
    def minimal_cut_sets(self) -> int | None:
        """Return how many minimal cut sets were found, None if the search did not end."""
        return None if self.cut_sets is None else self.cut_sets.count

    @property
    def by_order(self) -> tuple[int, ...] | None:
        """Return how many of them have 0, 1, 2, ... events."""
        return None if self.cut_sets is None else self.cut_sets.by_order

    def rare_event_sum(self) -> float | None:
        """Return the sum of the probabilities of the cut sets: an upper bound, not the answer."""
        of_event = self._probabilities()
        if self.cut_sets is None or of_event is None:
            return None
        return self.cut_sets.rare_event_sum(of_event)

    def upper_bound(self) -> float | None:
        """Return the min cut upper bound: closer than the rare-event sum, not the answer."""
        of_event = self._probabilities()
        if self.cut_sets is None or of_event is None:
            return None
        return self.cut_sets.upper_bound(of_event)

    def _probabilities(self) -> dict[str, float] | None:
        return None if self.without_probability else _known(self.tree, self.events)


def analyse(
    tree: FaultTree,
    order_limit: int | None = None,
    importance: bool = False,
    budget: Budget | None = None,
) -> Analysis:
    """Solve a fault tree, exactly if the budget suffices.

    ``order_limit`` leaves cut sets of more events out; the probability stays exact. Raises
    ConfigurationError for a tree with a cycle, a gate without input, or the like. A budget that
    ends is no error: see ``Analysis.incomplete``.
    """
    raise_errors(problems(tree))
    budget = budget or Budget()
    graph, top = _graph(tree)
    gates, events = below(tree)
    unknown = tuple(name for name in events if tree.events[name].probability is None)
    known = Analysis(
        tree,
        tuple(gates),
        tuple(events),
        coherent(graph, top),
        truncated_at=order_limit,
        without_probability=unknown,
    )
    parts = split_modules(graph, top)
    solved: list[SolvedModule] = []
    try:
        solved.extend(solve(graph, parts, budget.until(_TIME_TO_BE_EXACT)))
    except ExhaustedError as error:
        known = replace(known, incomplete=f"probability and cut sets: {error.reason}")
        orders = {parts[len(solved)].vertex: error.order} if error.order else {}
        return _bounded(known, graph, parts, solved, budget, orders)
    if not unknown:
        known = _with_probability(known, solved, importance)
    time_share = _TIME_TO_BE_EXACT if unknown else _TIME_FOR_CUT_SETS
    known = _with_cut_sets(known, solved, budget.until(time_share))
    return _bounded(known, graph, parts, solved, budget) if known.incomplete else known


def _graph(tree: FaultTree) -> tuple[FaultGraph, int]:
    formulas = {name: gate.formula for name, gate in tree.gates.items()}
    return build_fault_graph(formulas, tree.houses, Name(tree.top))


def _with_probability(known: Analysis, solved: list[SolvedModule], importance: bool) -> Analysis:
    of_event = _known(known.tree, known.events)
    factors = importance_of(solved, of_event) if importance else {}
    top = top_probability(solved, of_event)
    bounds = ProbabilityBounds(top, top)
    return replace(known, top_probability=top, importance=factors, bounds=bounds)


def _with_cut_sets(known: Analysis, solved: list[SolvedModule], budget: Budget) -> Analysis:
    try:
        sets = cut_sets_of(solved, known.truncated_at, budget)
    except ExhaustedError as error:
        return replace(known, incomplete=f"cut sets: {error.reason}")
    leaves = tuple(part.leaves for part in solved)
    return replace(known, cut_sets=CutSets(leaves, tuple(sets), known.truncated_at))


_TIME_TO_BE_EXACT = 0.5
_TIME_FOR_CUT_SETS = 0.8  # where no bounds are needed any more
_NONE: Mapping[int, tuple[int, ...]] = {}
_MOST_JOINED = 500  # cut sets whose joint probability is looked at more closely
_ANY = 0.1  # for events without probability: then the smallest cut sets come first


def _bounded(
    known: Analysis, graph: FaultGraph, parts: Sequence[FaultTreeModule],
    solved: Sequence[SolvedModule], budget: Budget, orders: Mapping[int, tuple[int, ...]] = _NONE,
) -> Analysis:  # fmt: skip
    """Add bounds of what could not be solved."""
    with_bounds = known.bounds is None and not known.without_probability
    of_event = _known(known.tree, known.events)
    if known.without_probability:
        of_event = dict.fromkeys(known.events, _ANY)
    done = _values(solved, of_event)[0] if with_bounds else []
    of_part = {part.vertex: values[-1] for part, values in zip(parts, done, strict=False)}
    search = BoundedSearch(graph, parts, of_part, of_event, budget, orders)
    search.run(with_bounds)
    if not with_bounds or (search.bounds is None and search.sets is None):
        return replace(known, probable=search.sets)
    found = search.bounds or rough_bounds(graph, parts, of_event)
    by_sets = _by_sets(search.sets, of_event)[0] if search.sets is not None else 0.0
    bounds = ProbabilityBounds(min(found.upper, max(found.lower, by_sets)), found.upper)
    return replace(known, bounds=bounds, probable=search.sets)


@dataclass(frozen=True, slots=True)
class MostProbable:
    """Minimal cut sets with their probabilities, the most probable first.

    The first ``certain`` are surely the most probable of all. ``share`` are bounds of how much of
    the top event's probability is due to the sets together; None where the probability is not
    bounded. Without probabilities (None) the smallest sets come first.
    """

    sets: tuple[frozenset[str], ...]
    probabilities: tuple[float, ...] | None
    certain: int
    share: tuple[float, float] | None


def most_probable(analysis: Analysis, n: int) -> MostProbable | None:
    """Return the ``n`` most probable minimal cut sets and their share; None if none are known."""
    found = analysis.probable
    if analysis.cut_sets is not None:
        of_event = {name: analysis.tree.events[name].probability for name in analysis.events}
        sets = tuple(islice(ranked(analysis, of_event), n))
        chances = tuple(math.prod(of_event[e] or 0.0 for e in sorted(entry)) for entry in sets)
        found = ProbableCutSets(sets, chances, 0.0, repairing_events(*_graph(analysis.tree)))
    if found is None:
        return None
    limit = analysis.truncated_at
    places = [p for p, entry in enumerate(found.sets) if limit is None or len(entry) <= limit][:n]
    certain = sum(place < found.certain for place in places)
    found = replace(
        found,
        sets=tuple(found.sets[place] for place in places),
        probabilities=tuple(found.probabilities[place] for place in places),
    )
    if analysis.without_probability:
        return MostProbable(found.sets, None, certain, None)
    return MostProbable(found.sets, found.probabilities, certain, _share(analysis, found))


def _share(analysis: Analysis, found: ProbableCutSets) -> tuple[float, float] | None:
    bounds = analysis.bounds
    if bounds is None or not bounds.upper:
        return None
    of_event = _known(analysis.tree, analysis.events)
    lower, upper = _by_sets(found, of_event)
    if found.repairing:
        graph, top = _graph(analysis.tree)
        given = least_given(graph, split_modules(graph, top), of_event, found.sets)
        lower = max(lower, union_bounds(found, of_event, given)[0])
    least = max(bounds.lower, lower)
    return min(1.0, lower / bounds.upper), min(1.0, upper / least) if least else 1.0


def _by_sets(found: ProbableCutSets, of_event: Mapping[str, float]) -> tuple[float, float]:
    """Return bounds of the probability that the top event happens by one of the sets."""
    lower, upper = union_bounds(found, of_event)
    if not found.sets:
        return lower, upper
    joined = _joined_bounds(found.sets[:_MOST_JOINED], of_event)
    if len(found.sets) <= _MOST_JOINED:
        upper = min(upper, joined.upper)
    return lower if found.repairing else max(lower, joined.lower), upper


def _joined_bounds(
    sets: Sequence[frozenset[str]], of_event: Mapping[str, float]
) -> ProbabilityBounds:
    """Return bounds of the probability that all events of one of the sets happen."""
    formula = any_of(
        *(all_of(*sorted(entry)) if entry else BooleanConstant(True) for entry in sets)
    )
    graph, top = build_fault_graph({}, {}, formula)
    return quick_bounds(graph, split_modules(graph, top), of_event)


def _known(tree: FaultTree, events: Sequence[str]) -> dict[str, float]:
    return {name: tree.events[name].probability or 0.0 for name in events}


# What is known of events: True (has happened), False (has not), None (unknown: its probability in
# the tree counts), or a probability. Events that are not named are unknown.
State: TypeAlias = Mapping[str, "bool | float | None"]


@dataclass(frozen=True, slots=True)
class CutSetCloseness:
    """A cut set: which of its events have happened, which are missing, its probability of
    completion.

    ``probability`` is None when one of the missing events has none.
    """

    happened: tuple[str, ...]
    missing: tuple[str, ...]
    probability: float | None


def closest(
    tree: FaultTree | Analysis, state: State, n: int = 5, budget: Budget | None = None
) -> list[CutSetCloseness]:
    """Return the ``n`` minimal cut sets that are closest to complete, the closest first.

    They are ordered by the probability of completion, then by the number of missing events; if an
    event of the tree has no probability at all, by the number of missing events. Cut sets with an
    event that has certainly not happened are left out. For repeated calls give an ``Analysis``,
    which is solved already. Raises AmberboxError when the budget did not suffice.
    """
    analysis = tree if isinstance(tree, Analysis) else analyse(tree, budget=budget)
    chances = _chances(analysis, state)
    return [_closeness(events, chances) for events in islice(ranked(analysis, chances), n)]


def ranked(analysis: Analysis, chances: Mapping[str, float | None]) -> Iterator[frozenset[str]]:
    """Yield the minimal cut sets, the most probable first, by the probability of every event.

    If an event has none, the sets with the fewest events first. Sets that cannot be are left
    out. Raises AmberboxError when the cut sets are not known.
    """
    if analysis.cut_sets is None:
        raise AmberboxError(f"the cut sets are not known: {analysis.incomplete}")
    cost = _by_count if None in chances.values() else _by_probability
    found = cheapest_cut_sets(
        analysis.cut_sets.leaves, analysis.cut_sets.sets, lambda event: cost(chances[event])
    )
    limit = analysis.truncated_at
    return (events for _, events in found if limit is None or len(events) <= limit)


def _chances(analysis: Analysis, state: State) -> dict[str, float | None]:
    """Return the probability of each event in the given state; 1 for events that have happened."""
    chances: dict[str, float | None] = {}
    for event in analysis.events:
        known = state.get(event)
        prior = analysis.tree.events[event].probability
        chances[event] = prior if known is None else float(known)
    return chances


def _by_probability(chance: float | None) -> Cost:
    if not chance:
        return math.inf, 1
    return (0.0, 0) if chance >= 1.0 else (-math.log(chance), 1)


def _by_count(chance: float | None) -> Cost:
    if chance == 0.0:
        return math.inf, 1
    return (0.0, 0) if chance is not None and chance >= 1.0 else (1.0, 1)


def _closeness(events: frozenset[str], chances: Mapping[str, float | None]) -> CutSetCloseness:
    happened = tuple(sorted(event for event in events if chances[event] == 1.0))
    missing = tuple(sorted(events.difference(happened)))
    probability: float | None = 1.0
    for event in missing:
        chance = chances[event]
        probability = None if chance is None or probability is None else probability * chance
    return CutSetCloseness(happened, missing, probability)


_PROBABLE = 0.5  # from this probability on an event counts as happened when it is shown to people

_SAME = 1.0 - 1e-9


@dataclass(frozen=True, slots=True)
class NearCutSet:
    """A cut set in the present state: its probability of being complete, and that of each event."""

    probability: float
    events: Mapping[str, float]

    @property
    def happened(self) -> tuple[str, ...]:
        """Return the events that have more likely happened than not, the surest first."""
        return tuple(name for name, chance in self.events.items() if chance >= _PROBABLE)

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the other events, the most probable first."""
        return tuple(name for name, chance in self.events.items() if chance < _PROBABLE)


@dataclass(frozen=True, slots=True)
class _World:
    """What may be the case: these events have happened, with what probability."""

    probability: float
    happened: frozenset[str]


def nearest(analysis: Analysis, diagnosis: Diagnosis | None, n: int = 5) -> list[NearCutSet]:
    """Return the ``n`` cut sets that are most probably complete, the most probable first.

    Under each hypothesis its faults have happened and all other events have the probability of the
    tree; hypotheses exclude each other. The remaining probability, and all of it without a
    diagnosis, is no evidence about any event. The result is exact: no other cut set is more
    probable. If the cut sets are too many, it is the best of ``analysis.probable``. Raises
    AmberboxError when neither they nor probabilities are known.
    """
    if analysis.without_probability:
        what = f"the event {analysis.without_probability[0]} has no probability"
        raise AmberboxError(what, "give every event one")
    chances: dict[frozenset[str], float] = {}
    known = frozenset(analysis.events)
    for hypothesis in diagnosis.hypotheses if diagnosis else ():
        faults = hypothesis.faults & known
        chances[faults] = chances.get(faults, 0.0) + hypothesis.probability
    rest = max(0.0, 1.0 - sum(chances.values()))
    chances[frozenset()] = chances.get(frozenset(), 0.0) + rest
    worlds = [_World(chance, faults) for faults, chance in chances.items() if chance > 0.0]
    if analysis.cut_sets is None and analysis.probable is not None:
        return _ranked(analysis, worlds, analysis.probable.sets, n)
    count = n
    while True:
        listed = [(world, _listed(analysis, world, count)) for world in worlds]
        candidates = {events for _, found in listed for events, _ in found}
        ranked = _ranked(analysis, worlds, candidates, n)
        open_ = sum(w.probability * found[-1][1] for w, found in listed if len(found) == count)
        if open_ <= 0.0 or (len(ranked) == n and ranked[-1].probability >= open_ * _SAME):
            return ranked
        count *= 2


def _listed(analysis: Analysis, world: _World, n: int) -> list[tuple[frozenset[str], float]]:
    found = closest(analysis, dict.fromkeys(world.happened, True), n)
    return [(frozenset((*near.happened, *near.missing)), near.probability or 0.0) for near in found]


def _ranked(
    analysis: Analysis, worlds: list[_World], candidates: Iterable[frozenset[str]], n: int
) -> list[NearCutSet]:
    found = ((_complete(analysis, worlds, events), events) for events in candidates)
    best = heapq.nsmallest(n, found, key=lambda e: (-e[0], len(e[1]), sorted(e[1])))
    return [NearCutSet(chance, dict(_alone(analysis, worlds, events))) for chance, events in best]


def _alone(
    analysis: Analysis, worlds: list[_World], events: frozenset[str]
) -> Iterator[tuple[str, float]]:
    chances = {event: _complete(analysis, worlds, frozenset({event})) for event in events}
    yield from sorted(chances.items(), key=lambda entry: (-entry[1], entry[0]))


def _complete(analysis: Analysis, worlds: list[_World], events: frozenset[str]) -> float:
    """Return how probable it is that all of these events have happened."""
    total = 0.0
    for world in worlds:
        chance = world.probability
        for event in events - world.happened:
            chance *= analysis.tree.events[event].probability or 0.0
        total += chance
    return total
