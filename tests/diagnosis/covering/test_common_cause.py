"""Several known faults that begin together may be one thing that is not in the FMEA."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import replace

import pytest

from amberbox.core.clock import NS
from amberbox.diagnosis.covering.hypotheses import diagnose
from amberbox.diagnosis.covering.model import UNKNOWN, Link, Mode, Model, Sign, Unknown
from amberbox.diagnosis.covering.observations import Evidence, Observation
from tests.diagnosis.covering.brute import named, posterior, restricted, with_common_cause
from tests.diagnosis.covering.small_models import random_evidence, random_model

MODES = tuple(Mode(f"wheel_{n}#slip", 1e-3) for n in range(5))
MODEL = Model(
    MODES,
    tuple(Sign(f"wheel_{n}/spins", 1e-4) for n in range(5)),
    tuple(Link(f"wheel_{n}#slip", f"wheel_{n}/spins", 0.95) for n in range(5)),
    unknown=Unknown(2e-4, 0.001, looks_like=0.02),
)


def seen(onsets_s: Mapping[int, float], model: Model = MODEL) -> Evidence:
    """Return that some wheels spin since these times, and that the others do not."""
    observations = {
        sign.id: Observation("present" if place in onsets_s else "absent")
        for place, sign in enumerate(model.signs)
    }
    onsets_ns = {f"wheel_{n}/spins": round(at_s * NS) for n, at_s in onsets_s.items()}
    return Evidence(observations, onsets_ns=onsets_ns)


def leading(evidence: Evidence, model: Model = MODEL) -> frozenset[str]:
    """Return the faults of the most probable hypothesis."""
    return diagnose(model, evidence).hypotheses[0].faults


def test_four_wheels_that_slip_at_once_are_something_else() -> None:
    at_once = seen({0: 5.0, 1: 5.5, 2: 6.0, 3: 5.0})
    answer = diagnose(MODEL, at_once)
    assert answer.hypotheses[0].faults == {UNKNOWN}
    assert answer.hypotheses[0].explains == tuple(at_once.onsets_ns)
    assert answer.groups[0].members == (UNKNOWN,)
    assert sum(h.probability for h in answer.hypotheses) <= 1 + 1e-12


def test_one_after_the_other_they_are_what_they_look_like() -> None:
    later = seen({0: 5.0, 1: 30.0, 2: 60.0, 3: 90.0})
    assert leading(later) == {f"wheel_{n}#slip" for n in range(4)}


def test_two_at_once_are_two() -> None:
    assert leading(seen({0: 5.0, 1: 5.0})) == {"wheel_0#slip", "wheel_1#slip"}


def test_what_has_no_known_onset_does_not_speak_against_it() -> None:
    four = seen({0: 5.0, 1: 5.0, 2: 5.0, 3: 5.0})
    assert leading(replace(four, onsets_ns={})) == {UNKNOWN}


def test_it_has_to_be_switched_on() -> None:
    off = replace(MODEL, unknown=Unknown(2e-4, 0.001))
    four = seen({0: 5.0, 1: 5.0, 2: 5.0, 3: 5.0})
    assert leading(four, off) == {f"wheel_{n}#slip" for n in range(4)}


def test_what_is_proven_is_there() -> None:
    proven = (frozenset({"wheel_0#slip"}),)
    four = replace(seen({0: 5.0, 1: 5.0, 2: 5.0, 3: 5.0}), conflicts=proven)
    assert "wheel_0#slip" in leading(four)


@pytest.mark.parametrize("seed", range(100))
def test_every_probability_equals_that_of_writing_out_all_sets(seed: int) -> None:
    rng = random.Random(seed)
    model = random_model(rng)
    other = Unknown(0.2 * rng.random(), rng.random(), looks_like=rng.random(), together_s=2.0)
    model = replace(model, unknown=other)
    evidence = random_evidence(rng, model)
    onsets_ns = {
        name: rng.randint(0, 6) * NS // 2
        for name, observation in evidence.observations.items()
        if observation.state == "present" and rng.random() < 0.8
    }
    evidence = replace(evidence, onsets_ns=onsets_ns)

    answer = diagnose(model, evidence, max_hypotheses=5000, mass=2.0)

    ours = {h.faults: h.probability for h in answer.hypotheses}
    known = diagnose(replace(model, unknown=replace(other, looks_like=0.0)), evidence,
                     max_hypotheses=5000, mass=2.0)  # fmt: skip
    names = named(h.faults for h in known.hypotheses)
    exact = restricted(posterior(model, evidence), names) if ours else {}
    expected = with_common_cause(model, evidence, exact)
    assert ours == pytest.approx({f: expected[f] for f in ours}, abs=1e-9)
    assert sum(p for f, p in expected.items() if f not in ours) < 1e-9
    assert not ours or answer.mass_covered == 1.0


def test_what_was_not_enumerated_stays_outside() -> None:
    four = seen({0: 5.0, 1: 5.0, 2: 5.0, 3: 5.0})
    few = diagnose(MODEL, four, max_hypotheses=1)
    assert [h.faults for h in few.hypotheses] == [{UNKNOWN}]
    assert 0 < few.mass_covered < 1
