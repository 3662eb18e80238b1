"""Which cut sets of a running robot are closest to complete."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

from amberbox.core.errors import AmberboxError
from amberbox.diagnosis.faulttree.analysis import Analysis, analyse
from amberbox.diagnosis.faulttree.budget import Budget
from amberbox.diagnosis.faulttree.tree import FaultTree
from amberbox.diagnosis.faulttree.walk import Cost, cheapest

State: TypeAlias = Mapping[str, "bool | float | None"]
"""What is known of events: True (has happened), False (has not), None (unknown: its probability
in the tree counts), or a probability. Events that are not named are unknown."""


@dataclass(frozen=True, slots=True)
class Closeness:
    """A cut set: what of it has happened, what is missing, how probable it is to be completed.

    ``probability`` is None when one of the missing events has none.
    """

    happened: tuple[str, ...]
    missing: tuple[str, ...]
    probability: float | None


def closest(
    tree: FaultTree | Analysis, state: State, n: int = 5, budget: Budget | None = None
) -> list[Closeness]:
    """Return the ``n`` minimal cut sets that are closest to complete, the closest first.

    Closest is what is most probable to be completed, with equal probability what misses fewer
    events; if an event of the tree has no probability at all, what misses fewer events. Cut sets
    with an event that has surely not happened are left out. An ``Analysis`` is solved already:
    give it when asking again and again. Raises AmberboxError when the budget did not suffice.
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
    found = cheapest(
        analysis.cut_sets.leaves, analysis.cut_sets.sets, lambda event: cost(chances[event])
    )
    limit = analysis.truncated_at
    return (events for _, events in found if limit is None or len(events) <= limit)


def _chances(analysis: Analysis, state: State) -> dict[str, float | None]:
    """Return the probability of each event as things stand; 1 for what has happened."""
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


def _closeness(events: frozenset[str], chances: Mapping[str, float | None]) -> Closeness:
    happened = tuple(sorted(event for event in events if chances[event] == 1.0))
    missing = tuple(sorted(events.difference(happened)))
    probability: float | None = 1.0
    for event in missing:
        chance = chances[event]
        probability = None if chance is None or probability is None else probability * chance
    return Closeness(happened, missing, probability)
