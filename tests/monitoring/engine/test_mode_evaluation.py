"""Judging results: one by one and in columns alike, and only what fits the output's type."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from amberbox.core.mode import HOLD, UNKNOWN, Result
from amberbox.core.types import Status
from amberbox.monitoring.findings import encoded
from amberbox.monitoring.mode_evaluation import AS_BEFORE, BAD, NOT_KNOWN, OK, OutputJudge
from amberbox.monitoring.plan import Expectation, OutputPlan


def judge(kind: Any, expectation: Expectation | None = None) -> OutputJudge:
    """Return the evaluation of an output of a type."""
    return OutputJudge(
        OutputPlan("o", kind, Result("o", kind, ""), None, expectation or Expectation())
    )


AT_LEAST = Expectation(2, ">=")


@pytest.mark.parametrize(
    ("kind", "expectation", "result", "code"),
    [
        ("float", None, None, OK),
        ("float", AT_LEAST, None, NOT_KNOWN),
        ("string", None, None, OK),
        ("bool", Expectation(True), None, NOT_KNOWN),
        ("bool", Expectation(True), UNKNOWN, NOT_KNOWN),
        ("bool", Expectation(True), HOLD, AS_BEFORE),
        ("bool", Expectation(True), 7, NOT_KNOWN),
        ("int", AT_LEAST, 1, BAD),
        ("int", AT_LEAST, 2.5, OK),
        ("float", AT_LEAST, np.nan, NOT_KNOWN),
        ("string", Expectation("a", "!="), "a", BAD),
    ],
)
def test_one_and_many_judge_alike(
    kind: Any, expectation: Expectation | None, result: Any, code: int
) -> None:
    asked = judge(kind, expectation)
    codes, kept = asked.many(np.array([result, None], object), 2)
    assert asked.one(result)[0] == codes[0] == code
    assert str(asked.output(kept[0])) == str(asked.output(asked.one(result)[1]))
    assert asked.many(result, 2)[0].tolist() == [code, code]


@pytest.mark.parametrize(
    ("kind", "result"),
    [("float", [1.0]), ("float", "1"), ("int", {}), ("string", 1.0), ("float", 1j)],
)
def test_what_is_of_another_type_is_refused(kind: Any, result: Any) -> None:
    with pytest.raises(TypeError, match="o is no"):
        judge(kind).one(result)


@pytest.mark.parametrize("result", [1e300, -np.inf, 1 << 70, np.uint64((1 << 64) - 1)])
def test_numbers_that_are_too_long_can_be_written(result: Any) -> None:
    asked = judge("int")
    for kept in (asked.one(result)[1], asked.many(result, 1)[1][0]):
        value = asked.output(kept)
        status = Status("r", "c", "m", "ok", "", {"o": value}, (), 1, 1, "", "")
        assert msgspec.json.decode(encoded(status)[1])["outputs"][0]["name"] == "o"
