"""Host: the computer has processor time, memory and disk left, and is not too hot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, where_known, with_hysteresis
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("probe",)
COLUMNS = True
PER_INPUT = True
RESULTS = (
    Result("ok", "bool", "the figure is below its limit"),
    Result("value", "float", "busy or used in percent, or degrees Celsius", relation="<="),
)
SAMPLE = """\
name: computer_monitor
monitor: host
description: the robot's computer has room to breathe
stale_after: 30 s
mappings:
  - mapping:
      inputs: [cpu, memory, disk /, temperature hottest]
      outputs:
        - output: {name: cpu_ok, type: bool, severity: warning, for: 30 s}
        - output: {name: memory_ok, type: bool}
        - output: {name: disk_ok, type: bool, hint: let the black box delete or add a disk}
        - output: {name: temperature_ok, type: bool}
        - output: {name: cpu_percent, type: float}
        - output: {name: memory_percent, type: float}
        - output: {name: disk_percent, type: float}
        - output: {name: temperature, type: float}
arguments:
  disk: 85 %
"""
_PROBES = {
    "cpu": ("cpu", "all", "percent"),
    "memory": ("memory", "ram", "used_percent"),
    "swap": ("memory", "swap", "used_percent"),
    "disk": ("disk", "/", "used_percent"),
    "temperature": ("temperature", "hottest", "celsius"),
}


@dataclass(frozen=True, slots=True)
class HostOptions:
    """The limit of each figure."""

    cpu: float = option(95.0, "how busy the processors may be", unit="%")
    memory: float = option(90.0, "how much of the memory may be used", unit="%")
    swap: float = option(50.0, "how much of the swap space may be used", unit="%")
    disk: float = option(90.0, "how much of a disk may be used", unit="%")
    temperature: float = option(85.0, "how hot it may be, in degrees Celsius")
    hysteresis: float = option(2.0, "how far below its limit a figure is well again")
    window: float = option(10.0, "the mean of that long counts", unit="s")

    def check(self) -> Iterator[Finding]:
        """Refuse windows and margins that mean nothing."""
        if self.hysteresis < 0:
            yield "hysteresis", "must not lie below 0"
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"


Config = HostOptions


def probe_of(config: HostOptions, text: str) -> tuple[str, str]:
    """Read ``cpu``, ``memory``, ``swap``, ``disk PATH``, ``temperature SENSOR``."""
    word, _, rest = text.strip().partition(" ")
    kind, usual, _ = _PROBES.get(word, (word, "", ""))
    return kind, rest.strip() or usual


def history_s(config: HostOptions) -> float:
    """Return how far back it looks."""
    return config.window


def evaluate(config: HostOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Compare the mean of the measurements of the probe with the limit of its kind."""
    (one,) = inputs
    word = one.name.split(" ")[0]
    works, known = np.asarray(one.at(now), bool), one.samples.known(now)
    value, limit = _mean(config, one, word, now), getattr(config, word, inf)
    good = works & (value <= limit - config.hysteresis)
    bad = ~works | (value > limit)
    measured = known & (~works | np.isfinite(value))
    return {"ok": where_known(measured, with_hysteresis(good, bad)), "value": value}


def _mean(config: HostOptions, one: Input, word: str, now: Now) -> Any:
    """Return the mean of a probe's figure; where no sample is that new, the last one."""
    _, _, name = _PROBES.get(word, ("", "", ""))
    if name not in one.parts:
        return np.full(np.shape(now), np.nan)[()]
    part = one.part(name)
    mean = part.over(now, config.window).mean()
    last = np.where(part.samples.known(now), part.at(now), np.nan)
    return np.where(np.isnan(mean), last, mean)[()]


def explain(config: HostOptions, results: Mapping[str, Any]) -> str:
    """Describe how high the figure is."""
    if results["ok"] is not False:
        return ""
    value = results["value"]
    return "the probe says it is not well" if value is None else f"it is at {value:.0f}"
