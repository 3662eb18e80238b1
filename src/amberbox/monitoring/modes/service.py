"""Service: a unit, process, container, ROS node or topic that has to be there is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amberbox.core.mode import TRUE, Input, Result, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("probe",)
COLUMNS = True
PER_INPUT = True
RESULTS = (
    Result("active", "bool", "it is there and works, as far as can be asked"),
    Result("running", "bool", "it is there; also a ROS node that does not answer any more"),
    Result("responds", "bool", "the same, but a ROS node that is not there is unknown"),
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

    kind: Literal[
        "unit",
        "process",
        "container",
        "ros_node",
        "ros_topic",
        "ros_service",
        "ros_master",
        "ros2_node",
        "http",
    ] = option("unit", "what the inputs are names of")


Config = ServiceOptions


def probe_of(config: ServiceOptions, text: str) -> tuple[str, str]:
    """Return kind and subject of the probe that checks it."""
    return ("unit_active" if config.kind == "unit" else config.kind), text


def evaluate(config: ServiceOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Return the result of the last check."""
    (one,) = inputs
    active = where_known(one.samples.known(now), one.at(now))
    results = {
        "active": active,
        "running": active,
        "responds": active,
        "state": np.full(np.shape(now), "", object)[()],
    }
    if "listens" in one.parts:
        listens, answers = one.part("listens"), one.part("answers")
        running = where_known(listens.samples.known(now), listens.at(now))
        known = answers.samples.known(now) & (running == TRUE)
        results |= {"running": running, "responds": where_known(known, answers.at(now))}
    if "state" in one.parts:
        state = one.part("state")
        words = np.asarray(state.at(now), object)
        results["state"] = np.where(state.samples.known(now), words, "")[()]
    return results


def explain(config: ServiceOptions, results: Mapping[str, Any]) -> str:
    """Describe the state it is in instead."""
    if results.get("running") is True and results.get("responds") is False:
        return "it is there and does not answer"
    if results["active"] is not False:
        return ""
    return f"it is {results['state']}" if results["state"] else "it is not there"
