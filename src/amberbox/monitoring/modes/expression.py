"""Expression: any condition or number over variables, in the language of expressions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.core.config import Finding
from amberbox.core.expression import Expression
from amberbox.core.expression import reason as condition_reason
from amberbox.core.mode import Given, Input, Result, by_name, reads_of, value_of, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
RESULTS = (
    Result("holds", "bool", "the condition holds"),
    Result("value", "float", "the number"),
)
SAMPLE = """\
name: brake_monitor
monitor: expression
description: the brake holds the robot, and the motors do not work against it
mappings:
  - mapping:
      inputs: []
      outputs:
        - output: {name: brake_holds, type: bool, for: 200 ms}
        - output: {name: slip, result: value, type: float}
arguments:
  condition: not (brake.closed != 0 and abs(ros_odom.twist_linear_x) > 0.05)
  number: max(abs(ros_odom.twist_linear_x) over 2s)
"""
_MOST_SHOWN = 100  # characters; a longer condition in an alarm is not readable


@dataclass(frozen=True, slots=True)
class ExpressionOptions:
    """The condition or number; inputs of the mapping are called input_1, input_2 ..."""

    condition: Expression | None = option(None, "what holds on a healthy robot")
    number: Expression | None = option(None, "what to show, or to compare with `expected`")

    def check(self) -> Iterator[Finding]:
        """Yield an error if neither is given, or if one is of the wrong kind."""
        if self.condition is None and self.number is None:
            yield "give 'condition', 'number' or both"
        if self.condition is not None and self.condition.kind not in ("condition", "any"):
            yield "condition", f"is a {self.condition.kind}, no condition"
        if self.number is not None and self.number.kind == "text":
            yield "number", "is a text, no number"


Config = ExpressionOptions


def reads(config: ExpressionOptions) -> tuple[str, ...]:
    """Return the variables that are no inputs."""
    return reads_of(config.condition, config.number)


def history_s(config: ExpressionOptions) -> float:
    """Return how far back it looks."""
    asked = (config.condition, config.number)
    return max(one.history_ns / 1e9 for one in asked if one is not None)


def shortest_s(config: ExpressionOptions) -> float:
    """Return the shortest time that it looks back, 0 if it does not."""
    asked = (config.condition, config.number)
    spans = [one.shortest_ns for one in asked if one is not None]
    return min((span for span in spans if span is not None), default=0) / 1e9


def timed(config: ExpressionOptions) -> bool:
    """Return whether its result changes as time passes."""
    asked = (config.condition, config.number)
    return any(one.needs_history for one in asked if one is not None)


def results_of(config: ExpressionOptions, inputs: int, bools: int) -> tuple[Result, ...]:
    """Return the results that the options ask for."""
    asked = (config.condition, config.number)
    return tuple(r for r, one in zip(RESULTS, asked, strict=True) if one is not None)


def evaluate(config: ExpressionOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Evaluate at the instants, over all that is known by then."""
    named = by_name(inputs, reads(config))
    found: dict[str, Any] = {}
    if config.condition is not None:
        truth = value_of(config.condition, named, now)
        found["holds"] = where_known(truth == truth, truth == 1)  # NaN equals nothing
    if config.number is not None:
        found["value"] = value_of(config.number, named, now)
    return found


def reason(config: ExpressionOptions, given: Given) -> str:
    """Describe which terms make the condition fail, with their values."""
    if config.condition is None:
        return ""
    named = by_name(given.inputs, reads(config))
    samples = {name: named[name].samples for name in config.condition.addresses()}
    return condition_reason(config.condition, samples, given.now_ns, expected=True)


def explain(config: ExpressionOptions, results: Mapping[str, Any]) -> str:
    """Repeat the condition that does not hold."""
    if config.condition is None or results["holds"] is not False:
        return ""
    text = " ".join(config.condition.text.split())
    return f"it does not hold that {text}" if len(text) <= _MOST_SHOWN else ""
