"""Hypotheses: which sets of faults explain the evidence, how probable each is, and why.

Hypotheses that no evidence distinguishes form an ambiguity group; several known faults at once may
also be one cause that is not in the FMEA.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.core.clock import NS
from amberbox.core.contracts import Budget
from amberbox.core.types import AmbiguityGroup, Hypothesis
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.observations import (
    Evidence,
    Prediction,
    fold_evidence,
    outcomes,
    predict,
)
from amberbox.diagnosis.covering.problem import covering_problem
from amberbox.diagnosis.covering.search import search

LEAST_FIT = 0.05  # a size that is less probable, against the most probable one, is not explained
EXPECTED = 0.5  # from this probability on a symptom is expected of a hypothesis


def signature(
    model: Model, evidence: Evidence, known: Collection[int], prediction: Prediction
) -> tuple[object, ...]:
    """Return the effect of a hypothesis on the known symptoms (by place) and answers."""
    caused = [place for place in prediction.misses if place in known]
    expected = (place for place in caused if prediction.expected(model, place) >= EXPECTED)
    answers = (
        outcomes(model, a.check, prediction)[a.check.level(a.outcome)] >= EXPECTED
        for a in evidence.answers
    )
    graded = model.tables.graded
    sized = (
        [
            (name, round(prediction.sizes(model, place)[level], 6))
            for name, observation in evidence.observations.items()
            if (level := observation.level) is not None
            and (place := model.sign_places.get(name, -1)) in graded
        ]
        if graded
        else []
    )
    return (frozenset(caused), frozenset(expected), tuple(answers), *sized)


def group_hypotheses(
    hypotheses: Sequence[Hypothesis], signatures: Sequence[object]
) -> tuple[tuple[Hypothesis, ...], tuple[AmbiguityGroup, ...]]:
    """Return the hypotheses with their ambiguity filled in, and the groups.

    Hypotheses are ordered, and so are groups by their most probable member: many improbable sets
    that nothing tells apart do not come before one that is more probable than each.
    """
    similar: dict[object, list[Hypothesis]] = {}
    for hypothesis, key in zip(hypotheses, signatures, strict=True):
        similar.setdefault(key, []).append(hypothesis)
    groups = [_group(alike) for alike in similar.values()]
    members = {name: g.members for g in groups for name in (*g.members, *g.wider)}
    return tuple(_filled(h, members[h.id]) for h in hypotheses), tuple(groups)


def _filled(hypothesis: Hypothesis, members: Sequence[str]) -> Hypothesis:
    others = tuple(name for name in members if name != hypothesis.id)
    return replace(hypothesis, ambiguity=others) if others else hypothesis


def _group(similar: Sequence[Hypothesis]) -> AmbiguityGroup:
    wider = {h.id for h in similar if any(other.faults < h.faults for other in similar)}
    members = tuple(h.id for h in similar if h.id not in wider)
    others = tuple(h.id for h in similar if h.id in wider)
    return AmbiguityGroup(members, sum(h.probability for h in similar), others)


_UNLISTED_SETS = 10  # sets that are listed for each that is left when unlisted modes are one
FEWEST = 3  # so many known faults at once may be one cause that is not in the FMEA

Sets = Sequence[tuple[frozenset[str], float]]
Misses = Mapping[int, float]  # per symptom how probable it does not show


def with_unlisted(model: Model, sets: Sets) -> tuple[Sets, Mapping[frozenset[str], frozenset[str]]]:
    """Return sets in which all modes that are not in the FMEA are the unknown one.

    Equal sets are one, with the sum of their shares. Return also which set each was made of, the
    most probable of them, where that is another one.
    """
    if not model.unlisted:
        return sets, {}
    shares: dict[frozenset[str], float] = {}
    meant: dict[frozenset[str], frozenset[str]] = {}
    for faults, share in sets:
        own = faults
        if faults & model.unlisted:
            own = faults - model.unlisted | {UNKNOWN}
        meant.setdefault(own, faults)
        shares[own] = shares.get(own, 0.0) + share
    return sorted(shares.items(), key=lambda found: -found[1]), meant


def with_common_cause(model: Model, evidence: Evidence, sets: Sets) -> tuple[Sets, float]:
    """Return sets in which the unknown mode has its share of modes that began together.

    The priors of such a set's modes are replaced by that of the unknown mode and ``looks_like`` for
    each of them. Return the sets with their new shares of the total, the likely ones first, and the
    factor by which the total has grown.
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
    """Return whether a failure mode other than the unknown one is proven to be present."""
    return any(UNKNOWN not in conflict for conflict in evidence.conflicts)


def _factor(
    faults: Collection[str], priors: Mapping[str, float], other: float, looks_like: float
) -> float:
    known = math.prod(looks_like / priors[fault] for fault in faults if fault != UNKNOWN)
    return known if UNKNOWN in faults else known * other


def _together(model: Model, evidence: Evidence, sets: Sets, within_s: float) -> Sets:
    """Return the sets of enough known modes that began within ``within_s`` of each other."""
    many = [
        (faults, share)
        for faults, share in sets
        if len(faults - {UNKNOWN} - following(model, faults)) >= FEWEST
    ]
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


def following(model: Model, faults: Collection[str]) -> frozenset[str]:
    """Return the faults that may have followed from others of a set."""
    return frozenset(
        one.effect for one in model.leads_to if one.cause in faults and one.effect in faults
    )


def _spread_ns(modes: Sequence[Misses], onsets: Mapping[int, int]) -> int:
    """Return the time between the beginnings of the first and the last mode, by their first
    symptoms.

    A symptom of several modes is attributed to the one that shows it with the highest probability.
    Symptoms without a known onset do not count.
    """
    first: dict[int, int] = {}
    for place, onset_ns in onsets.items():
        miss, mode = min((shows.get(place, 1.0), number) for number, shows in enumerate(modes))
        if miss < 1.0:
            first[mode] = min(first.get(mode, onset_ns), onset_ns)
    return max(first.values()) - min(first.values()) if first else 0


# The id of the hypothesis that nothing is broken: what was seen are false alarms
NO_FAULT = "no fault"


@dataclass(frozen=True, slots=True)
class RankedHypotheses:
    """Hypotheses from likely to unlikely, and their ambiguity groups.

    A hypothesis' probability is its share of what was enumerated; its true posterior lies between
    ``probability * mass_covered`` and ``probability``. ``incomplete`` names the budget that ended
    the search, empty if none did. ``findings`` are symptoms that are not in the model.
    """

    hypotheses: tuple[Hypothesis, ...]
    groups: tuple[AmbiguityGroup, ...]
    mass_covered: float
    incomplete: str = ""
    findings: tuple[str, ...] = ()
    opened: int = 0


def diagnose(
    model: Model,
    evidence: Evidence,
    *,
    max_hypotheses: int = 20,
    mass: float = 0.99,
    budget: Budget | None = None,
) -> RankedHypotheses:
    """Rank the sets of failure modes by their probability given the evidence.

    The search ends when the listed hypotheses hold at least ``mass`` of all probability, when
    ``max_hypotheses`` are listed, or when the budget is used up (then ``incomplete`` names it). The
    list is exact and in order, unless the budget ended the search: then it has the best hypotheses
    found so far, and there may be better ones that were not reached. Raises UsageError for a
    conflict or an answer with a name that the model does not have.
    """
    problem = covering_problem(model, fold_evidence(model, evidence))
    most = max_hypotheses * (_UNLISTED_SETS if model.unlisted else 1)
    found = search(problem, most, mass, budget or Budget())
    ids = model.mode_ids
    listed = [(frozenset(ids[mode] for mode in modes), share) for modes, share in found.sets]
    with_common, grown = with_common_cause(model, evidence, listed)
    sets, meant = with_unlisted(model, with_common)
    sets = sets[:max_hypotheses]
    predictions = [predict(model, meant.get(faults, faults)) for faults, _ in sets]
    known = KnownSymptoms.of(model, evidence)
    hypotheses = [
        known.hypothesis(model, faults, share, prediction)
        for (faults, share), prediction in zip(sets, predictions, strict=True)
    ]
    seen = known.absent.union(place for _, place in known.present)
    signatures = [
        (UNKNOWN in faults, *signature(model, evidence, seen, prediction))
        for (faults, _), prediction in zip(sets, predictions, strict=True)
    ]
    filled, groups = group_hypotheses(hypotheses, signatures)
    findings = tuple(name for name in evidence.observations if name not in model.sign_places)
    covered = found.covered and grown / (grown - 1.0 + 1.0 / found.covered)
    return RankedHypotheses(filled, groups, covered, found.incomplete, findings, found.opened)


@dataclass(frozen=True, slots=True)
class KnownSymptoms:
    """The symptoms that are present and that are absent, with their places in the model."""

    present: tuple[tuple[str, int], ...]
    absent: frozenset[int]
    levels: Mapping[int, int]

    @classmethod
    def of(cls, model: Model, evidence: Evidence) -> KnownSymptoms:
        """Select the symptoms that are in the model."""
        places = model.sign_places
        present, absent, levels = [], [], {}
        for name, observation in evidence.observations.items():
            place = places.get(name)
            if place is not None and observation.state == "present":
                present.append((name, place))
                if observation.level is not None and place in model.tables.graded:
                    levels[place] = observation.level
            elif place is not None and observation.state == "absent":
                absent.append(place)
        return cls(tuple(present), frozenset(absent), levels)

    def hypothesis(
        self, model: Model, faults: frozenset[str], probability: float, prediction: Prediction
    ) -> Hypothesis:
        """Return the hypothesis of a set of faults: explained, unexplained, contrary symptoms."""
        unknown = prediction.unknown and model.unknown is not None and model.unknown.detects > 0
        explained = {
            place
            for _, place in self.present
            if unknown or (place in prediction.misses and self._fits(model, place, prediction))
        }
        against = (place for place in prediction.misses if place in self.absent)
        return Hypothesis(
            hypothesis_id(faults),
            faults,
            probability,
            tuple(name for name, place in self.present if place in explained),
            tuple(name for name, place in self.present if place not in explained),
            tuple(
                model.signs[place].id
                for place in sorted(against)
                if prediction.expected(model, place) >= EXPECTED
            ),
            criticality=sum(model.modes[place].criticality for place in sorted(prediction.modes)),
            follows=following(model, faults),
        )

    def _fits(self, model: Model, place: int, prediction: Prediction) -> bool:
        """Return whether the size of a symptom is one that the faults show."""
        level = self.levels.get(place)
        if level is None:
            return True
        sizes = prediction.sizes(model, place)
        return sizes[level] >= LEAST_FIT * max(sizes[1:])


def hypothesis_id(faults: Iterable[str]) -> str:
    """Return the id of a hypothesis, made of its faults alone: equal in every answer."""
    return " + ".join(sorted(faults)) or NO_FAULT
