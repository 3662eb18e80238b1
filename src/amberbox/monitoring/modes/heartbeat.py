"""Heartbeat: messages of an item come, and as often as they should, before any filter."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amberbox.core.mode import Input, Result, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now
from amberbox.core.standins import Finding

ACCEPTS = ("item", "variable", "list")
COLUMNS = True
PER_INPUT = True
TIMED = True
SEES_SILENCE = True
RESULTS = (
    Result("alive", "bool", "messages come, and often enough"),
    Result("rate_hz", "float", "messages per second over the window", "Hz", relation=">="),
    Result("age_s", "float", "time since the last message", "s", relation="<="),
)
SAMPLE = """\
name: laser_heartbeat_monitor
monitor: heartbeat
description: the driver of the front laser publishes scans
mappings:
  - mapping:
      inputs: [/scan_front]
      outputs:
        - output: {name: front_laser_alive, type: bool, expected: true}
        - output: {name: scan_rate, result: rate_hz, type: float}
arguments:
  rate: 10 Hz
  tolerance: 20 %
  max_age: 1 s
"""


@dataclass(frozen=True, slots=True)
class Config:
    """How often messages come when all is well, and when silence is a fault."""

    rate: float | None = option(
        None, "how often messages come; without it any rate will do", unit="Hz"
    )
    tolerance: float = option(20.0, "how much slower than `rate` is still well", unit="%")
    window: float = option(5.0, "over how long the rate is measured", unit="s")
    max_age: float = option(2.0, "how long after the last message silence is a fault", unit="s")

    def check(self) -> Iterator[Finding]:
        """Refuse what cannot be measured."""
        for name in ("window", "max_age"):
            if not 0 < getattr(self, name) < np.inf:
                yield name, "must lie above 0"
        if not 0 <= self.tolerance < 100:
            yield "tolerance", "must lie between 0 % and 100 %"
        if self.rate is not None and not 2 <= self.rate * self.window < np.inf:
            yield (
                "window",
                f"must hold at least two messages at {self.rate:g} Hz",
            )

    @property
    def least_hz(self) -> float:
        """The lowest rate that is well; one message more or less in a window is no fault."""
        return (self.rate or 0.0) * (1 - self.tolerance / 100) - 1 / self.window


def history_s(config: Config) -> float:
    """Return how far back it looks."""
    return max(config.window, config.max_age)


def evaluate(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Judge the last message's age, and the rate once there has been a whole window of them."""
    (item,) = inputs
    age_s = item.age_s(now)
    heard = np.isfinite(age_s)
    whole = item.flow.reaches_back(now, config.window)
    rate_hz = np.where(whole, item.rate_hz(now, config.window), np.nan)
    alive = (age_s <= config.max_age) & ~(rate_hz < config.least_hz)
    return {
        "alive": where_known(heard | item.flow.listened(now, config.window), alive),
        "rate_hz": rate_hz,
        "age_s": np.where(heard, age_s, np.nan),
    }


def explain(config: Config, results: Mapping[str, Any]) -> str:
    """Say whether it is silent, or too slow."""
    age_s, rate_hz = results["age_s"], results["rate_hz"]
    if results["alive"] is not False:
        return ""
    if not age_s <= config.max_age:
        return "no message at all" if np.isnan(age_s) else f"no message for {age_s:.1f} s"
    return f"{rate_hz:.3g} messages per second, {config.rate:g} expected"
