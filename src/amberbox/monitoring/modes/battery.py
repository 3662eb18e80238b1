"""Battery: how full it is, from its voltages or its percentage, and for how long it will last."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.mode import (
    Input,
    Result,
    medians,
    middles,
    numbers_at,
    sample_times,
    where_known,
    with_hysteresis,
)
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
RESULTS = (
    Result("ok", "bool", "the charge is plausible and not low"),
    Result("charge_percent", "float", "charge, from 0 to 100", "%", relation=">="),
    Result("time_to_empty_s", "float", "unknown while it does not get less", "s", relation=">="),
    Result("plausible", "bool", "the inputs lie between empty and full"),
)
SAMPLE = """\
name: battery_functional_monitor
monitor: battery
description: battery level from the bus voltage of the four wheels
mappings:
  - mapping:
      inputs: [wheel_1.voltage_bus, wheel_2.voltage_bus, wheel_3.voltage_bus, wheel_4.voltage_bus]
      outputs:
        - output: {name: battery_ok, type: bool, severity: critical, hint: charge the robot}
        - output: {name: battery_percentage, result: charge_percent, type: float}
        - output: {name: time_to_empty, result: time_to_empty_s, type: float}
arguments:
  lowest_voltage: 20.0
  highest_voltage: 28.0
"""
_POINTS = 32
_LEAST_DROP = 0.05  # percent between the halves of a window; less is noise


@dataclass(frozen=True, slots=True)
class BatteryOptions:
    """Limits of the charge, and the values of the inputs when the battery is empty and full."""

    empty: float = option(0.0, "the inputs when the battery is empty", aliases=("lowest_voltage",))
    full: float = option(
        100.0, "the inputs when it is full; 1 for a percentage of ROS", aliases=("highest_voltage",)
    )
    low: float = option(20.0, "the charge below which it is not ok", unit="%")
    hysteresis: float = option(2.0, "by how much more it must be charged to be ok again", unit="%")
    tolerance: float = option(5.0, "how far below empty or above full is plausible", unit="%")
    smoothing: float = option(5.0, "the median of that long counts as the charge", unit="s")
    window: float = option(600.0, "over how long the discharge is measured", unit="s")

    def check(self) -> Iterator[Finding]:
        """Refuse what gives no percentage."""
        if not self.empty < self.full:
            yield "full", "must lie above 'empty'"
        if not 0 <= self.low <= 100:
            yield "low", "must lie between 0 % and 100 %"
        if self.hysteresis < 0 or self.tolerance < 0:
            yield "'hysteresis' and 'tolerance' must not lie below 0"
        if not 1 <= self.window < np.inf:
            yield "window", "must be 1 s or more"
        if not 0 <= self.smoothing < np.inf:
            yield "smoothing", "must be 0 or more"


Config = BatteryOptions


def history_s(config: BatteryOptions) -> float:
    """Return how far back it looks."""
    return max(config.window, config.smoothing)


def evaluate(config: BatteryOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Evaluate the charge; a single input with an invalid value does not change it."""
    times_ns = sample_times(inputs, now, config.smoothing)
    shown = _percent(config, [numbers_at(one, times_ns) for one in inputs])
    (percent,) = medians(times_ns, shown[None], now, config.smoothing)
    known = np.logical_or.reduce([one.samples.known(now) for one in inputs])
    plausible = (percent >= -config.tolerance) & (percent <= 100 + config.tolerance)
    good = plausible & (percent >= config.low + config.hysteresis)
    bad = ~plausible | (percent < config.low)
    charge = np.where(plausible, np.clip(percent, 0.0, 100.0), np.nan)[()]
    return {
        "ok": where_known(known, with_hysteresis(good, bad)),
        "charge_percent": charge,
        "time_to_empty_s": charge / _drain(config, inputs, now),
        "plausible": where_known(known, plausible),
    }


def _percent(config: BatteryOptions, values: Sequence[Any]) -> Any:
    low, high = middles(np.array(values))
    return ((low + high) / 2 - config.empty) / (config.full - config.empty) * 100


def _drain(config: BatteryOptions, inputs: Sequence[Input], now: Now) -> Any:
    """Return percent per second, from the middles of the older and the newer half of a window."""
    ages_ns = np.linspace(config.window * NS, 0, _POINTS).astype(np.int64)
    instants = np.atleast_1d(now) - ages_ns[:, None]
    percents = _percent(config, [numbers_at(one, instants) for one in inputs])
    ordered = np.sort(percents.reshape(2, _POINTS // 2, -1), axis=1)  # NaN comes last
    middle = (ordered[:, _POINTS // 4 - 1] + ordered[:, _POINTS // 4]) / 2
    older, newer = np.where(np.isnan(ordered[:, -1]), np.nan, middle)
    drop = np.where(older - newer >= _LEAST_DROP, older - newer, np.nan)
    apart_s = config.window * (_POINTS / 2) / (_POINTS - 1)
    return (drop / apart_s).reshape(np.shape(now))[()]


def explain(config: BatteryOptions, results: Mapping[str, Any]) -> str:
    """Describe a low charge, or one that is not plausible."""
    if results["plausible"] is False:
        return "what it says is no number, or lies far below empty or above full"
    if results["ok"] is False:
        return f"{results['charge_percent']:.0f} % are left, below {config.low:.0f} % it is low"
    return ""
