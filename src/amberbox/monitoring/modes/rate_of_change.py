"""Rate of change: how fast a value rises or falls lies within limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.expression import variable_text
from amberbox.core.mode import Given, Input, Result, beyond_limits, numbers, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable", "list")
COLUMNS = True
PER_INPUT = True
TIMED = True
RESULTS = (
    Result("in_limits", "bool", "the value rises and falls as fast as it may"),
    Result("rate", "float", "change per second over the window", "1/s", relation="<="),
)
SAMPLE = """\
name: tank_pressure_monitor
monitor: rate_of_change
description: the tank does not leak
mappings:
  - mapping:
      inputs: [tank.pressure]
      outputs:
        - output: {name: pressure_holds, type: bool, expected: true, for: 5 s}
        - output: {name: pressure_rate, result: rate, type: float}
arguments:
  min: -0.2
  window: 10 s
"""


@dataclass(frozen=True, slots=True)
class RateOfChangeOptions:
    """The limits, which are well themselves."""

    min: float = option(-inf, "the least change per second; below 0 it may fall")
    max: float = option(inf, "the greatest change per second")
    window: float = option(1.0, "over how long the change is measured", unit="s")
    turn: float | None = option(None, "for an angle: a full turn, 360 or 6.2832")

    def check(self) -> Iterator[Finding]:
        """Refuse limits that nothing can be within or outside of."""
        if self.min == -inf and self.max == inf:
            yield "give 'min', 'max' or both"
        if self.min > self.max:
            yield "nothing is within these limits"
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"
        if self.turn is not None and not 0 < self.turn < inf:
            yield "turn", "must lie above 0"


Config = RateOfChangeOptions


def measure(config: RateOfChangeOptions, result: str, inputs: Sequence[str]) -> str:
    """Return the change per second minus the limit that it violates."""
    if len(inputs) != 1 or config.turn is not None:
        return ""
    return beyond_limits(f"rate({inputs[0]} over {config.window:g}s)", config.min, config.max)


def history_s(config: RateOfChangeOptions) -> float:
    """Return how far back it looks."""
    return config.window


def evaluate(config: RateOfChangeOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Compare the value with the value one window ago.

    Over a gap of messages the change is that of the gap. Where no message was received since, a
    missing change is no fault: the least rate is not evaluated.
    """
    (variable,) = inputs
    rate = _rate(config, variable, now)
    in_limits = (rate >= config.min) & (rate <= config.max)
    has_news = variable.flow.last_received_ns(now) > now - round(config.window * NS)
    judged = np.isfinite(rate) & (in_limits | (rate != 0) | has_news)
    return {"in_limits": where_known(judged, in_limits), "rate": rate}


def _rate(config: RateOfChangeOptions, variable: Input, now: Now) -> Any:
    """Return the change per second; NaN where it is not known."""
    before = now - round(config.window * NS)
    known = variable.samples.known(now) & variable.samples.known(before)
    change = numbers(variable.at(now))[()] - numbers(variable.at(before))[()]
    newest_ns, oldest_ns = (variable.flow.last_received_ns(at) for at in (now, before))
    apart_s = np.where(oldest_ns >= 0, (newest_ns - oldest_ns) / NS, 0.0)
    if config.turn is not None:
        known = known & (apart_s <= 2 * config.window)  # it may have turned more than once
        change = (change + config.turn / 2) % config.turn - config.turn / 2
    return np.where(known, change / np.maximum(apart_s, config.window), np.nan)


def reason(config: RateOfChangeOptions, given: Given) -> str:
    """Describe which value changes how fast, with the limit."""
    unit = given.unit or "per second"
    found = ((one.name, float(_rate(config, one, given.now_ns))) for one in given.inputs)
    return "; ".join(
        f"{variable_text(name)} changes by "
        f"{replace(given, unit=unit).limited(rate, config.min, config.max)}"
        for name, rate in found if rate < config.min or rate > config.max
    )  # fmt: skip


def explain(config: RateOfChangeOptions, results: Mapping[str, Any]) -> str:
    """Describe how fast it changes."""
    out = results["in_limits"] is False
    return f"changes by {results['rate']:.4g} per second" if out else ""
