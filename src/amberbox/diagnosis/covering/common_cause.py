"""What is not in the FMEA may look like several known faults at once: a cause they share."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from amberbox.core.clock import NS
from amberbox.diagnosis.covering.evidence import Evidence
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.prediction import predict

FEWEST = 3
"""So many known faults at once may be one thing that nobody thought of."""

Sets = Sequence[tuple[frozenset[str], float]]
Misses = Mapping[int, float]
"""Per symptom how probable it does not show."""


def with_common_cause(model: Model, evidence: Evidence, sets: Sets) -> tuple[Sets, float]:
    """Give the unknown mode its share of sets that began together.

    The priors of such a set's modes are replaced by that of the unknown mode and ``looks_like``
    for each of them. Return the sets with their shares of all that there is now, the likely ones
    first, and how many times as much that is.
    """
    other = model.unknown
    if other is None or not other.looks_like or _is_excluded(evidence):
        return sets, 1.0
    priors = {mode.id: mode.prior for mode in model.modes}
    extra = math.fsum(
        share * _factor(faults, priors, other.prior, other.looks_like)
        for faults, share in _together(model, evidence, sets, other.together_s)
    )
    if not extra:
        return sets, 1.0
    shares, alone = dict(sets), frozenset({UNKNOWN})
    shares[alone] = shares.get(alone, 0.0) + extra
    ranked = sorted(shares.items(), key=lambda found: -found[1])
    return [(faults, share / (1.0 + extra)) for faults, share in ranked], 1.0 + extra


def _is_excluded(evidence: Evidence) -> bool:
    """Tell whether something else than the unknown mode is proven to be there."""
    return any(UNKNOWN not in conflict for conflict in evidence.conflicts)


def _factor(
    faults: Collection[str], priors: Mapping[str, float], other: float, looks_like: float
) -> float:
    known = math.prod(looks_like / priors[fault] for fault in faults if fault != UNKNOWN)
    return known if UNKNOWN in faults else known * other


def _together(model: Model, evidence: Evidence, sets: Sets, within_s: float) -> Sets:
    """Return the sets of enough known modes that began at most so long after each other."""
    many = [(faults, share) for faults, share in sets if len(faults - {UNKNOWN}) >= FEWEST]
    named = sorted(frozenset().union(*(faults for faults, _ in many)) - {UNKNOWN})
    misses = {fault: predict(model, [fault]).misses for fault in named}
    onsets = {
        model.sign_places[name]: onset_ns
        for name, onset_ns in evidence.onsets_ns.items()
        if name in model.sign_places
    }
    limit_ns = within_s * NS
    return [
        (faults, share)
        for faults, share in many
        if _spread_ns([misses[fault] for fault in sorted(faults - {UNKNOWN})], onsets) <= limit_ns
    ]


def _spread_ns(modes: Sequence[Misses], onsets: Mapping[int, int]) -> int:
    """Return how long after the first mode the last one began, by the first that each shows.

    What several may show is taken to come from the one that shows it most surely. What has no
    known onset does not count.
    """
    first: dict[int, int] = {}
    for place, onset_ns in onsets.items():
        miss, mode = min((shows.get(place, 1.0), number) for number, shows in enumerate(modes))
        if miss < 1.0:
            first[mode] = min(first.get(mode, onset_ns), onset_ns)
    return max(first.values()) - min(first.values()) if first else 0
