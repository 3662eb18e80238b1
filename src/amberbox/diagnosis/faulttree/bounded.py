"""Answers about trees that are too large to be solved: bounds and the most probable cut sets.

Both are computed with few nodes and sets first and then with more and more, for as long as the
budget lasts, so that an answer is there early and becomes better. A budget that does not know how
much of its time is over gets a few rounds only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.core.contracts import Budget
from amberbox.diagnosis.faulttree.bounds import ProbabilityBounds, bounds_of_part
from amberbox.diagnosis.faulttree.decision_diagrams import MOST_NODES, ExhaustedError
from amberbox.diagnosis.faulttree.graph import FaultGraph, FaultTreeModule, variable_orders
from amberbox.diagnosis.faulttree.probable import ProbableCutSets, probable_cut_sets

_ENOUGH_SETS = 1_000
_ENOUGH_SETS_UNTIMED = 200
_FIRST_SETS = 32
_MOST_SETS = 2_048
_QUICK_STATES = 256
_FEWEST_STATES = 64  # in the first round
_MOST_STATES = 32_768
_MOST_STATES_UNTIMED = 1_024
_NODES_OF_A_STATE = 32  # as much memory as a state takes at most
_MOST_GROWTH = 8.0
_BETTER_ORDERS = 3  # of so many orders that were tried one is tried with more states
_LEAST_GROWTH = 1.3  # a round with hardly more states is not worth its time
_USED = 0.8  # of the time that is left, so that the last round ends in time
_LARGE_PART = 200  # gates, from which on trying an order takes long
_ORDERS_OF_A_LARGE_PART = 4
_LISTED_SETS = 100
_NARROW = 0.01
_FURTHER = 0.25  # how much less probable sets are looked for in each round
_CLOSE = 1e-12
_NOTHING = 1e-290  # so improbable sets are not told from impossible ones
_TIME_FOR_ORDERS = 0.75  # the share of the time after which no further order is tried


def quick_bounds(
    graph: FaultGraph, parts: Sequence[FaultTreeModule], of_event: Mapping[str, float]
) -> ProbabilityBounds:
    """Return bounds of a tree from one sweep over each part."""
    found: dict[int, ProbabilityBounds] = {}
    for part in parts:
        for leaf in part.leaves:
            if leaf not in found:
                chance = of_event[graph.vertices[leaf].event]
                found[leaf] = ProbabilityBounds(chance, chance)
        order = variable_orders(graph, part)[0]
        found[part.vertex] = bounds_of_part(graph, part, order, found, _QUICK_STATES, Budget())
    return found[parts[-1].vertex]


@dataclass
class BoundedSearch:
    """The best answers so far about a tree; each round improves one of them.

    ``parts`` are those of ``split_modules``, ``known`` the probabilities of those that are solved.
    ``of_event`` are the probabilities of the events, ``first_orders`` the most promising orders of
    the leaves of parts.
    """

    graph: FaultGraph
    parts: Sequence[FaultTreeModule]
    known: Mapping[int, float]
    of_event: Mapping[str, float]
    budget: Budget
    first_orders: Mapping[int, tuple[int, ...]] = field(default_factory=dict)
    bounds: ProbabilityBounds | None = None
    sets: ProbableCutSets | None = None
    tried: int = 1
    orders: dict[int, list[tuple[int, ...]]] = field(default_factory=dict)

    def run(self, with_bounds: bool) -> None:
        """Improve the answers until they are good enough or the budget is over."""
        rounds = {"sets": self._more_sets()}
        if with_bounds:
            rounds["bounds"] = self._closer_bounds()
        while rounds:
            for name in list(rounds):
                if name == "sets" and "bounds" in rounds and self._bounds_come_first():
                    continue
                try:
                    next(rounds[name])
                except (ExhaustedError, StopIteration):
                    del rounds[name]

    def _bounds_come_first(self) -> bool:
        """Return whether closer bounds are worth more now than further sets."""
        listed = self.sets is not None and self.sets.certain >= _LISTED_SETS
        return listed and self.bounds is not None and self.bounds.width > _NARROW

    def _more_sets(self) -> Iterator[None]:
        """Look for the sets that are most probable, then for ever less probable ones."""
        enough = _ENOUGH_SETS if self.budget.is_past else _ENOUGH_SETS_UNTIMED
        top = self.parts[-1].vertex
        size, cutoff = _FIRST_SETS, 0.0
        while not self.budget.is_over():
            found = probable_cut_sets(self.graph, top, self.of_event, size, cutoff, self.budget)
            self.sets = found if self.sets is None else self.sets.joined(found)
            if not self.sets.sets or found.floor <= _NOTHING or found.certain >= enough:
                return
            if size == _MOST_SETS and len(found.sets) == size and found.floor > cutoff:
                return
            cutoff = _FURTHER * (cutoff if size == _MOST_SETS else found.probabilities[0])
            size = _MOST_SETS
            yield

    def _closer_bounds(self) -> Iterator[None]:
        most = self.budget.most_nodes(MOST_NODES) // _NODES_OF_A_STATE
        most = min(most, _MOST_STATES if self.budget.is_past else _MOST_STATES_UNTIMED)
        size = min(_FEWEST_STATES, most)
        while size <= most and not self.budget.is_over():
            self.tried, began = 1, self.budget.time_gone()
            found = self._bounds(size)
            if self.bounds is not None:
                lower = max(found.lower, self.bounds.lower)
                found = ProbabilityBounds(lower, max(lower, min(found.upper, self.bounds.upper)))
            self.bounds = found
            growth = self._growth(began)
            if found.width < _CLOSE or not size or growth < _LEAST_GROWTH:
                return
            size = int(size * growth)
            yield

    def _growth(self, began: float) -> float:
        """Return how many times more states the next round can have, given when the last began."""
        gone = self.budget.time_gone()
        if gone <= began:
            return _MOST_GROWTH
        return min(_MOST_GROWTH, _USED * (1.0 - gone) * self.tried / (gone - began))

    def _bounds(self, size: int) -> ProbabilityBounds:
        found: dict[int, ProbabilityBounds] = {}
        for part in self.parts:
            if part.vertex in self.known:
                chance = self.known[part.vertex]
                found[part.vertex] = ProbabilityBounds(chance, chance)
                continue
            of_leaf = {leaf: found.get(leaf) or self._of_event(leaf) for leaf in part.leaves}
            found[part.vertex] = self._of_part(part, of_leaf, size)
        return found[self.parts[-1].vertex]

    def _of_event(self, leaf: int) -> ProbabilityBounds:
        chance = self.of_event[self.graph.vertices[leaf].event]
        return ProbabilityBounds(chance, chance)

    def _of_part(
        self, part: FaultTreeModule, of_leaf: Mapping[int, ProbabilityBounds], size: int
    ) -> ProbabilityBounds:
        """Return the closest bounds of a part; of the orders that were tried keep the better ones.

        All are tried with the fewest states, and in each round after that a third of them.
        """
        orders = self.orders.get(part.vertex) or self._orders(part)
        found: list[tuple[float, tuple[int, ...], ProbabilityBounds]] = []
        early = self.budget.until(_TIME_FOR_ORDERS)
        for order in orders:
            budget = early if found else self.budget
            best = min((width for width, _, _ in found), default=math.inf)
            try:
                bounds = bounds_of_part(self.graph, part, order, of_leaf, size, budget, best)
            except ExhaustedError:
                if not found:
                    raise
                break
            found.append((bounds.upper - bounds.lower, order, bounds))
        self.tried = max(self.tried, len(found))
        found.sort(key=lambda entry: entry[0])
        better = found[: max(1, len(found) // _BETTER_ORDERS)]
        self.orders[part.vertex] = [order for _, order, _ in better]
        return ProbabilityBounds(
            max(bounds.lower for _, _, bounds in found), min(bounds.upper for _, _, bounds in found)
        )

    def _orders(self, part: FaultTreeModule) -> list[tuple[int, ...]]:
        orders = variable_orders(self.graph, part)
        if len(part.inner) > _LARGE_PART:
            orders = orders[:_ORDERS_OF_A_LARGE_PART]
        if part.vertex in self.first_orders:
            orders = list(dict.fromkeys((self.first_orders[part.vertex], *orders)))
        return orders
