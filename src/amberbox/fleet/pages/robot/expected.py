"""What is expected of an output in words, and whether its value is so."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import nan
from typing import Any

from amberbox.fleet.pages.robot import values
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.state.views import Mode, Output

_COMPARE: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq, "!=": operator.ne, ">=": operator.ge, "<=": operator.le,
    ">": operator.gt, "<": operator.lt,
}  # fmt: skip
_WORDS = {"!=": "not", ">=": "at_least", "<=": "at_most", ">": "more_than", "<": "less_than"}
_NUMBERS = ("int", "float")
_BOOLS = {"true": "yes", "false": "no"}


@dataclass(frozen=True, slots=True)
class _Expected:
    """A relation with what it is to, as the monitor writes both; ``high`` ends a range."""

    relation: str
    low: str
    high: str = ""


def is_met(output: Output) -> bool:
    """Tell whether a value is as expected, as expected.js does; also where nothing is."""
    value = output.value
    if not output.expected or value is None:
        return True
    expected = _parsed(output)
    if expected.high:
        return _number(expected.low) <= float(value) <= _number(expected.high)
    compare = _COMPARE[expected.relation]
    if isinstance(value, bool):
        return compare(str(value).lower(), expected.low)
    if isinstance(value, int | float):
        return compare(value, _number(expected.low))
    return compare(value, expected.low)


def failing(mode: Mode, output: Output) -> bool:
    """Tell whether an output is one that its mode is not well for."""
    said = mode.condition
    return said.level != "ok" and (said.state == output.name or not is_met(output))


def is_healing(mode: Mode, output: Output) -> bool:
    """Tell whether an output is as expected again, and counts as failed until it stays so."""
    return bool(output.expected) and failing(mode, output) and is_met(output)


def text(output: Output) -> str:
    """Write what is expected of an output, as its value is written; empty where nothing is."""
    if not output.expected:
        return ""
    expected = _parsed(output)
    low = _shown(output, expected.low)
    if expected.high:
        return _said("range", low=low, high=_shown(output, expected.high))
    word = _WORDS.get(expected.relation)
    return _said(word, value=low) if word else low


def _said(word: str, **said: str) -> str:
    return catalogue().text(f"robot.tree.relation.{word}", **said)


def _parsed(output: Output) -> _Expected:
    said = output.expected
    low, to, high = said.partition(" to ")
    if to and output.type in _NUMBERS and not isinstance(output.value, str):
        return _Expected("within", low, high)
    first, _, rest = said.partition(" ")
    return _Expected(first, rest) if rest and first in _WORDS else _Expected("==", said)


def _shown(output: Output, text: str) -> str:
    if output.type == "bool" and text in _BOOLS:
        return catalogue().text(f"robot.js.value.{_BOOLS[text]}")
    value = _number(text)
    if output.type not in _NUMBERS or value != value:
        return text
    if values.value_type(output) == values.DURATION:
        return values.duration(value)
    return f"{value:g} {values.unit(output)}".strip()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return nan  # nothing is like it
