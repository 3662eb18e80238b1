"""Diagnosis by fault trees against writing out every set of failure modes of small robots."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from amberbox.core.types import Symptom, SymptomState
from amberbox.diagnosis.diagnose import DiagnosisId, Effort, ObservedSituation
from amberbox.diagnosis.evidence.faulttree import conclude
from amberbox.diagnosis.fmea import model
from amberbox.diagnosis.fmea.model import Fmea, SymptomLink, lost
from amberbox.diagnosis.knowledge import Knowledge
from tests.diagnosis.fmea.test_trees import fmeas

LEAK = 0.01
SYMPTOMS = ("s0", "s1", "s2", "s3")
STATES: tuple[SymptomState, ...] = ("present", "present", "absent", "unknown")


@st.composite
def with_symptoms(draw: st.DrawFn) -> Fmea:
    """Draw an analysis whose failure modes and functions show symptoms."""
    fmea = draw(fmeas())
    chosen = st.lists(st.sampled_from(SYMPTOMS), max_size=2, unique=True)
    sure = st.sampled_from((0.3, 0.9, 0.99))

    def links() -> tuple[SymptomLink, ...]:
        return tuple(SymptomLink(symptom, draw(sure), 0.0, 0.0) for symptom in draw(chosen))

    return replace(
        fmea,
        modes={name: replace(mode, symptoms=links()) for name, mode in fmea.modes.items()},
        functions={name: replace(f, symptoms=links()) for name, f in fmea.functions.items()},
        symptoms={name: model.FmeaSymptom(name, leak=LEAK) for name in SYMPTOMS},
    )


def active(fmea: Fmea, faults: frozenset[str]) -> Iterator[SymptomLink]:
    """Yield the symptom links of present faults and of lost functions."""
    gone = lost(fmea, faults)
    for name in faults:
        yield from fmea.modes[name].symptoms
    for name in gone & set(fmea.functions):
        yield from fmea.functions[name].symptoms


def weight(fmea: Fmea, states: Mapping[str, SymptomState], faults: frozenset[str]) -> float:
    """Return prior times likelihood of present and absent symptoms, by the formula in the
    documentation.
    """
    silent = dict.fromkeys(SYMPTOMS, 1.0)
    for link in active(fmea, faults):
        silent[link.symptom] *= 1.0 - link.detects
    chance = math.prod(fmea.modes[name].chance() for name in faults)
    for name, state in states.items():
        if state == "present":
            chance *= 1.0 - (1.0 - LEAK) * silent[name]
        elif state == "absent":
            chance *= silent[name]
    return chance


def smallest(fmea: Fmea, to_explain: set[str]) -> list[frozenset[str]]:
    """Write out the sets of failure modes that show all this, without those that hold another."""
    found: list[frozenset[str]] = []
    for size in range(len(fmea.modes) + 1):
        for faults in map(frozenset, itertools.combinations(sorted(fmea.modes), size)):
            shown = {link.symptom for link in active(fmea, faults)}
            if to_explain <= shown and not any(smaller <= faults for smaller in found):
                found.append(faults)
    return found


@settings(max_examples=100)
@given(with_symptoms(), st.lists(st.sampled_from(STATES), min_size=4, max_size=4))
def test_it_lists_the_smallest_sets_that_explain_all(fmea: Fmea, drawn: list[SymptomState]) -> None:
    states = dict(zip(SYMPTOMS, drawn, strict=True))
    links = [*(mode.symptoms for mode in fmea.modes.values()),
             *(function.symptoms for function in fmea.functions.values())]  # fmt: skip
    present = {name for name, state in states.items() if state == "present"}
    to_explain = present & {link.symptom for link in itertools.chain(*links)}
    assume(to_explain or not present)
    weights = {f: weight(fmea, states, f) for f in smallest(fmea, to_explain)}
    expected = {f: w / sum(weights.values()) for f, w in weights.items() if w > 0.0}
    situation = ObservedSituation(tuple(Symptom(name, state) for name, state in states.items()))
    effort = Effort(hypotheses=10_000)
    found = conclude(Knowledge("robot", fmea), situation, DiagnosisId("d", 1, 0), effort)
    listed = {h.faults: h.probability for h in found.hypotheses}
    assert listed == pytest.approx(expected, rel=1e-9)
    assert list(listed.values()) == sorted(listed.values(), reverse=True)
    assert found.mass_covered == pytest.approx(1.0 if expected else 0.0)
