"""What an output should be."""

from __future__ import annotations

import re
from typing import Any, Literal

import pytest

from amberbox.core.mode import Result
from amberbox.monitoring.mode_bindings import expectation
from amberbox.monitoring.plan import Expectation

Type = Literal["bool", "int", "float", "string"]


def _result(kind: Type, relation: Literal["==", ">=", "<="] = "==", nominal: bool = True) -> Result:
    return Result("r", kind, "a result", nominal=nominal, relation=relation)


@pytest.mark.parametrize(
    ("expected", "kind", "relation", "result"),
    [
        (True, "bool", "==", Expectation(True)),
        ("no", "bool", "==", Expectation(False)),
        (50, "float", ">=", Expectation(50, ">=")),
        (-80, "int", ">=", Expectation(-80, ">=")),
        (50, "float", "==", Expectation(50, "==")),
        (">= 50", "float", "<=", Expectation(50, ">=")),
        ("<3.5", "float", "==", Expectation(3.5, "<")),
        ("!= 0", "int", "==", Expectation(0, "!=")),
        ("2 .. 8", "float", "==", Expectation(2, "within", 8.0)),
        ("-2..-1", "int", "==", Expectation(-2, "within", -1.0)),
        ({"min": 2, "max": 8.5}, "float", "==", Expectation(2, "within", 8.5)),
        ({"min": 2}, "float", "==", Expectation(2, ">=")),
        ({"max": 2}, "float", "==", Expectation(2, "<=")),
        ("idle", "string", "==", Expectation("idle")),
        ("!= idle", "string", "==", Expectation("idle", "!=")),
        (7, "string", "==", Expectation("7")),
        (None, "float", ">=", Expectation()),
        (None, "string", "==", Expectation()),
    ],
)
def test_expected(
    expected: Any, kind: Type, relation: Literal["==", ">=", "<="], result: Expectation
) -> None:
    assert expectation(expected, kind, _result(kind, relation)) == result


@pytest.mark.parametrize("nominal", [True, False])
def test_a_bool_expects_what_is_nominal(nominal: bool) -> None:
    assert expectation(None, "bool", _result("bool", nominal=nominal)) == Expectation(nominal)


@pytest.mark.parametrize(
    ("expected", "kind", "what"),
    [
        (0.9, "bool", "a bool is true or false, not 0.9"),
        (1, "bool", "a bool is true or false, not 1"),
        ("> 0", "bool", "a bool is true or false, not > 0"),
        ("much", "float", "expected a number, got 'much'"),
        (True, "int", "expected a number, got 'True'"),
        (2.5, "int", "a whole number is never 2.5"),
        ("8 .. 2", "float", "nothing lies between 8 and 2"),
        ({"min": 1}, "string", "limits are for numbers, this output is of type string"),
        ({"mni": 1}, "float", "a range has the keys min and max"),
        ({}, "float", "a range has the keys min and max"),
        ([1], "float", "expected a value, got a list"),
        ("> a", "string", "a text cannot be compared with >"),
    ],
)
def test_what_no_output_can_be(expected: Any, kind: Type, what: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(what)}$"):
        expectation(expected, kind, _result(kind))
