"""Heartbeat: messages of an item come, and as often as they should, before any filter."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.errors import did_you_mean
from amberbox.core.mode import FALSE, TRUE, Given, Input, Result, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now, is_one

ACCEPTS = ("item", "variable", "list")
COLUMNS = True
PER_INPUT = True
TIMED = True
SEES_SILENCE = True
RESULTS = (
    Result("alive", "bool", "messages come, and often enough"),
    Result("rate_hz", "float", "messages per second over the window", "Hz", relation=">="),
    Result("age_s", "float", "time since the last message", "s", relation="<="),
    Result("heard", "bool", "messages come at all"),
    Result("often_enough", "bool", "messages that come do so as often as they should"),
    Result("connected", "bool", "its publisher is not known to be lost"),
)
_PLAIN = {FALSE: False, TRUE: True}
_BOOLS = tuple(result.name for result in RESULTS if result.type == "bool")
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
class HeartbeatOptions:
    """The expected rate of messages, and the age from which silence is a fault."""

    rate: float | None = option(
        None, "how often messages come; without it any rate will do", unit="Hz"
    )
    tolerance: float = option(20.0, "how much slower than `rate` is still well", unit="%")
    window: float = option(5.0, "over how long the rate is measured", unit="s")
    max_age: float = option(2.0, "how long after the last message silence is a fault", unit="s")
    rates: Mapping[str, float] = option(
        {}, "rates of inputs that differ: their windows hold four messages, silence is a fault "
        "after three", unit="Hz",
    )  # fmt: skip

    def check(self) -> Iterator[Finding]:
        """Refuse what cannot be measured."""
        for name in ("window", "max_age"):
            if not 0 < getattr(self, name) < np.inf:
                yield name, "must lie above 0"
        if not 0 <= self.tolerance < 100:
            yield "tolerance", "must lie between 0 % and 100 %"
        if any(not 0 < rate < np.inf for rate in self.rates.values()):
            yield "rates", "must lie above 0"
        if self.rate is not None and not 2 <= self.rate * self.window < np.inf:
            yield (
                "window",
                f"must hold at least two messages at {self.rate:g} Hz",
            )

    def of(self, name: str) -> HeartbeatOptions:
        """Return the options of one input."""
        rate = self.rates.get(name)
        if rate is None:
            return self
        window, max_age = max(self.window, 4 / rate), max(self.max_age, 3 / rate)
        return replace(self, rate=rate, window=window, max_age=max_age, rates={})

    @property
    def least_hz(self) -> float:
        """Return the lowest good rate, Hz; one message more or less in a window is no fault."""
        return (self.rate or 0.0) * (1 - self.tolerance / 100) - 1 / self.window


Config = HeartbeatOptions


def measure(config: HeartbeatOptions, result: str, inputs: Sequence[str]) -> str:
    """Return by how many seconds a message is late; below 0 while they come, but too slowly."""
    if len(inputs) != 1 or result not in _BOOLS:
        return ""
    late_s = config.of(inputs[0].strip("`")).max_age
    return f"age({inputs[0]}) - {late_s:g}"


def history_s(config: HeartbeatOptions) -> float:
    """Return how far back it looks."""
    each = (config, *map(config.of, config.rates))
    return max(max(one.window, one.max_age) for one in each)


def input_problems(config: HeartbeatOptions, texts: Sequence[str]) -> Iterator[Finding]:
    """Yield the rates of what is no input."""
    for name in config.rates:
        if name not in texts:
            yield "rates", f"'{name}' is no input of this file{did_you_mean(name, texts)}"


def evaluate(config: HeartbeatOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Evaluate the last message's age, and the rate once messages were received for a
    whole window.
    """
    (item,) = inputs
    config = config.of(item.name)
    age_s = item.age_s(now)
    received = np.isfinite(age_s)
    whole = item.flow.reaches_back(now, config.window)
    rate_hz = np.where(whole, item.rate_hz(now, config.window), np.nan)
    known = received | item.flow.listened(now, config.window)
    comes, enough = age_s <= config.max_age, ~(rate_hz < config.least_hz)
    judged = comes & whole & (enough | _is_steady(config, item, now, enough))
    return {
        "alive": where_known(known, comes & enough),
        "rate_hz": rate_hz,
        "age_s": np.where(received, age_s, np.nan),
        "heard": where_known(known, comes),
        "often_enough": where_known(judged, enough),
        "connected": where_known(known, np.logical_not(item.flow.lost(now))),
    }


def _is_steady(config: HeartbeatOptions, item: Input, now: Now, enough: Any) -> Any:
    """Return, where there are too few messages, whether they arrived throughout the window.

    An item that has just come back after a silence is not slow: it was silent.
    """

    def at(now_ns: int) -> bool:
        since_ns = now_ns - round(config.window * NS)
        received_ns = item.flow.received_ns(since_ns, now_ns)
        return item.flow.longest_gap_s(now_ns, config.window, received_ns) <= config.window / 2

    if is_one(now):
        return not enough and at(int(now))
    instants = np.asarray(now).tolist()
    return np.array([not well and at(at_ns) for well, at_ns in zip(enough, instants, strict=True)])


def reason(config: HeartbeatOptions, given: Given) -> str:
    """Describe what is wrong with several inputs, or with one that has a rate of its own."""
    if len(given.inputs) == 1 and given.inputs[0].name not in config.rates:
        return ""
    found = []
    for item in given.inputs:
        results = evaluate(config, [item], given.now_ns)
        plain = {name: _PLAIN.get(int(results[name])) for name in _BOOLS}
        why = explain(config.of(item.name), {**results, **plain})
        if why:
            found.append(f"{item.name} {why}" if len(given.inputs) > 1 else why)
    return "; ".join(found)


def explain(config: HeartbeatOptions, results: Mapping[str, Any]) -> str:
    """Describe whether it is silent, too slow, or was silent until now."""
    age_s, rate_hz = results["age_s"], results["rate_hz"]
    if results.get("connected") is False and False not in (results["alive"], results["heard"]):
        return "no connection to its publisher"
    if False not in (results["alive"], results["heard"], results["often_enough"]):
        return ""
    expected = "" if config.rate is None else f", {config.rate:g} expected"
    if not age_s <= config.max_age:
        silent = "no message at all" if np.isnan(age_s) else f"no message for {age_s:.1f} s"
        return f"silent: {silent}" + (f" ({config.rate:g} per second expected)" if expected else "")
    rate = f"{rate_hz:.3g} messages per second{expected}"
    if results["often_enough"] is False:
        return f"too slow: {rate}"
    return f"comes again after a silence, which counts: {rate}"


def explain_unknown(config: HeartbeatOptions, results: Mapping[str, Any]) -> str:
    """Describe that the rate is unknown: during silence, or before the window is full."""
    if results["heard"] is False:
        return "its rate is not judged while it is silent"
    return f"not judged before messages came for {config.window:g} s without a break"
