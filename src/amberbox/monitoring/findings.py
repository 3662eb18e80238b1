"""Findings of monitoring (statuses, transitions, alarm changes, symptoms) and their records.

Each field of a finding has one place in its record in the watcher's journal, so that it is read
back without loss.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, Literal, NamedTuple, Protocol, TypeAlias, TypeVar

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.robot_status import Severity
from amberbox.core.types import (
    AmbiguityGroup,
    Diagnosis,
    Hypothesis,
    Level,
    Output,
    Status,
    Symptom,
    Test,
)

TICK_NS = NS // 20  # all instants are multiples of this
OutputCondition: TypeAlias = Literal["ok", "bad", "unknown", "stale"]
AlarmState: TypeAlias = Literal["open", "acknowledged", "shelved", "resolved", "healed"]


class OutputChange(NamedTuple):
    """The condition of one output found at an instant.

    ``output`` is its number in ``states.outputs_of(plan)``. ``reason`` is why it is unknown, stale
    or bad; for bad it may be empty. Changes of bools and texts are such findings too, even without
    an expected value.
    """

    at_ns: int
    output: int
    what: OutputCondition
    value: Output = None
    reason: str = ""


class OutputValues(Protocol):
    """The values of outputs at the instants of a block."""

    def outputs(self, mode: int, at_ns: int) -> Mapping[str, Output]:
        """Return all outputs of a mode (its number in ``plan.modes()``), in order."""


class HealthState(NamedTuple):
    """Level and state of a mode or component: ``error front_laser_working``."""

    level: Level
    state: str


@dataclass(frozen=True, slots=True)
class Transition:
    """A mode or component (``mode`` empty) changed from one condition to another.

    ``hint`` describes what to do, from the hints of its outputs.
    """

    robot: str
    component: str
    mode: str
    before: HealthState
    after: HealthState
    at_ns: int
    reason: str
    blocked_by: tuple[str, ...]
    hint: str
    config_hash: str
    live_only: bool = False

    @property
    def text(self) -> str:
        """Return the transition in one line: ``laser: nominal -> front_laser_working: ...``."""
        name = f"{self.component}/{self.mode}" if self.mode else self.component
        before, after = self._named(self.before, self.after), self._named(self.after, self.before)
        line = f"{name}: {before} -> {after}"
        return f"{line}: {self.reason}" if self.reason else line

    @staticmethod
    def _named(one: HealthState, other: HealthState) -> str:
        return one.state if one.state != other.state else f"{one.state} ({one.level})"


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """An alarm after a change.

    ``count`` is how often it has opened. ``who`` acknowledged, shelved or resolved it, or took it
    from the shelf; ``until_ns`` is the end of shelving, ``note`` what the person wrote, ``said_ns``
    when they did it, ``command`` the id of the server's command where it was done on the server.
    ``cause`` is the leading answer of the ``diagnosis`` (its id) that concerns the
    component, both empty while there is none. ``also`` are components whose own alarms are part of
    this one, since they have the same leading cause.
    """

    robot: str
    id: str
    component: str
    severity: Severity
    state: AlarmState
    level: Level
    reason: str
    opened_ns: int
    changed_ns: int
    count: int
    who: str
    until_ns: int | None
    config_hash: str
    live_only: bool = False
    cause: str = ""
    diagnosis: str = ""
    also: tuple[str, ...] = ()
    note: str = ""
    said_ns: int | None = None
    command: str = ""


# the engine emits all but diagnoses, which are made of them
Finding: TypeAlias = "Status | Transition | AlarmChange | Symptom | Diagnosis"


def is_live_only(finding: Finding) -> bool:
    """Return whether a replay of the record cannot find it too."""
    return not isinstance(finding, Symptom) and finding.live_only


def valid_text(text: str) -> str:
    """Return a text with question marks for invalid characters."""
    return text if text.isascii() else text.encode("utf-8", "replace").decode()


def instant_of(finding: Finding) -> int:
    """Return the instant of a finding, log time in ns."""
    if isinstance(finding, Status):
        return finding.measured_ns
    if isinstance(finding, AlarmChange):
        return finding.changed_ns
    if isinstance(finding, Symptom):
        return finding.confirmed_ns or 0
    return finding.at_ns


Values = Mapping[str, Any]
Kind = TypeVar("Kind")
_MISSING: Final = object()


def _same(value: Any) -> Any:
    return value


class FieldCodec(NamedTuple):
    """The codec of one field; ``default`` is for older records that lack it."""

    write: Callable[[Any], Any] = _same
    read: Callable[[Any], Any] = _same
    default: Any = _MISSING


class RecordCodec(Generic[Kind]):
    """The forms of all fields of a class, in the order in which they are written."""

    def __init__(self, kind: Callable[..., Kind], fields: Mapping[str, FieldCodec]) -> None:
        self._kind = kind
        self._fields = fields

    def write(self, thing: Kind) -> Values:
        """Return the values of a record."""
        return {name: form.write(getattr(thing, name)) for name, form in self._fields.items()}

    def read(self, values: Values) -> Kind:
        """Return the object in a record; raises KeyError where a field is missing."""
        return self._kind(**{n: _read(values, n, form) for n, form in self._fields.items()})

    @property
    def many(self) -> FieldCodec:
        """The form of several of them in order."""
        return FieldCodec(
            lambda things: [self.write(thing) for thing in things],
            lambda entries: tuple(self.read(entry) for entry in entries),
        )


def _read(values: Values, name: str, form: FieldCodec) -> Any:
    if form.default is not _MISSING and name not in values:
        return form.default
    return form.read(values[name])


SAME = FieldCodec()
WHOLE = FieldCodec(read=int)
NUMBER = FieldCodec(read=float)
FLAG = FieldCodec(read=bool)
TEXTS = FieldCodec(read=tuple)
TIME_IF_ANY = FieldCodec(read=lambda value: None if value is None else int(value))


def symptom_of(values: Values) -> Symptom:
    """Return the symptom in a record."""
    return _SYMPTOM.read(values)


def diagnosis_values(diagnosis: Diagnosis) -> Values:
    """Return the values of a diagnosis in its record."""
    return _DIAGNOSIS.write(diagnosis)


def diagnosis_of(values: Values) -> Diagnosis:
    """Return the diagnosis in a record."""
    return _DIAGNOSIS.read(values)


def _evidence_values(evidence: Sequence[tuple[str, int, int]]) -> Sequence[Values]:
    return [
        {"address": address, "from_ns": from_ns, "to_ns": to_ns}
        for address, from_ns, to_ns in evidence
    ]


def _evidence_of(entries: Sequence[Values]) -> tuple[tuple[str, int, int], ...]:
    return tuple((e["address"], int(e["from_ns"]), int(e["to_ns"])) for e in entries)


def _outcomes_values(outcomes: Mapping[str, float]) -> Sequence[Values]:
    return [
        {"answer": answer, "probability": probability} for answer, probability in outcomes.items()
    ]


def _outcomes_of(entries: Sequence[Values]) -> dict[str, float]:
    return {entry["answer"]: float(entry["probability"]) for entry in entries}


_SYMPTOM = RecordCodec(Symptom, {
    "id": SAME, "state": SAME, "address": SAME, "onset_ns": TIME_IF_ANY,
    "confirmed_ns": TIME_IF_ANY, "strength": NUMBER, "source": SAME,
    "evidence": FieldCodec(_evidence_values, _evidence_of), "blocked_by": TEXTS,
    "reason": FieldCodec(default=""),
    "size": FieldCodec(read=lambda value: None if value is None else float(value), default=None),
})  # fmt: skip
_HYPOTHESIS = RecordCodec(Hypothesis, {
    "id": SAME, "faults": FieldCodec(sorted, frozenset), "probability": NUMBER, "explains": TEXTS,
    "unexplained": TEXTS, "contradicted": TEXTS, "ambiguity": TEXTS, "proof": SAME,
    "criticality": NUMBER, "follows": FieldCodec(sorted, frozenset, default=frozenset()),
})  # fmt: skip
_GROUP = RecordCodec(AmbiguityGroup, {
    "members": TEXTS, "probability": NUMBER, "wider": TEXTS, "split_by": SAME,
})  # fmt: skip
_TEST = RecordCodec(Test, {
    "id": SAME, "kind": SAME, "text": SAME, "role": SAME, "cost_s": NUMBER, "risk": NUMBER,
    "gain_bits": NUMBER, "outcomes": FieldCodec(_outcomes_values, _outcomes_of),
    "run": FieldCodec(default=""), "moves": FieldCodec(read=bool, default=False),
})  # fmt: skip
_DIAGNOSIS = RecordCodec(Diagnosis, {
    "id": SAME, "revision": WHOLE, "robot": SAME, "at_ns": WHOLE, "state": SAME,
    "symptoms": TEXTS, "hypotheses": _HYPOTHESIS.many, "groups": _GROUP.many,
    "mass_covered": NUMBER, "incomplete": SAME, "findings": TEXTS, "next_tests": _TEST.many,
    "config_hash": SAME, "live_only": FLAG, "make_safe": FieldCodec(read=tuple, default=()),
    "asked": FieldCodec(read=tuple, default=()),
})  # fmt: skip


COMPONENT_STATE = "component_state"  # event kind of transitions
SOURCE = "watch"

_encode = msgspec.json.Encoder().encode


def record_of(finding: Finding) -> tuple[str, Values]:
    """Return the channel and the values of the record that a finding is written as."""
    if isinstance(finding, Transition):
        return channels.EVENT, transition_values(finding)
    channel, codec = _RECORDS[type(finding)]
    return channel, codec.write(finding)


def encoded(finding: Finding) -> tuple[str, bytes]:
    """Return the channel and the JSON of a finding, as written in the journal."""
    channel, values = record_of(finding)
    return channel, _encode(values)


def finding_of(channel: str, values: Values) -> Finding | None:
    """Return the finding that a record is; None for a record of another kind."""
    if channel == channels.EVENT:
        return transition_of(values) if values["kind"] == COMPONENT_STATE else None
    for known, codec in _RECORDS.values():
        if known == channel:
            finding: Finding = codec.read(values)
            return finding
    return None


def status_of(values: Values) -> Status:
    """Return the status in a record."""
    return _STATUS.read(values)


def outputs_of(entries: Sequence[Values]) -> dict[str, Output]:
    """Return the outputs in a record, by name."""
    return {entry["name"]: _value(entry) for entry in entries}


def _outputs_values(outputs: Mapping[str, Output]) -> Sequence[Values]:
    return [_output(name, value) for name, value in outputs.items()]


def _output(name: str, value: Any) -> Values:
    if type(value) not in _KINDS and hasattr(value, "item"):  # a number of numpy's
        value = value.item()
    kind = _KINDS.get(type(value))
    if kind is None:
        raise TypeError(f"output {name}: {type(value).__name__} is no bool, number or text")
    text = None
    if kind == "string":
        value, text = None, value
    elif kind == "bool":
        value = int(value)
    elif kind == "float" and not math.isfinite(value):
        text = "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
        value = None
    return {"name": name, "type": kind, "value": value, "text": text}


_KINDS: Mapping[type, str] = {
    **{type(None): "null", bool: "bool", int: "int"},
    **{float: "float", str: "string"},
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
    """Return the values of a transition in its event."""
    return {
        "kind": COMPONENT_STATE,
        "text": transition.text,
        "source": SOURCE,
        "details": _encode(_TRANSITION.write(transition)).decode(),
    }


def transition_of(values: Values) -> Transition:
    """Return the transition in an event of kind ``component_state``."""
    return _TRANSITION.read(msgspec.json.decode(values["details"]))


def alarm_values(alarm: AlarmChange) -> Values:
    """Return the values of an alarm in its record."""
    return _ALARM.write(alarm)


def alarm_of(values: Values) -> AlarmChange:
    """Return the alarm in a record."""
    return _ALARM.read(values)


_CONDITION = RecordCodec(HealthState, {"level": SAME, "state": SAME})
_IN_CONDITION = FieldCodec(_CONDITION.write, _CONDITION.read)
_STATUS = RecordCodec(Status, {
    "robot": SAME, "component": SAME, "mode": SAME, "level": SAME, "state": SAME,
    "outputs": FieldCodec(_outputs_values, outputs_of), "blocked_by": TEXTS, "measured_ns": WHOLE,
    "since_ns": WHOLE, "reason": SAME, "config_hash": SAME, "live_only": FLAG,
})  # fmt: skip
_TRANSITION = RecordCodec(Transition, {
    "robot": SAME, "component": SAME, "mode": SAME, "before": _IN_CONDITION,
    "after": _IN_CONDITION, "at_ns": SAME, "reason": SAME, "blocked_by": TEXTS, "hint": SAME,
    "config_hash": SAME, "live_only": SAME,
})  # fmt: skip
_ALARM = RecordCodec(AlarmChange, {
    "id": SAME, "robot": SAME, "component": SAME, "severity": SAME, "state": SAME, "level": SAME,
    "reason": SAME, "opened_ns": WHOLE, "changed_ns": WHOLE, "count": WHOLE, "who": SAME,
    "until_ns": TIME_IF_ANY, "cause": FieldCodec(default=""), "diagnosis": FieldCodec(default=""),
    "config_hash": SAME, "live_only": FLAG, "also": FieldCodec(read=tuple, default=()),
    "note": FieldCodec(default=""), "said_ns": TIME_IF_ANY._replace(default=None),
    "command": FieldCodec(default=""),
})  # fmt: skip
_RECORDS: Final[Mapping[type[Any], tuple[str, RecordCodec[Any]]]] = {
    Status: (channels.STATUS, _STATUS),
    Symptom: (channels.SYMPTOM, _SYMPTOM),
    Diagnosis: (channels.DIAGNOSIS, _DIAGNOSIS),
    AlarmChange: (channels.ALARM, _ALARM),
}  # where findings are written, but for transitions, which are events
