"""What is found of a robot, as records of the watcher's journal, and back.

The bytes are canonical: the same finding gives the same bytes, keys in the order of
``docs/format.md``. JSON has no NaN and no infinity, so such a number stands as a word in ``text``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.core.types import Diagnosis, Output, Status, Symptom
from amberbox.monitoring.engine.findings import AlarmChange, Condition, Finding, Transition
from amberbox.monitoring.messages.diagnoses import (
    diagnosis_of,
    diagnosis_values,
    symptom_of,
    symptom_values,
)
from amberbox.monitoring.messages.forms import FLAG, SAME, TIME_IF_ANY, WHOLE, Form, Forms, Values

COMPONENT_STATE = "component_state"
"""Kind of the events that transitions are."""
SOURCE = "watch"

_encode = msgspec.json.Encoder().encode


def record_of(finding: Finding) -> tuple[str, Values]:
    """Return the channel and the values of the record that a finding is written as."""
    if isinstance(finding, Status):
        return reserved.STATUS, status_values(finding)
    if isinstance(finding, Transition):
        return reserved.EVENT, transition_values(finding)
    if isinstance(finding, Symptom):
        return reserved.SYMPTOM, symptom_values(finding)
    if isinstance(finding, Diagnosis):
        return reserved.DIAGNOSIS, diagnosis_values(finding)
    return reserved.ALARM, alarm_values(finding)


def encoded(finding: Finding) -> tuple[str, bytes]:
    """Return the channel and the JSON of a finding, as they stand in the journal."""
    channel, values = record_of(finding)
    return channel, _encode(values)


def finding_of(channel: str, values: Values) -> Finding | None:
    """Return the finding that a record is; None for a record of another kind."""
    if channel == reserved.STATUS:
        return status_of(values)
    if channel == reserved.ALARM:
        return alarm_of(values)
    if channel == reserved.SYMPTOM:
        return symptom_of(values)
    if channel == reserved.DIAGNOSIS:
        return diagnosis_of(values)
    if channel == reserved.EVENT and values["kind"] == COMPONENT_STATE:
        return transition_of(values)
    return None


def status_values(status: Status) -> Values:
    """Return what is written of a status."""
    return {
        "robot": status.robot,
        "component": status.component,
        "mode": status.mode,
        "level": status.level,
        "state": status.state,
        "outputs": [_output(name, value) for name, value in status.outputs.items()],
        "blocked_by": status.blocked_by,
        "measured_ns": status.measured_ns,
        "since_ns": status.since_ns,
        "reason": status.reason,
        "config_hash": status.config_hash,
        "live_only": status.live_only,
    }


def status_of(values: Values) -> Status:
    """Return the status that a record says."""
    return Status(
        robot=values["robot"],
        component=values["component"],
        mode=values["mode"],
        level=values["level"],
        state=values["state"],
        outputs=outputs_of(values["outputs"]),
        blocked_by=tuple(values["blocked_by"]),
        measured_ns=int(values["measured_ns"]),
        since_ns=int(values["since_ns"]),
        reason=values["reason"],
        config_hash=values["config_hash"],
        live_only=bool(values["live_only"]),
    )


def outputs_of(entries: Sequence[Values]) -> dict[str, Output]:
    """Return the outputs that a record says, by name."""
    return {entry["name"]: _value(entry) for entry in entries}


def _output(name: str, value: Any) -> Values:
    kind = _KINDS.get(type(value))
    if kind is None and hasattr(value, "item"):  # a number of numpy's
        value = value.item()
        kind = _KINDS.get(type(value))
    if kind is None:
        raise TypeError(f"output {name}: {type(value).__name__} is no bool, number or text")
    return kind(name, value)


def _none(name: str, _: None) -> Values:
    return {"name": name, "type": "null", "value": None, "text": None}


def _bool(name: str, value: bool) -> Values:
    return {"name": name, "type": "bool", "value": int(value), "text": None}


def _int(name: str, value: int) -> Values:
    return {"name": name, "type": "int", "value": value, "text": None}


def _float(name: str, value: float) -> Values:
    if math.isfinite(value):
        return {"name": name, "type": "float", "value": value, "text": None}
    word = "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return {"name": name, "type": "float", "value": None, "text": word}


def _string(name: str, value: str) -> Values:
    return {"name": name, "type": "string", "value": None, "text": value}


_KINDS: Mapping[type, Callable[[str, Any], Values]] = {
    **{type(None): _none, bool: _bool, int: _int},
    **{float: _float, str: _string},
}


def _value(entry: Values) -> Output:
    kind, value = entry["type"], entry["value"]
    if kind == "string":
        return str(entry["text"])
    if kind == "float":
        return float(entry["text"] if value is None else value)
    if kind == "bool":
        return bool(value)
    return int(value) if kind == "int" else None


def transition_values(transition: Transition) -> Values:
    """Return the event that is written of a transition."""
    details = {
        "robot": transition.robot,
        "component": transition.component,
        "mode": transition.mode,
        "before": {"level": transition.before.level, "state": transition.before.state},
        "after": {"level": transition.after.level, "state": transition.after.state},
        "at_ns": transition.at_ns,
        "reason": transition.reason,
        "blocked_by": transition.blocked_by,
        "hint": transition.hint,
        "config_hash": transition.config_hash,
        "live_only": transition.live_only,
    }
    return {
        "kind": COMPONENT_STATE,
        "text": transition.text,
        "source": SOURCE,
        "details": _encode(details).decode(),
    }


def transition_of(values: Values) -> Transition:
    """Return the transition that an event of kind ``component_state`` says."""
    details = msgspec.json.decode(values["details"])
    return Transition(
        robot=details["robot"],
        component=details["component"],
        mode=details["mode"],
        before=Condition(details["before"]["level"], details["before"]["state"]),
        after=Condition(details["after"]["level"], details["after"]["state"]),
        at_ns=details["at_ns"],
        reason=details["reason"],
        blocked_by=tuple(details["blocked_by"]),
        hint=details["hint"],
        config_hash=details["config_hash"],
        live_only=details["live_only"],
    )


def alarm_values(alarm: AlarmChange) -> Values:
    """Return what is written of an alarm after a change."""
    return _ALARM.write(alarm)


def alarm_of(values: Values) -> AlarmChange:
    """Return the alarm that a record says."""
    return _ALARM.read(values)


_ALARM = Forms(AlarmChange, {
    "id": SAME, "robot": SAME, "component": SAME, "severity": SAME, "state": SAME, "level": SAME,
    "reason": SAME, "opened_ns": WHOLE, "changed_ns": WHOLE, "count": WHOLE, "who": SAME,
    "until_ns": TIME_IF_ANY, "cause": Form(default=""), "diagnosis": Form(default=""),
    "config_hash": SAME, "live_only": FLAG, "also": Form(read=tuple, default=()),
})  # fmt: skip
