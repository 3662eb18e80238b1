"""Statuses as a ROS ``diagnostic_msgs/DiagnosticArray``, in the JSON that its fields give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.types import Level, Output, Status
from amberbox.monitoring.plan import Naming

OK, WARN, ERROR, STALE = range(4)
# ROS has no level for unknown; STALE also means that nothing is known now
LEVELS: Mapping[Level, int] = {
    **{"ok": OK, "warn": WARN, "error": ERROR},
    **{"stale": STALE, "unknown": STALE},
}


def messages(statuses: Sequence[Status], naming: Naming) -> list[dict[str, Any]]:
    """Return one array with a status of each component and mode; no array without statuses."""
    if not statuses:
        return []
    secs, nsecs = divmod(max(status.measured_ns for status in statuses), NS)
    stamp = {"secs": secs, "nsecs": nsecs}
    return [
        {
            "header": {"seq": 0, "stamp": stamp, "frame_id": ""},
            "status": [_status(status, naming) for status in statuses],
        }
    ]


def _status(status: Status, naming: Naming) -> dict[str, Any]:
    name = f"{status.component}: {naming.monitor(status)}" if status.mode else status.component
    return {
        "level": LEVELS[status.level],
        "name": name,
        "message": status.reason or status.state,
        "hardware_id": status.robot,
        "values": [{"key": key, "value": value} for key, value in _values(status).items()],
    }


def _values(status: Status) -> Mapping[str, str]:
    """Return outputs and state as text; also our level where ROS has none like it."""
    values = {name: text_of(value) for name, value in status.outputs.items()}
    values["state"] = status.state
    if status.blocked_by:
        values["blocked_by"] = ", ".join(status.blocked_by)
    if status.level == "unknown":
        values["level"] = status.level
    return values


def text_of(value: Output) -> str:
    """Return an output as text: ``true``, ``12.5``, ``unknown``."""
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
