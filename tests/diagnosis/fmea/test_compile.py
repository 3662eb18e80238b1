"""The numbers and tests that the covering engine gets."""

from __future__ import annotations

import pytest

from amberbox.core.types import Symptom
from amberbox.diagnosis.covering.hypotheses import diagnose
from amberbox.diagnosis.covering.model import Link
from amberbox.diagnosis.covering.observations import collect_evidence
from amberbox.diagnosis.knowledge import compile_checks, compile_model
from tests.diagnosis.fmea.small import small


def test_everything_is_handed_on() -> None:
    fmea = small()
    model = compile_model(fmea)
    assert [mode.id for mode in model.modes] == list(fmea.modes)
    assert [sign.id for sign in model.signs] == list(fmea.symptoms)
    assert {f.id: f.needs for f in model.functions} == fmea.needs()
    assert Link("carry", "tasks/log/none_given_up", 0.4) in model.links
    assert Link("laser_front#dirty", "laser_front/window/clear", 0.9) in model.links
    assert model.unknown is not None and model.unknown.prior == fmea.other.probability
    by_id = {mode.id: mode for mode in model.modes}
    assert by_id["laser_front#dead"].takes_down and not by_id["laser_front#dirty"].takes_down
    assert by_id["laser_front#dead"].prior == pytest.approx(1 - 0.99004983)
    shorter = {mode.id: mode.prior for mode in compile_model(fmea, 1).modes}
    assert shorter["laser_front#dead"] == pytest.approx(1e-4, rel=1e-3)
    assert shorter["hook#bent"] == 0.03


def test_what_the_unknown_looks_like_is_handed_on() -> None:
    other = "other: {looks_like: 0.03, together_s: 20}\nexposure_h: 100"
    unknown = compile_model(small("exposure_h: 100", other)).unknown
    assert unknown is not None
    assert (unknown.looks_like, unknown.together_s) == (0.03, 20.0)
    off = compile_model(small()).unknown
    assert off is not None and off.looks_like == 0.0


def test_a_loss_explains_what_shows_at_the_top() -> None:
    fmea = small()
    present = ("tasks/log/none_given_up", "host/heartbeat/alive")
    symptoms = [Symptom(name, "present" if name in present else "absent") for name in fmea.symptoms]
    best = diagnose(compile_model(fmea), collect_evidence(symptoms)).hypotheses[0]
    assert best.faults == {"host#off"} and set(best.explains) == set(present)


def test_tests_know_what_each_mode_makes_them_give() -> None:
    checks = {check.id: check for check in compile_checks(small())}
    check = checks["laser_front.look"]
    assert (check.kind, check.cost_s, check.outcomes) == ("question", 60, ("clean", "dirty", "wet"))
    given = [
        (detection.cause, detection.outcome, detection.detects) for detection in check.detections
    ]
    assert given == [("laser_front#dirty", "dirty", 0.95), ("laser_front#wet", "wet", 0.8)]
