"""Which cut sets a diagnosis brings closest to complete."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from amberbox.core.errors import AmberboxError
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.faulttree.analysis import Analysis
from amberbox.diagnosis.faulttree.closest import closest

_PROBABLE = 0.5
"""From this probability on an event counts as happened when it is shown to people."""

_SAME = 1.0 - 1e-9


@dataclass(frozen=True, slots=True)
class Near:
    """A cut set as things stand: how probable it is complete, and each of its events by itself."""

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


def nearest(analysis: Analysis, diagnosis: Diagnosis | None, n: int = 5) -> list[Near]:
    """Return the ``n`` cut sets that are most probably complete, the most probable first.

    Under each hypothesis its faults have happened and all other events have the probability of
    the tree; hypotheses exclude each other. What they leave of the probability, and all of it
    without a diagnosis, says nothing about any event. The result is exact: no other cut set is
    more probable. Raises AmberboxError when the cut sets or probabilities are not known.
    """
    if analysis.without_probability:
        what = f"the event {analysis.without_probability[0]} has no probability"
        raise AmberboxError(what, "give every event one")
    worlds = _worlds(analysis, diagnosis)
    count = n
    while True:
        listed = [(world, _listed(analysis, world, count)) for world in worlds]
        candidates = {events for _, found in listed for events, _ in found}
        ranked = _ranked(analysis, worlds, candidates, n)
        open_ = sum(w.probability * found[-1][1] for w, found in listed if len(found) == count)
        if open_ <= 0.0 or (len(ranked) == n and ranked[-1].probability >= open_ * _SAME):
            return ranked
        count *= 2


def _worlds(analysis: Analysis, diagnosis: Diagnosis | None) -> list[_World]:
    chances: dict[frozenset[str], float] = {}
    known = frozenset(analysis.events)
    for hypothesis in diagnosis.hypotheses if diagnosis else ():
        faults = hypothesis.faults & known
        chances[faults] = chances.get(faults, 0.0) + hypothesis.probability
    rest = max(0.0, 1.0 - sum(chances.values()))
    chances[frozenset()] = chances.get(frozenset(), 0.0) + rest
    return [_World(chance, faults) for faults, chance in chances.items() if chance > 0.0]


def _listed(analysis: Analysis, world: _World, n: int) -> list[tuple[frozenset[str], float]]:
    found = closest(analysis, dict.fromkeys(world.happened, True), n)
    return [(frozenset((*near.happened, *near.missing)), near.probability or 0.0) for near in found]


def _ranked(
    analysis: Analysis, worlds: list[_World], candidates: Iterable[frozenset[str]], n: int
) -> list[Near]:
    found = ((_complete(analysis, worlds, events), events) for events in candidates)
    best = heapq.nsmallest(n, found, key=lambda e: (-e[0], len(e[1]), sorted(e[1])))
    return [Near(chance, dict(_alone(analysis, worlds, events))) for chance, events in best]


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
