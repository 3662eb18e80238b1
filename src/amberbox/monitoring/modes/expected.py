"""Expected: a value, a text or the name of a value is what it should be."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, as_single, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
PER_INPUT = True
RESULTS = (
    Result("as_expected", "bool", "the value is one of those that are well"),
    Result("value", "string", "the value as text, or its name where the message gives it one"),
)
SAMPLE = """\
name: navigation_state_monitor
monitor: expected
description: navigation is in a state in which it can take a goal
mappings:
  - mapping:
      inputs: [navigation.state]
      outputs:
        - output: {name: navigation_ready, type: bool, expected: true}
        - output: {name: navigation_state, result: value, type: string}
arguments:
  one_of: [IDLE, ACTIVE]
"""

Plain: TypeAlias = bool | int | float | str


@dataclass(frozen=True, slots=True)
class ExpectedOptions:
    """The expected value: one value, one of several, or texts that match a pattern."""

    equals: Plain | None = option(None, "the value that is well: a number, true or false, a text")
    one_of: Sequence[Plain] = option((), "several values that are well")
    matches: str = option("", "a regular expression that is found in a text that is well")

    def check(self) -> Iterator[Finding]:
        """Yield arguments without a check, and invalid regular expressions."""
        if sum((self.equals is not None, bool(self.one_of), bool(self.matches))) != 1:
            yield "give one of 'equals', 'one_of', 'matches'"
        try:
            re.compile(self.matches)
        except re.error as error:
            yield "matches", f"is no regular expression: {error}"

    @property
    def well(self) -> Sequence[Plain]:
        """All values that are well."""
        return self.one_of if self.equals is None else (self.equals,)


Config = ExpectedOptions


def evaluate(config: ExpectedOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Compare the last value, and the name that it has, with the expected ones."""
    (variable,) = inputs
    values, known = np.asarray(variable.at(now)), variable.samples.known(now)
    texts = [_text(value, variable.labels) for value in np.atleast_1d(values).tolist()]
    fits = np.reshape([_fits(config, text) for text in texts], values.shape)
    if values.dtype != object:
        for number in (value for value in config.well if not isinstance(value, str)):
            fits = fits | (values == number) | (values == as_single(number))
    shown = np.reshape(np.array(texts, object), values.shape)
    nothing = np.array(None, object)
    return {"as_expected": where_known(known, fits), "value": np.where(known, shown, nothing)[()]}


def _text(value: Any, labels: Mapping[int, str]) -> str:
    """Return the name of a value, else its written form."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        value = int(value)
    if isinstance(value, bool):
        return str(value).lower()
    return labels.get(value, str(value)) if isinstance(value, int) else str(value)


def _fits(config: ExpectedOptions, text: str) -> bool:
    if config.matches:
        return re.search(config.matches, text) is not None
    return any(text == _text(value, {}) for value in config.well)


def explain(config: ExpectedOptions, results: Mapping[str, Any]) -> str:
    """Describe the value, and the expected value."""
    if results["as_expected"] is not False:
        return ""
    well = " or ".join(_text(value, {}) for value in config.well)
    return f"is {results['value']}, should be {well or f'like {config.matches}'}"
