"""The analysis of a fault tree: exact probability, minimal cut sets, importance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.config import refuse
from amberbox.diagnosis.faulttree.budget import Budget, ExhaustedError
from amberbox.diagnosis.faulttree.compiled import Solved, cut_sets_of, solve
from amberbox.diagnosis.faulttree.cutsets import CutSets
from amberbox.diagnosis.faulttree.formula import Name
from amberbox.diagnosis.faulttree.graph import build
from amberbox.diagnosis.faulttree.likelihood import (
    Importance,
    importance_of,
    top_probability,
)
from amberbox.diagnosis.faulttree.modules import coherent
from amberbox.diagnosis.faulttree.tree import FaultTree, below
from amberbox.diagnosis.faulttree.validity import problems


@dataclass(frozen=True)
class Analysis:
    """What is known of the top event of a fault tree.

    ``top_probability`` is exact, basic events being independent; None when an event has no
    probability (they are in ``without_probability``) or the budget ended. ``cut_sets`` is None
    when the budget ended; those of a tree that is not ``coherent`` are the positive parts of its
    minimal solutions. ``truncated_at`` is the order limit if there was one: then larger cut sets
    are not counted. ``incomplete`` says which budget ended what; empty if all was done.
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
    """Solve a fault tree exactly.

    ``order_limit`` leaves cut sets of more events out; the probability stays exact. Raises
    ConfigurationError for a tree with a cycle, a gate without input, or the like. A budget that
    ends is no error: see ``Analysis.incomplete``.
    """
    refuse(problems(tree))
    budget = budget or Budget()
    formulas = {name: gate.formula for name, gate in tree.gates.items()}
    graph, top = build(formulas, tree.houses, Name(tree.top))
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
    try:
        solved = solve(graph, top, budget)
    except ExhaustedError as error:
        return replace(known, incomplete=f"probability and cut sets: {error.reason}")
    if not unknown:
        known = _with_probability(known, solved, importance)
    return _with_cut_sets(known, solved, budget)


def _with_probability(known: Analysis, solved: list[Solved], importance: bool) -> Analysis:
    of_event = _known(known.tree, known.events)
    factors = importance_of(solved, of_event) if importance else {}
    return replace(known, top_probability=top_probability(solved, of_event), importance=factors)


def _with_cut_sets(known: Analysis, solved: list[Solved], budget: Budget) -> Analysis:
    try:
        sets = cut_sets_of(solved, known.truncated_at, budget)
    except ExhaustedError as error:
        return replace(known, incomplete=f"cut sets: {error.reason}")
    leaves = tuple(part.leaves for part in solved)
    return replace(known, cut_sets=CutSets(leaves, tuple(sets), known.truncated_at))


def _known(tree: FaultTree, events: Sequence[str]) -> dict[str, float]:
    return {name: tree.events[name].probability or 0.0 for name in events}
