"""Network: the robot is connected, and the connection is strong and quick enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amberbox.core.mode import Input, Result, numbers_at, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples

ACCEPTS = ("probe", "variable")
COLUMNS = True
RESULTS = (
    Result("connected", "bool", "all that was asked for is connected"),
    Result("quality", "float", "quality of the wireless link", "%", relation=">="),
    Result("signal_dbm", "int", "strength of the wireless signal", "dBm", relation=">="),
    Result("latency_ms", "float", "time until an answer comes", "ms", relation="<="),
    Result("loss_percent", "float", "requests without an answer", "%", relation="<="),
)
SAMPLE = """\
name: wifi_functional_monitor
monitor: network
description: network quality and strength, and the way to the server
mappings:
  - mapping:
      inputs: [wifi wlan0, "ping fleet.example.org"]
      outputs:
        - output: {name: connected, type: bool, severity: warning}
        - output: {name: wifi_quality, type: double, expected: 50, severity: warning}
        - output: {name: wifi_strength, type: int, expected: -80, severity: warning}
        - output: {name: latency_ms, type: float, expected: 200, severity: warning, for: 10 s}
"""
_PROBES = {"wifi": "wifi", "ping": "ping", "interface": "network_interface"}
_PARTS = {
    "quality": "quality_percent",
    "signal_dbm": "signal_dbm",
    "latency_ms": "latency_ms",
    "loss_percent": "loss_percent",
}


@dataclass(frozen=True, slots=True)
class NetworkOptions:
    """What the inputs measure, if they are variables and not probes."""

    values: tuple[Literal["quality", "signal_dbm", "latency_ms", "loss_percent"], ...] = option(
        (), "what the inputs are, in their order, where they are variables and no probes"
    )


Config = NetworkOptions


def probe_of(config: NetworkOptions, text: str) -> tuple[str, str]:
    """Read ``wifi wlan0``, ``ping HOST``, ``interface eth0``; one word is a wireless interface."""
    word, _, rest = text.strip().partition(" ")
    if word in _PROBES and rest:
        return _PROBES[word], rest.strip()
    return "wifi", "wlan0" if text.strip() in ("", "wifi") else text.strip()


def evaluate(config: NetworkOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Collect the inputs; one without a number is not connected."""
    if config.values:
        well = [np.isfinite(numbers_at(one, now)) for one in inputs]
        figures: dict[str, Input] = dict(zip(config.values, inputs, strict=True))
    else:
        well = [np.asarray(one.at(now), bool) for one in inputs]
        figures = {name: _first_with(part, inputs) for name, part in _PARTS.items()}
    known = np.logical_and.reduce([one.samples.known(now) for one in inputs])
    connected = where_known(known, np.logical_and.reduce(well))
    absent = Input("")
    numbers = {name: numbers_at(figures.get(name, absent), now) for name in _PARTS}
    return {"connected": connected, **numbers}


def _first_with(part: str, inputs: Sequence[Input]) -> Input:
    for one in inputs:
        if part in one.parts:
            return one.part(part)
    return Input("", Samples())


def explain(config: NetworkOptions, results: Mapping[str, Any]) -> str:
    """Describe that there is no connection."""
    return "there is no connection" if results["connected"] is False else ""
