"""`check` names failure modes that nothing tells apart, and outputs that none explains."""

from __future__ import annotations

import itertools
import math

import pytest

from amberbox.core.errors import Problem
from amberbox.core.expression import parse
from amberbox.diagnosis.fmea.blind_spots import RIGHT, indistinguishable
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import FmeaReferences, SymptomMeasure
from tests.diagnosis.fmea.small import KNOWN, TEXT

A, B, C = (f"motor/{name}/ok" for name in ("heat", "noise", "load"))
MOTOR = FmeaReferences(
    (A, B, C), (A, B, C), files={"motor": "components/motor.yaml"},
    measures={A: SymptomMeasure(parse("motor.temp - 40"))},
)  # fmt: skip
SYMPTOMS = f"symptoms: {{{A}: {{edges: [5, 20]}}}}\n"
TESTS = "    tests: {smell: {question: Does it smell?}}\n"


def notes(worn: str, burnt: str, more: str = "") -> list[Problem]:
    """Return the notes on a motor with two failure modes."""
    text = f"""\
{SYMPTOMS}types:
  motor:
{TESTS}    failure_modes:
      worn: {{rate: 1.0e-5, symptoms: {worn}}}
      burnt: {{rate: 1.0e-4, symptoms: {burnt}}}
{more}"""
    fmea, problems = read_fmea(text, MOTOR)
    assert fmea is not None, problems
    return problems


def alike(worn: str, burnt: str, more: str = "") -> bool:
    return any("nothing tells apart: worn, burnt" in one.what for one in notes(worn, burnt, more))


@pytest.mark.parametrize(
    ("worn", "burnt", "expected"),
    [
        (f"[{A}, {B}]", f"[{B}, {A}]", True),
        (f"[{A}]", f"[{{symptom: {A}, detects: 0.97}}]", True),
        (f"[{A}]", f"[{{symptom: {A}, detects: 0.7}}]", False),
        (f"[{A}]", f"[{A}, {B}]", False),
        (f"[{A}]", f"[{A}, {{symptom: {B}, detects: 0.02}}]", True),
        (f"[{{symptom: {A}, after_s: [0, 9]}}]", f"[{A}]", False),
        (
            f"[{{symptom: {A}, size: {{uniform: [0, 5]}}}}]",
            f"[{{symptom: {A}, size: {{uniform: [20, 50]}}}}]",
            False,
        ),
        (
            f"[{{symptom: {A}, size: {{uniform: [0, 5]}}}}]",
            f"[{{symptom: {A}, size: {{uniform: [0, 4]}}}}]",
            True,
        ),
        (
            f"[{{symptom: {A}, size: {{uniform: [0, 5]}}}}]",
            f"[{{symptom: {A}, size: {{uniform: [-5, 0]}}}}]",
            False,
        ),
    ],
)
def test_modes_that_show_the_same_are_named(worn: str, burnt: str, expected: bool) -> None:
    assert alike(worn, burnt) is expected


def test_a_test_tells_them_apart() -> None:
    assert not alike(f"[{A}], tests: {{smell: 'yes'}}", f"[{A}]")
    assert alike(f"[{A}], tests: {{smell: 'yes'}}", f"[{A}], tests: {{smell: 'yes'}}")


def test_a_finding_tells_them_apart() -> None:
    for rest in ("detects: 0.9", "proves: true"):
        finding = f"findings: [{{finding: spectrum, maps_to: [motor#worn], {rest}}}]\n"
        assert not alike(f"[{A}]", f"[{A}]", finding)


def test_the_note_is_one_for_all_instances_and_stands_at_their_type() -> None:
    text = TEXT.replace("        tests: {look: dirty}\n", "").replace(
        "        tests: {look: {outcome: wet, detects: 0.8}}\n", ""
    )
    text = text.replace(
        "{symptom: <component>/window/clear, detects: 0.5}", "<component>/window/clear"
    )
    fmea, problems = read_fmea(text.replace("detects: 0.9, within", "within"), KNOWN)
    assert fmea is not None
    (note,) = [one for one in problems if "nothing tells apart" in one.what]
    assert note.what == "nothing tells apart: dirty, wet" and not note.is_error
    assert text.splitlines()[note.line - 1].strip() == "failure_modes:"
    assert indistinguishable(fmea).keys() == {"laser_front", "laser_rear"}


def test_outputs_without_a_failure_mode_are_one_note_for_each_component() -> None:
    (note,) = notes(f"[{A}]", f"[{A}], tests: {{smell: 'yes'}}")
    assert (note.file, note.where) == ("components/motor.yaml", "motor")
    assert note.what.startswith("no failure mode shows load/ok, noise/ok:")


def test_an_output_that_a_condition_reads_is_used() -> None:
    both = f'symptoms: {{both: {{when: "`{B}` == false and `{C}` == false"}}}}'
    modes = f"failure_modes: {{worn: {{rate: 1.0e-5, symptoms: [{A}, both]}}}}"
    assert read_fmea(f"types: {{motor: {{{both}, {modes}}}}}", MOTOR)[1] == []


def test_a_large_analysis_is_judged_in_few_lines() -> None:
    modes = "".join(
        f"      m{n}: {{rate: 1.0e-5, symptoms: [motor/m{n // 4}/ok]}}\n" for n in range(400)
    )
    outputs = [f"motor/m{n}/ok" for n in range(300)]
    known = FmeaReferences(outputs, outputs)
    _, problems = read_fmea(f"types:\n  motor:\n    failure_modes:\n{modes}", known)
    unexplained, apart = (one.what for one in problems)
    assert apart.endswith("m8, m9, m10 and 1 more and 72 more")
    assert "and 197 more" in unexplained


def test_the_share_of_right_answers_is_bounded() -> None:
    """By writing out all observations of two equally probable modes."""
    links = {"x": (0.9, 0.5, 0.99), "y": (0.85, 0.55, 0.97)}
    names = ("a", "b", "c")
    right = 0.0
    for seen in itertools.product((False, True), repeat=3):
        chances = [
            math.prod(
                1 - (1 - 0.001) * (1 - d) if there else (1 - 0.001) * (1 - d)
                for d, there in zip(of, seen, strict=True)
            )
            for of in links.values()
        ]
        right += max(chances) / 2
    addresses = [f"motor/{name}/ok" for name in names]
    known = FmeaReferences(addresses, addresses)
    entries = "".join(
        f"      {mode}: {{rate: 1.0e-5, symptoms: ["
        + ", ".join(f"{{symptom: {a}, detects: {d}}}" for a, d in zip(addresses, of, strict=True))
        + "]}\n"
        for mode, of in links.items()
    )
    text = f"defaults: {{leak: 0.001}}\ntypes:\n  motor:\n    failure_modes:\n{entries}"
    fmea, _ = read_fmea(text, known)
    assert fmea is not None
    assert 0.5 < right < RIGHT and indistinguishable(fmea) == {"motor": [("motor#x", "motor#y")]}
