"""Statuses for an MQTT broker: one JSON object for each component, its modes in it.

``problem`` is what a ``binary_sensor`` of Home Assistant shows: ``ON`` for warnings, errors and
components that are silent, ``OFF`` for those that are ok, null where nothing is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.timestamps import format_to_second
from amberbox.core.types import Diagnosis, Level, Status
from amberbox.monitoring.plan import Naming
from amberbox.monitoring.publishers.diagnostics import causes

PROBLEMS: Mapping[Level, str | None] = {
    **{"ok": "OFF", "warn": "ON", "error": "ON", "stale": "ON"},
    "unknown": None,
}


def messages(
    statuses: Sequence[Status], naming: Naming, diagnosis: Diagnosis | None = None
) -> list[dict[str, Any]]:
    """Return one message with the objects of all components by id; none without statuses."""
    if not statuses:
        return []
    components = {
        status.component: {
            "name": naming.component(status),
            "problem": PROBLEMS[status.level],
            **_facts(status),
            "blocked_by": list(status.blocked_by),
            "since": format_to_second(status.since_ns),
            **causes(status.component, diagnosis),
            "modes": {},
        }
        for status in statuses
        if not status.mode
    }
    for status in statuses:
        if status.mode and status.component in components:
            mode = {**_facts(status), "outputs": dict(status.outputs)}
            components[status.component]["modes"][naming.monitor(status)] = mode
    return [{"components": components}]


def _facts(status: Status) -> dict[str, Any]:
    return {"level": status.level, "state": status.state, "reason": status.reason}


def meaning(component: Mapping[str, Any]) -> tuple[object, ...]:
    """Return what of a component is news at once; numbers and reasons change all the time."""
    modes = ((name, mode["level"], mode["state"]) for name, mode in component["modes"].items())
    news = ("problem", "level", "state", "blocked_by", "failure_modes")
    return (*(str(component.get(key)) for key in news), *modes)
