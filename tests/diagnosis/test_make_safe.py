"""What makes safe comes before every test, and a test before what is mended in vain."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom
from amberbox.core.types import Test as Proposed
from amberbox.diagnosis.diagnose import DiagnosisId, Effort, ObservedSituation, answer
from amberbox.diagnosis.fmea.model import FailureMode
from amberbox.diagnosis.make_safe import (
    CREDIBLE,
    DANGEROUS,
    repair_action,
    safe_action,
    safety_actions,
)
from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import Explanation
from amberbox.diagnosis.report.next_step import AS_LIKELY
from amberbox.diagnosis.report.text import as_text
from amberbox.monitoring.findings import diagnosis_of, diagnosis_values
from tests.fuzzing import examples, fuzz
from tests.server.knowledge import robot as sim

AT_NS = 1_795_305_600_000_000_000
BATTERY = "battery#overheats"
SWITCH_OFF = "switch off, let it cool outside"


def shown_by(modes: Iterable[str]) -> tuple[Symptom, ...]:
    """Return what failure modes are likely to show; all else is absent."""
    fmea = sim.knowledge().fmea
    links = [link for mode in modes for link in fmea.modes[mode].symptoms]
    there = [link.symptom for link in links if link.detects >= 0.5]
    there = list(dict.fromkeys(there or [link.symptom for link in links[:1]]))
    absent = (Symptom(name, "absent", name) for name in fmea.symptoms if name not in there)
    seen = (Symptom(n, "present", n, AT_NS + k, AT_NS + k) for k, n in enumerate(there))
    return (*seen, *absent)


def told_of(*modes: str, unseen: str = "") -> tuple[Diagnosis, Explanation]:
    """Return diagnosis and explanation of what failure modes show.

    Symptoms whose names end with ``unseen`` are not known.
    """
    seen = tuple(one for one in shown_by(modes) if not unseen or not one.id.endswith(unseen))
    situation, heading = ObservedSituation(seen, watched=True), DiagnosisId("d", 1, AT_NS)
    found = answer(sim.knowledge(), situation, heading, Effort(hypotheses=10))
    return found, explain(found, sim.knowledge(), seen)


def assert_safe_order(found: Diagnosis, told: Explanation) -> None:
    """Check the order of what to do next against the diagnosis and the FMEA alone."""
    fmea, step = sim.knowledge().fmea, told.next
    leading = found.hypotheses[:1] if not found.groups else [
        h for h in found.hypotheses if h.id in found.groups[0].members
    ]  # fmt: skip
    shares: dict[str, float] = {}
    for h in found.hypotheses:
        for fault in h.faults:
            shares[fault] = shares.get(fault, 0.0) + h.probability
    credible = {f for f, share in shares.items() if share >= CREDIBLE}
    credible |= {f for h in leading for f in h.faults}
    wanted = {safe_action(fmea.modes[f]) for f in credible if f in fmea.modes} - {""}
    kinds = [action.kind for action in step.order]
    first = kinds.count("make_safe")
    assert {action.text for action in step.order[:first]} == wanted
    assert "make_safe" not in kinds[first:]
    for action in step.order[:first]:
        assert action.text in step.text
        assert not step.test or step.text.index(action.text) < step.text.index(step.then)
    false_alarm = sum(h.probability for h in found.hypotheses if not h.faults)
    led = sum(h.probability for h in leading)
    if kinds[first:] and false_alarm >= AS_LIKELY * led:
        assert kinds[first] != "repair"


def test_a_battery_that_may_catch_fire_is_switched_off_before_any_question() -> None:
    found, told = told_of("localisation#shift", "laser_front#lens_dirty", BATTERY)
    assert told.next.test, "there is a test to do"
    assert [action.text for action in told.next.make_safe] == [SWITCH_OFF]
    assert told.next.text.startswith(f"First, make it safe: {SWITCH_OFF}. Then: ")
    assert found.make_safe == (SWITCH_OFF,), "also who reads the record alone is told"
    text = as_text(told)
    assert text.index(SWITCH_OFF) < text.index(told.next.then.split("?")[0][:20])


def test_every_failure_mode_alone_has_a_safe_order() -> None:
    for mode in sim.knowledge().fmea.modes:
        assert_safe_order(*told_of(mode))


def test_pairs_of_failure_modes_have_a_safe_order() -> None:
    modes = sorted(sim.knowledge().fmea.modes)
    for pair in list(combinations(modes, 2))[::67]:
        assert_safe_order(*told_of(*pair))


SETS = st.lists(st.frozensets(st.integers(0, 137), max_size=3), min_size=5, max_size=5, unique=True)
SHARES = st.lists(st.floats(1e-4, 1.0), min_size=5, max_size=5)
TESTS = st.lists(st.integers(0, 200), max_size=3, unique=True)


@fuzz
@given(SETS, SHARES, TESTS)
@settings(max_examples=examples(25))
def test_the_order_is_safe_for_any_posterior(
    sets: list[frozenset[int]], shares: list[float], tests: list[int]
) -> None:
    modes, checks = sorted(sim.knowledge().fmea.modes), list(sim.knowledge().checks.values())
    of_each = [frozenset(modes[k % len(modes)] for k in one) for one in sets]
    merged: dict[frozenset[str], float] = {}
    for faults, share in zip(of_each, shares, strict=True):
        merged[faults] = merged.get(faults, 0.0) + share
    ranked = [
        Hypothesis(f"h{k}", faults, share / sum(shares), ("battery.heats",))
        for k, (faults, share) in enumerate(sorted(merged.items(), key=lambda one: -one[1]))
    ]
    asked = [checks[k % len(checks)] for k in tests]
    found = Diagnosis(
        "d", 1, "r", AT_NS, "", tuple(ranked), 1.0,
        next_tests=tuple(Proposed(one.id, "check", one.text) for one in asked),
        groups=tuple(AmbiguityGroup((h.id,), h.probability) for h in ranked),
    )  # fmt: skip
    assert_safe_order(found, explain(found, sim.knowledge(), ()))


@pytest.mark.parametrize(
    ("remedy", "safe", "rest"),
    [
        ("switch off, let it cool outside, replace it", SWITCH_OFF, "replace it"),
        ("stop before it burns; replace drive 1", "stop before it burns", "replace drive 1"),
        ("Keep people away. Then replace the hose.", "Keep people away", "Then replace the hose."),
        ("turn the button until it is out", "", "turn the button until it is out"),
        ("look into the log, restart it", "", "look into the log, restart it"),
        ("switch off", "switch off", ""),
    ],
)
def test_an_analysis_without_make_safe_is_read_by_how_its_remedies_begin(
    remedy: str, safe: str, rest: str
) -> None:
    mode = FailureMode("a#b", "a", "b", severity="fatal", remedy=remedy)
    assert (safe_action(mode), repair_action(mode)) == (safe, rest)
    assert safe_action(replace(mode, severity="urgent")) == ""
    assert safe_action(replace(mode, make_safe="run")) == "run"


def test_the_worst_comes_first_and_what_is_hardly_possible_does_not() -> None:
    fmea = sim.knowledge().fmea
    hot = "wheel_front_left#winding_hot"
    both = [Hypothesis("a", frozenset({hot}), 0.94), Hypothesis("b", frozenset({BATTERY}), 0.06)]
    assert [a.faults for a in safety_actions(fmea, both, {"a"})] == [(BATTERY,), (hot,)]
    less = [replace(both[0], probability=0.96), replace(both[1], probability=0.04)]
    assert [a.faults for a in safety_actions(fmea, less, {"a"})] == [(hot,)]
    assert fmea.modes[hot].severity in DANGEROUS


def test_a_record_of_an_older_watcher_is_read() -> None:
    found, _ = told_of(BATTERY)
    values = dict(diagnosis_values(found))
    assert diagnosis_of(values) == found
    del values["make_safe"]
    assert diagnosis_of(values) == replace(found, make_safe=())
