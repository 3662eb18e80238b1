"""Tests of fmea.yaml that are experiments or unit tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from amberbox.core.types import RunKind
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences, RunFacts
from amberbox.diagnosis.fmea.runs import answers_of_run
from tests.diagnosis.fmea.small import KNOWN, TEXT

RUNS: Mapping[RunKind, Mapping[str, RunFacts]] = {
    "experiment": {"wheel_check": RunFacts(180.0, moves=True)},
    "unit_test": {"laser.rate": RunFacts(parametrised=True), "host.up": RunFacts()},
}
KNOWS_RUNS = replace(KNOWN, runs=RUNS.__getitem__)


def read(tests: str, known: FmeaReferences | None = KNOWS_RUNS) -> tuple[Fmea | None, list[str]]:
    """Read the small analysis with tests, each in a line; return what is wrong with them."""
    lines = "".join(f"  {line}\n" for line in tests.splitlines())
    fmea, problems = read_fmea(f"{TEXT}tests:\n{lines}", known)
    return fmea, [str(problem) for problem in problems if "tests" in problem.where]


def test_duration_and_motion_are_those_of_the_run_unless_given() -> None:
    fmea, problems = read(
        "a: {experiment: wheel_check}\n"
        "b: {unit_test: laser.rate-front, moves: true, minutes: 2, text: it is quick}\n"
        "c: {unit_test: host.up}"
    )
    assert fmea is not None and problems == []
    a, b, c = (fmea.tests[name] for name in "abc")
    assert (a.kind, a.run, a.cost_s, a.moves) == ("experiment", "wheel_check", 180.0, True)
    assert (b.kind, b.cost_s, b.moves) == ("unit_test", 120.0, True)
    assert (c.cost_s, c.moves) == (60.0, False)
    assert a.text == "Run the experiment wheel_check."
    assert b.text == "Run the unit test laser.rate-front: it is quick"


@pytest.mark.parametrize(
    ("test", "what"),
    [
        ("{experiment: wheel_chek}", "did you mean 'wheel_check'?"),
        ("{unit_test: host.down}", "there is no unit test 'host.down'"),
        ("{unit_test: laser.rate}", "has parameters"),
        ("{experiment: wheel_check, unit_test: host.up}", "give one of"),
        ("{experiment: wheel_check, outcomes: [a, b, c]}", "it has two answers"),
        ("{experiment: wheel_check, passed: maybe}", "none of the answers"),
        ("{question: Well?, passed: 'yes'}", "belongs to an experiment"),
        ("{question: Well?, moves: true}", "belongs to an experiment"),
    ],
)
def test_mistakes_are_named(test: str, what: str) -> None:
    fmea, problems = read(f"a: {test}")
    assert fmea is None and what in "\n".join(problems)


def test_one_run_is_evidence_once() -> None:
    fmea, problems = read("a: {unit_test: host.up}\nb: {unit_test: host.up}")
    assert fmea is None and "is run by the test a already" in problems[0]


def test_without_the_folder_names_are_not_compared() -> None:
    for known in (None, KNOWN):
        fmea, problems = read("a: {experiment: unheard_of}", known)
        assert fmea is not None and problems == []


def test_a_verdict_is_an_answer_and_what_is_none_answers_nothing() -> None:
    fmea, _ = read(
        "a: {experiment: wheel_check}\n"
        "b: {unit_test: host.up, outcomes: [good, bad], passed: bad}"
    )  # fmt: skip
    assert fmea is not None
    assert answers_of_run(fmea, "experiment", "wheel_check", "passed") == {"a": "no"}
    assert answers_of_run(fmea, "experiment", "wheel_check", "failed") == {"a": "yes"}
    assert answers_of_run(fmea, "unit_test", "host.up", "passed") == {"b": "bad"}
    assert answers_of_run(fmea, "unit_test", "host.up", "failed") == {"b": "good"}
    for verdict in ("undecided", "aborted", "error", "skipped", "timeout", "killed"):
        assert answers_of_run(fmea, "unit_test", "host.up", verdict) == {}
    assert answers_of_run(fmea, "experiment", "host.up", "failed") == {}
