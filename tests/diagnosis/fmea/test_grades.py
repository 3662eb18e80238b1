"""Sizes, times, exclusions and consequences in ``fmea.yaml``: what they become, and errors."""

from __future__ import annotations

import math

import pytest

from amberbox.core.errors import Problem
from amberbox.core.expression import parse
from amberbox.diagnosis.fmea.criticality import coverage
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import (
    Fmea,
    FmeaReferences,
    SizeDistribution,
    SizeScale,
    SymptomMeasure,
)
from amberbox.diagnosis.knowledge import compile_model

COOL = "battery/temperature/cool"
TEXT = """\
defaults: {exclusive: true}
symptoms:
  battery/temperature/cool: {measure: battery.temp - 45, unit: degC, edges: [2, 5, 10, 20]}
types:
  battery:
    failure_modes:
      hot:
        probability: 0.01
        symptoms: [{symptom: battery/temperature/cool, after_s: [0, 30], size: {uniform: [5, 20]}}]
        with: [worn]
        leads_to: {navigation#crash: {p: 0.3, after_s: [10, 600]}, worn: 0.1}
      worn: {probability: 0.02, symptoms: [battery/voltage/high]}
      gone: {probability: 0.001, symptoms: [battery/voltage/high]}
  navigation:
    failure_modes:
      crash: {probability: 0.001, symptoms: [navigation/process/runs]}
"""
KNOWN = FmeaReferences(
    outputs=(COOL, "battery/voltage/high", "navigation/process/runs"),
    watched=(COOL, "battery/voltage/high", "navigation/process/runs"),
    addresses=("battery.temp", "battery.volts"),
    measures={COOL: SymptomMeasure(parse("battery.temp - 40"), "degC")},
    units={"battery.temp": "degC", "battery.volts": "V"},
)


def loaded(text: str = TEXT) -> Fmea:
    fmea, problems = read_fmea(text, KNOWN)
    assert fmea is not None, problems
    return fmea


def problems_of(old: str, new: str) -> list[Problem]:
    assert old in TEXT
    return read_fmea(TEXT.replace(old, new), KNOWN)[1]


def test_the_keys_become_a_model() -> None:
    model = compile_model(loaded())
    hot, worn, gone, crash = model.modes
    assert hot.excludes == {"battery#gone"} and worn.excludes == {"battery#gone"}
    assert gone.excludes == {"battery#hot", "battery#worn"} and not crash.excludes
    assert [(one.cause, one.effect, one.p, one.after_s) for one in model.leads_to] == [
        ("battery#hot", "navigation#crash", 0.3, (10, 600)),
        ("battery#hot", "battery#worn", 0.1, None),
    ]
    link = next(link for link in model.links if link.symptom == COOL)
    assert link.after_s == (0, 30)
    assert link.sizes == pytest.approx((0, 0, 0, 0, 0, 1 / 3, 0, 2 / 3, 0, 0))


def test_levels_rise_with_the_magnitude_and_tell_the_sign() -> None:
    scale = SizeScale(SymptomMeasure(parse("a.b")), (2.0, 5.0))
    sizes = (-0.1, 0.1, -2.0, 2.0, -7.0, 7.0, math.nan, math.inf, None)
    assert [scale.level(size) for size in sizes] == [1, 2, 3, 4, 5, 6, None, None, None]
    spread = scale.shares(SizeDistribution("normal", 0.0, 3.0))
    assert spread[::2] == pytest.approx(spread[1::2]) and sum(spread) == pytest.approx(1)


def test_the_measure_may_be_that_of_the_monitor() -> None:
    fmea = loaded(TEXT.replace("measure: battery.temp - 45, unit: degC, ", ""))
    scale = fmea.symptoms[COOL].scale
    assert scale is not None
    assert (scale.measure.expression.text, scale.measure.unit) == ("battery.temp - 40", "degC")


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("edges: [2, 5, 10, 20]", "edges: [2, 2]", "must rise"),
        ("edges: [2, 5, 10, 20]", "edges: [0, 2]", "must be above 0"),
        (", edges: [2, 5, 10, 20]", "", "is of no use without edges"),
        ("uniform: [5, 20]", "uniform: [20, 5]", "nothing is from 20 to 5"),
        ("uniform: [5, 20]", "normal: [5, 0]", "must be above 0"),
        ("uniform: [5, 20]", "uniform: [5, 20], normal: [1, 1]", "give either uniform"),
        ("after_s: [0, 30]", "after_s: [30, 0]", "nothing is from 30 to 0"),
        ("after_s: [0, 30]", "after_s: [30]", "expected two times"),
        ("unit: degC", "unit: K", "battery.temp is in degC, not in K"),
        ("measure: battery.temp - 45", "measure: battery.tmp - 45", "did you mean"),
        ("measure: battery.temp - 45", "measure: battery.temp > 45", "is no number"),
        ("with: [worn]", "with: [wornn]", "has no mode 'wornn'; did you mean 'worn'?"),
        ("navigation#crash: {p", "navigation#crsh: {p", "did you mean 'navigation#crash'"),
        ("{p: 0.3,", "{p: 1.3,", "above 1"),
        ("worn: 0.1", "gone: 0.1", "leads to battery#gone, which it excludes"),
        (
            "crash: {probability: 0.001",
            "crash: {leads_to: {battery#hot: 0.1}, probability: 0.001",
            "leads to itself",
        ),
        (
            "battery/temperature/cool: {measure",
            "battery/voltage/high: {measure",
            "nothing measures battery/temperature/cool",
        ),
    ],
)
def test_what_makes_no_sense_is_an_error(old: str, new: str, what: str) -> None:
    errors = [problem for problem in problems_of(old, new) if problem.is_error]
    assert any(what in f"{one.what} {one.hint}" for one in errors), errors
    assert all(one.line > 1 for one in errors)


def test_a_cause_without_a_size_beside_one_with_it_is_a_note() -> None:
    text = "symptoms: [battery/voltage/high]}\n      gone"
    found = problems_of(text, text.replace("[", "[battery/temperature/cool, "))
    assert [one.is_error for one in found] == [False]
    assert "no size of battery/temperature/cool" in found[0].what


def test_without_the_new_keys_nothing_changes() -> None:
    plain = """\
types:
  a: {failure_modes: {x: {probability: 0.1, symptoms: [battery/voltage/high]}}}
"""
    model = compile_model(loaded(plain))
    assert not (model.tables.graded or model.tables.timed or model.tables.joint.excludes)


def test_sizes_and_times_tell_modes_apart() -> None:
    same = "[{symptom: battery/temperature/cool, size: {uniform: [5, 20]}}]"
    worn = "worn: {probability: 0.02, symptoms: [battery/voltage/high]}"
    text = TEXT.replace(worn, f"worn: {{probability: 0.02, symptoms: {same}}}")
    for after_s, distinct in (("", 3), ("after_s: [0, 30], ", 4)):
        fmea = loaded(text.replace("after_s: [0, 30], ", after_s))
        assert coverage(fmea).distinct == distinct
