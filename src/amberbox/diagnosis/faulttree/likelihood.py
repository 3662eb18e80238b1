"""Probability of the top event, exact, and how much each basic event matters for it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from amberbox.diagnosis.faulttree.compiled import Nodes, Solved

_DOUBTFUL = 1e-6
"""Below this share of the whole a difference has lost too many digits and is computed anew."""


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


def top_probability(solved: Sequence[Solved], of_event: Mapping[str, float]) -> float:
    """Return the exact probability of the top event; basic events are independent."""
    return _values(solved, of_event)[0][-1][-1]


def importance_of(solved: Sequence[Solved], of_event: Mapping[str, float]) -> dict[str, Importance]:
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
    solved: Sequence[Solved], of_event: Mapping[str, float]
) -> tuple[list[list[float]], list[list[float]]]:
    """Return, by part, the probability of each node and of each leaf."""
    nodes: list[list[float]] = []
    leaves: list[list[float]] = []
    for part in solved:
        own = [nodes[leaf][-1] if isinstance(leaf, int) else of_event[leaf] for leaf in part.leaves]
        nodes.append(_of_nodes(part.decisions, own))
        leaves.append(own)
    return nodes, leaves


def _of_nodes(decisions: Nodes, leaves: Sequence[float]) -> list[float]:
    values = [0.0, 1.0][: len(decisions)]
    for level, high, low in decisions.inner():
        chance = leaves[level]
        values.append(chance * values[high] + (1.0 - chance) * values[low])
    return values


def _slopes(
    solved: Sequence[Solved], nodes: Sequence[Sequence[float]], leaves: Sequence[Sequence[float]]
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
    decisions: Nodes, weight: float, values: Sequence[float], leaves: Sequence[float]
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
