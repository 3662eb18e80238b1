"""Goals of an action server, or calls of a service: one that failed is a fault for a while."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.mode import Given, Input, Result, numbers, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples, Window

ACCEPTS = ("item",)
COLUMNS = True
PARTS = True
PER_INPUT = True
TIMED = True
SEES_SILENCE = True
RESULTS = (
    Result("none_failed", "bool", "no goal that is listed, or call, has failed within the window"),
    Result("listed", "int", "goals listed with a status that counts, or calls that failed"),
)
SAMPLE = """\
name: move_base_goals_monitor
monitor: goals
description: move_base reaches its goals
mappings:
  - mapping:
      inputs: [ros_move_base_status__status_list]
      outputs:
        - output: {name: none_failed, type: bool, severity: warning}
arguments:
  failed: [4, 5]
"""
_SETTLES_S = 1.0  # a server without goals is taken for idle once it was listened to for so long


@dataclass(frozen=True, slots=True)
class GoalsOptions:
    """What counts as a failure, and for how long."""

    of: Literal["goals", "calls"] = option(
        "goals", "goals of an action server, or calls of a service by the answers in its events"
    )
    failed: tuple[int, ...] = option(
        (4, 5), "statuses of a goal that failed: ROS 1 4 aborted, 5 rejected; ROS 2 6 aborted"
    )
    window: float = option(10.0, "how long a failure counts after it was last listed", unit="s")

    def check(self) -> Iterator[Finding]:
        """Refuse what never holds."""
        if not self.failed:
            yield "failed", "names no status"
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"


Config = GoalsOptions


def history_s(config: GoalsOptions) -> float:
    """Return how far back it looks."""
    return config.window


def evaluate(config: GoalsOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Count the rows of the window that are failures; an empty list has no rows."""
    (item,) = inputs
    column, failures = ("status", config.failed) if config.of == "goals" else ("success", (0,))
    status = item.parts.get(column, Samples())
    failed = np.isin(numbers(status.values), failures)
    if status.null is not None:
        failed &= ~status.null
    listed = Window(status, now, config.window).sum_of(failed)
    known = item.flow.listened(now, _SETTLES_S) | (listed > 0)
    return {"none_failed": where_known(known, listed == 0), "listed": listed}


def reason(config: GoalsOptions, given: Given) -> str:
    """Name the servers whose goals or calls failed, where several are watched."""
    found = [
        one.name for one in given.inputs if evaluate(config, [one], given.now_ns)["listed"] > 0
    ]
    if len(given.inputs) == 1:
        return ""
    return f"{config.of} of {', '.join(found)} failed within the last {config.window:g} s"


def explain(config: GoalsOptions, results: Mapping[str, Any]) -> str:
    """Describe that a goal or a call failed."""
    if results["none_failed"] is not False:
        return ""
    return f"a {config.of.removesuffix('s')} failed within the last {config.window:g} s"
