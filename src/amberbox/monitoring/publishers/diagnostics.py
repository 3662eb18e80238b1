"""Statuses as a ROS ``diagnostic_msgs/DiagnosticArray``, in the JSON that its fields give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Level, Output, Status
from amberbox.monitoring.plan import Naming

OK, WARN, ERROR, STALE = range(4)
# ROS has no level for unknown; STALE also means that nothing is known now
LEVELS: Mapping[Level, int] = {
    **{"ok": OK, "warn": WARN, "error": ERROR},
    **{"stale": STALE, "unknown": STALE},
}


def messages(
    statuses: Sequence[Status], naming: Naming, diagnosis: Diagnosis | None = None
) -> list[dict[str, Any]]:
    """Return one array with a status of each component and mode; no array without statuses.

    Components that the leading hypotheses of the open diagnosis concern name their failure modes.
    """
    if not statuses:
        return []
    secs, nsecs = divmod(max(status.measured_ns for status in statuses), NS)
    stamp = {"secs": secs, "nsecs": nsecs}
    return [
        {
            "header": {"seq": 0, "stamp": stamp, "frame_id": ""},
            "status": [_status(status, naming, diagnosis) for status in statuses],
        }
    ]


def _status(status: Status, naming: Naming, diagnosis: Diagnosis | None) -> dict[str, Any]:
    name = f"{status.component}: {naming.monitor(status)}" if status.mode else status.component
    values = {**_values(status), **({} if status.mode else causes(status.component, diagnosis))}
    return {
        "level": LEVELS[status.level],
        "name": name,
        "message": status.reason or status.state,
        "hardware_id": status.robot,
        "values": [{"key": key, "value": value} for key, value in values.items()],
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


def causes(component: str, diagnosis: Diagnosis | None) -> Mapping[str, str]:
    """Return what an open diagnosis says of a component: its failure modes, and the evidence."""
    if diagnosis is None or diagnosis.state != "open":
        return {}
    concerned = [
        (sorted(hypothesis.faults), hypothesis)
        for hypothesis in diagnosis.leading()
        if any(fault.partition("#")[0] == component for fault in hypothesis.faults)
    ]
    if not concerned:
        return {}
    faults = (f"{' + '.join(names)} ({one.probability:.0%})" for names, one in concerned)
    evidence = dict.fromkeys(symptom for _, one in concerned for symptom in one.explains)
    return {
        "failure_modes": " or ".join(faults),
        "evidence": ", ".join(evidence),
        "diagnosis": diagnosis.id,
    }


def text_of(value: Output) -> str:
    """Return an output, which may be a number of numpy's, as text: ``true``, ``12.5``."""
    plain: Any = value
    plain = plain.item() if hasattr(plain, "item") else plain
    if plain is None:
        return "unknown"
    if isinstance(plain, bool):
        return "true" if plain else "false"
    return f"{plain:.6g}" if isinstance(plain, float) else str(plain)
