"""Ambiguity groups: hypotheses that nothing that is known tells apart."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from amberbox.core.types import AmbiguityGroup, Hypothesis
from amberbox.diagnosis.covering.evidence import Evidence
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.covering.prediction import Prediction, outcomes

EXPECTED = 0.5
"""From this probability on a symptom is expected of a hypothesis."""


def signature(
    model: Model, evidence: Evidence, known: Collection[int], prediction: Prediction
) -> tuple[object, ...]:
    """Return what the known symptoms (by place) and answers can see of a hypothesis."""
    caused = [place for place in prediction.misses if place in known]
    expected = (place for place in caused if prediction.expected(model, place) >= EXPECTED)
    answers = (
        outcomes(model, a.check, prediction)[a.check.level(a.outcome)] >= EXPECTED
        for a in evidence.answers
    )
    return (prediction.unknown, frozenset(caused), frozenset(expected), tuple(answers))


def grouped(
    hypotheses: Sequence[Hypothesis], signatures: Sequence[object]
) -> tuple[tuple[Hypothesis, ...], tuple[AmbiguityGroup, ...]]:
    """Return the hypotheses with their ambiguity filled in, and the groups by probability."""
    alike: dict[object, list[Hypothesis]] = {}
    for hypothesis, key in zip(hypotheses, signatures, strict=True):
        alike.setdefault(key, []).append(hypothesis)
    groups = sorted(map(_group, alike.values()), key=lambda group: -group.probability)
    members = {name: g.members for g in groups for name in (*g.members, *g.wider)}
    return tuple(_filled(h, members[h.id]) for h in hypotheses), tuple(groups)


def _filled(hypothesis: Hypothesis, members: Sequence[str]) -> Hypothesis:
    others = tuple(name for name in members if name != hypothesis.id)
    return replace(hypothesis, ambiguity=others) if others else hypothesis


def _group(alike: Sequence[Hypothesis]) -> AmbiguityGroup:
    wider = {h.id for h in alike if any(other.faults < h.faults for other in alike)}
    members = tuple(h.id for h in alike if h.id not in wider)
    others = tuple(h.id for h in alike if h.id in wider)
    return AmbiguityGroup(members, sum(h.probability for h in alike), others)
