"""The answer: which sets of faults explain the evidence, how probable each is, and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from amberbox.core.types import AmbiguityGroup, Hypothesis
from amberbox.diagnosis.covering.budget import Budget
from amberbox.diagnosis.covering.clues import folded
from amberbox.diagnosis.covering.common_cause import with_common_cause
from amberbox.diagnosis.covering.evidence import Evidence
from amberbox.diagnosis.covering.groups import EXPECTED, grouped, signature
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.covering.prediction import Prediction, predict
from amberbox.diagnosis.covering.problem import problem_of
from amberbox.diagnosis.covering.search import search

NO_FAULT = "no fault"
"""The id of the hypothesis that nothing is broken: what was seen are false alarms."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Hypotheses from likely to unlikely, and the ambiguity groups they fall into.

    A hypothesis' probability is its share of what was enumerated; its true posterior lies
    between ``probability * mass_covered`` and ``probability``. ``incomplete`` says which budget
    ended the search, empty if none did. ``findings`` are symptoms that the model does not know.
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
) -> Answer:
    """Rank the sets of failure modes by their probability given the evidence.

    The search ends when the hypotheses listed hold at least ``mass`` of all probability, when
    ``max_hypotheses`` are listed, or when the budget is used up (then ``incomplete`` says so).
    What is listed is exact and in order, unless the budget ended the search: then it is the best
    that was found, and better ones may hide in what is not covered. Raises UsageError for a
    conflict or an answer that names what the model does not have.
    """
    problem = problem_of(model.tables, folded(model, evidence))
    found = search(problem, max_hypotheses, mass, budget or Budget())
    ids = model.mode_ids
    listed = [(frozenset(ids[mode] for mode in modes), share) for modes, share in found.sets]
    sets, grown = with_common_cause(model, evidence, listed)
    sets = sets[:max_hypotheses]
    predictions = [predict(model, faults) for faults, _ in sets]
    known = Known.of(model, evidence)
    hypotheses = [
        known.hypothesis(model, faults, share, prediction)
        for (faults, share), prediction in zip(sets, predictions, strict=True)
    ]
    seen = known.absent.union(place for _, place in known.present)
    signatures = [signature(model, evidence, seen, prediction) for prediction in predictions]
    filled, groups = grouped(hypotheses, signatures)
    findings = tuple(name for name in evidence.observations if name not in model.sign_places)
    covered = found.covered and grown / (grown - 1.0 + 1.0 / found.covered)
    return Answer(filled, groups, covered, found.incomplete, findings, found.opened)


@dataclass(frozen=True, slots=True)
class Known:
    """The symptoms that are present and that are absent, with their places in the model."""

    present: tuple[tuple[str, int], ...]
    absent: frozenset[int]

    @classmethod
    def of(cls, model: Model, evidence: Evidence) -> Known:
        """Take the symptoms that the model knows."""
        places = model.sign_places
        present, absent = [], []
        for name, observation in evidence.observations.items():
            place = places.get(name)
            if place is not None and observation.state == "present":
                present.append((name, place))
            elif place is not None and observation.state == "absent":
                absent.append(place)
        return cls(tuple(present), frozenset(absent))

    def hypothesis(
        self, model: Model, faults: frozenset[str], probability: float, prediction: Prediction
    ) -> Hypothesis:
        """Say what a set of faults explains, leaves open, and what speaks against it."""
        unknown = prediction.unknown and model.unknown is not None and model.unknown.detects > 0
        explained = {place for _, place in self.present if unknown or place in prediction.misses}
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
            criticality=sum(_criticality(model, place) for place in sorted(prediction.modes)),
        )


def hypothesis_id(faults: Iterable[str]) -> str:
    """Name a hypothesis by its faults alone, so that it keeps its id from answer to answer."""
    return " + ".join(sorted(faults)) or NO_FAULT


def _criticality(model: Model, place: int) -> float:
    return model.modes[place].criticality
