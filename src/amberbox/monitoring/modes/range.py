"""Range: a value lies within limits; what is not a number lies outside of all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.expression import variable_text
from amberbox.core.mode import (
    Given,
    Input,
    Result,
    as_single,
    beyond_limits,
    numbers,
    where_known,
    with_hysteresis,
)
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
PER_INPUT = True
RESULTS = (
    Result("in_range", "bool", "the value lies within the limits"),
    Result("value", "float", "the value"),
)
SAMPLE = """\
name: motor_temperature_monitor
monitor: range
description: the left motor is not too hot
mappings:
  - mapping:
      inputs: [motor_left.temperature]
      outputs:
        - output: {name: temperature_in_range, type: bool, expected: true, severity: warning}
        - output: {name: temperature, result: value, type: float}
arguments:
  max: 80
  hysteresis: 5
"""


@dataclass(frozen=True, slots=True)
class RangeOptions:
    """The limits, which belong to the range."""

    min: float = option(-inf, "the least value that is well")
    max: float = option(inf, "the greatest value that is well")
    hysteresis: float = option(0.0, "how far inside the limits it is well again after a fault")

    def check(self) -> Iterator[Finding]:
        """Refuse limits that nothing can be within or outside of."""
        if self.min == -inf and self.max == inf:
            yield "give 'min', 'max' or both"
        if self.hysteresis < 0:
            yield "hysteresis", "must not lie below 0"
        if not self.min + self.hysteresis <= self.max - self.hysteresis:
            yield "nothing is within these limits"


Config = RangeOptions


def evaluate(config: RangeOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Compare the last value with the limits."""
    (variable,) = inputs
    value, known = numbers(variable.at(now))[()], variable.samples.known(now)
    low, high = min(config.min, as_single(config.min)), max(config.max, as_single(config.max))
    inside = (value >= low) & (value <= high)
    well = (value >= low + config.hysteresis) & (value <= high - config.hysteresis)
    in_range = where_known(known, with_hysteresis(well, ~inside))
    return {"in_range": in_range, "value": np.where(known, value, np.nan)}


def measure(config: RangeOptions, result: str, inputs: Sequence[str]) -> str:
    """Return the value minus the limit that it violates."""
    return beyond_limits(inputs[0], config.min, config.max) if len(inputs) == 1 else ""


def reason(config: RangeOptions, given: Given) -> str:
    """Describe which values are outside of which limit; values that are only within the hysteresis
    are left out.
    """
    low, high = min(config.min, as_single(config.min)), max(config.max, as_single(config.max))
    found = ((one.name, float(numbers(one.at(given.now_ns))[()])) for one in given.inputs)
    return "; ".join(
        f"{variable_text(name)} is {given.limited(value, config.min, config.max)}"
        for name, value in found if not low <= value <= high
    )  # fmt: skip
