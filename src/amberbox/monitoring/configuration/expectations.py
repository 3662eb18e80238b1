"""``expected:`` of an output: a value, a comparison or a range."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal

from amberbox.core.mode import Result
from amberbox.core.nodes import scalar
from amberbox.monitoring.plan import Expectation

Type = Literal["bool", "int", "float", "string"]
_COMPARISON = re.compile(r"(>=|<=|==|!=|>|<)\s*(.+)")
_RANGE = re.compile(r"(.+?)\.\.(.+)")
_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


def expectation(expected: Any, kind: Type, result: Result) -> Expectation:
    """Read what an output should be; raise ValueError with what is wrong with it.

    Without ``expected`` a bool expects what its result calls nominal, others expect nothing.
    """
    if expected is None:
        return Expectation(result.nominal) if kind == "bool" else Expectation()
    if isinstance(expected, Mapping):
        return _limits(expected, kind)
    if isinstance(expected, list):
        raise ValueError("expected a value, got a list")
    if isinstance(expected, str) and kind != "bool":
        compared, span = _COMPARISON.fullmatch(expected), _RANGE.fullmatch(expected)
        if compared:
            return _compared(compared[1], scalar(compared[2].strip()), kind)
        if span and kind != "string":
            return _within(scalar(span[1].strip()), scalar(span[2].strip()), kind)
    relation = result.relation if kind in ("int", "float") else "=="
    return Expectation(_value(expected, kind), relation)


def _compared(relation: Any, value: Any, kind: Type) -> Expectation:
    if kind == "string" and relation not in ("==", "!="):
        raise ValueError(f"a text cannot be compared with {relation}")
    return Expectation(_value(value, kind), relation)


def _limits(expected: Mapping[str, Any], kind: Type) -> Expectation:
    if kind not in ("int", "float"):
        raise ValueError(f"limits are for numbers, this output is of type {kind}")
    unknown = sorted(set(expected) - {"min", "max"})
    if unknown or not expected:
        raise ValueError("a range has the keys min and max")
    low, high = expected.get("min"), expected.get("max")
    if low is None:
        return Expectation(_value(high, kind), "<=")
    if high is None:
        return Expectation(_value(low, kind), ">=")
    return _within(low, high, kind)


def _within(low: Any, high: Any, kind: Type) -> Expectation:
    first, last = _value(low, kind), _value(high, kind)
    assert isinstance(first, int | float) and isinstance(last, int | float)
    if first > last:
        raise ValueError(f"nothing lies between {first} and {last}")
    return Expectation(first, "within", float(last))


def _value(value: Any, kind: Type) -> bool | int | float | str:
    if kind == "string":
        return str(value).lower() if isinstance(value, bool) else str(value)
    if kind == "bool":
        found = _WORDS.get(value.lower()) if isinstance(value, str) else value
        if not isinstance(found, bool):
            raise ValueError(f"a bool is true or false, not {value}")
        return found
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected a number, got '{value}'")
    if kind == "int" and value != int(value):
        raise ValueError(f"a whole number is never {value}")
    return value
