"""What the monitors of the simulated robot find: its messages as batches, through the engine."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.errors import Problem
from amberbox.core.types import Batch, Column, ItemSchema, Ragged
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import AlarmChange, Finding, Transition
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import START_NS, Message, Robot

FAULT_S = 20.0
"""When faults begin: the robot drives, and all windows of its monitors are full."""


def plan_of(folder: Path) -> tuple[MonitoringPlan, list[Problem]]:
    """Make a new robot folder and load its plan."""
    assert main(["new", str(folder), "--from", "sim"]) == 0
    return load_plan(load_folder(folder))


def find(plan: MonitoringPlan, messages: Sequence[Message], until_s: float) -> list[Finding]:
    """Return what the monitors find in messages of a robot."""
    engine = Engine(plan)
    engine.begin(START_NS - NS)
    for batch in batches(messages):
        engine.feed(batch)
    return engine.advance(START_NS + round(until_s * NS))


def with_fault(fault: str, seconds: float, seed: int = 3) -> list[Message]:
    """Return the messages of a robot that gets a fault at ``FAULT_S``."""
    robot, before = _before(catalogue()[fault].scenario, seed)
    robot = copy.deepcopy(robot)
    robot.inject(fault)
    return [*before, *robot.step_until(FAULT_S + seconds)]


@cache
def _before(scenario: str, seed: int) -> tuple[Robot, Sequence[Message]]:
    robot = Robot(seed, scenario=scenario)
    return robot, tuple(robot.step_until(FAULT_S))


def alarms(findings: Sequence[Finding]) -> dict[str, float]:
    """Return when the first alarm of each component opened, in seconds."""
    found: dict[str, float] = {}
    for finding in findings:
        if isinstance(finding, AlarmChange) and finding.state == "open":
            found.setdefault(finding.component, (finding.changed_ns - START_NS) / NS)
    return found


def failures(findings: Sequence[Finding]) -> Iterator[Transition]:
    """Yield the transitions to levels that are not ok."""
    for finding in findings:
        if isinstance(finding, Transition) and finding.after.level in ("warn", "error", "stale"):
            yield finding


def batches(messages: Sequence[Message]) -> Iterator[Batch]:
    """Make the batches that a reader of the record would give, one for each item."""
    times: dict[str, list[int]] = {}
    columns: dict[str, dict[str, list[Any]]] = {}
    for topic, sent_ns, message in messages:
        times.setdefault(topic, []).append(sent_ns)
        into = columns.setdefault(topic, {})
        for name, value in _flat("", message):
            into.setdefault(name, []).append(value)
    for topic, log_ns in times.items():
        yield _batch(f"sim_{topic}", np.array(log_ns, np.int64), columns[topic])


def _flat(prefix: str, message: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in message.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}_", value)
        else:
            yield f"{prefix}{key}", value


def _batch(item: str, log_ns: Any, columns: Mapping[str, list[Any]]) -> Batch:
    made = {name: _column(values) for name, values in columns.items()}
    schema = ItemSchema("sim", tuple(Column(n, n, kind) for n, (kind, _) in made.items()))
    data = {name: column for name, (_, column) in made.items()}
    return Batch(item, schema, "main", 1, np.arange(len(log_ns)), log_ns, log_ns, log_ns, data)


def _column(values: list[Any]) -> tuple[str, Any]:
    if isinstance(values[0], str):
        return "string", np.array(values, object)
    if isinstance(values[0], list):
        rows = np.array(values, np.float64)
        return "list<float64>", Ragged(np.arange(0, rows.size + 1, rows.shape[1]), rows.ravel())
    column = np.array(values)
    return {"b": "bool", "i": "int64", "f": "float64"}[column.dtype.kind], column
