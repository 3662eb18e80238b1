"""Service: a unit, process, container, ROS node or topic that has to be there is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amberbox.core.mode import Input, Result, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("probe",)
COLUMNS = True
PER_INPUT = True
RESULTS = (
    Result("active", "bool", "it is there and works, as far as can be asked"),
    Result("state", "string", "what the system calls its state, where it has a word for it"),
)
SAMPLE = """\
name: systemd_services_active_monitor
monitor: service
description: services that the robot cannot work without
mappings:
  - mapping:
      inputs: [roscore.service, ropod_route_navigation.service]
      outputs:
        - output: {name: roscore, type: bool, severity: critical}
        - output: {name: route_navigation, type: bool}
arguments:
  kind: unit
"""


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """The kind of things that the inputs name."""

    kind: Literal["unit", "process", "container", "ros_node", "ros_topic", "ros_master", "http"] = (
        option("unit", "what the inputs are names of")
    )


Config = ServiceOptions


def probe_of(config: ServiceOptions, text: str) -> tuple[str, str]:
    """Return kind and subject of the probe that checks it."""
    return ("unit_active" if config.kind == "unit" else config.kind), text


def evaluate(config: ServiceOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Return the result of the last check."""
    (one,) = inputs
    active = where_known(one.samples.known(now), one.at(now))
    if "state" not in one.parts:
        return {"active": active, "state": np.full(np.shape(now), "", object)[()]}
    state = one.part("state")
    words = np.asarray(state.at(now), object)
    return {"active": active, "state": np.where(state.samples.known(now), words, "")[()]}


def explain(config: ServiceOptions, results: Mapping[str, Any]) -> str:
    """Describe the state it is in instead."""
    if results["active"] is not False:
        return ""
    return f"it is {results['state']}" if results["state"] else "it is not there"
