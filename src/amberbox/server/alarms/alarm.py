"""An alarm: its state, parts, settings, and the explanation from its diagnosis."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final, Literal, TypeAlias

import msgspec

from amberbox.core.api import AlarmKind, AlarmState, CauseKind, LeadingCause, Words
from amberbox.core.clock import NS
from amberbox.core.robot_status import SEVERITIES, Severity
from amberbox.core.types import UNKNOWN_FAULT, Level

NAME: Final = "alarms"
"""Under this name it is kept among the settings."""


def _check_output(output: str) -> None:
    places = output.split("/")
    if len(places) != 3 or not all(places):
        raise ValueError(f"output: {output!r} is not component/mode/output (* for any)")


@dataclass(frozen=True, slots=True)
class Excuse:
    """A robot that said so last is not missed: an output of a status, and its value.

    ``output`` is ``component/mode/output``; ``*`` in a place fits whatever stands there.
    """

    output: str
    value: bool | float | str = True

    def __post_init__(self) -> None:
        _check_output(self.output)


@dataclass(frozen=True, slots=True)
class Shared:
    """Something that robots share, by an output of their status: its ``word`` is for people."""

    word: str
    output: str

    def __post_init__(self) -> None:
        _check_output(self.output)
        if not self.word.strip():
            raise ValueError("word: say what is shared, for instance 'access point'")


@dataclass(frozen=True, slots=True)
class AlarmSettings:
    """When alarms open, and when they are over; times in seconds.

    A robot that is away for ``offline_after_s`` is missed, 0 is never; ``offline_after_of`` says
    otherwise for a robot or a group. Robots lost within ``together_s`` are one alarm. A new alarm
    waits ``settle_s`` for what it follows from before anybody is told. It is over when it has been
    quiet for ``quiet_s``, and the same alarm again when it comes back within ``reopen_s``. What
    reaches the server more than ``late_s`` after it happened is late.
    """

    offline_after_s: float = 120.0
    offline_after_of: dict[str, float] = field(default_factory=dict)
    together_s: float = 10.0
    settle_s: float = 10.0
    quiet_s: float = 60.0
    reopen_s: float = 300.0
    late_s: float = 60.0
    excused: tuple[Excuse, ...] = (
        Excuse("*/*/docked"), Excuse("*/*/charging"), Excuse("*/*/in_coverage", False),
    )  # fmt: skip
    shared: tuple[Shared, ...] = (Shared("access point", "*/*/access_point"),)

    def __post_init__(self) -> None:
        """Raise ValueError for a time that is negative, not finite, or above 1e7 s."""
        numbers = [(f.name, getattr(self, f.name)) for f in fields(self) if f.name.endswith("_s")]
        for name, value in [*numbers, *self.offline_after_of.items()]:
            if not (math.isfinite(value) and 0 <= value <= 1e7):
                raise ValueError(f"{name}: {value} is no time in seconds")

    def ns(self, name: str) -> int:
        """Return a time of the settings in nanoseconds: ``ns("quiet_s")``."""
        return round(float(getattr(self, name)) * NS)


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm of one or several robots; ``number`` is its id and never changes.

    ``origin`` is the component that the alarm comes from, or what offline robots have in common.
    ``active``: the fault is still present. ``state``: what people did with the alarm. The two are
    independent. ``late``: it was reported long after it happened. ``told`` is the highest severity
    that was notified, ``notify_ns`` when the next notification is due. ``revision`` goes up with
    every change that a person should know of before changing the alarm.

    ``revised`` is the last revision of its diagnosis while the alarm was active (0: unknown),
    ``effect`` the severity of the effect by that revision, ``words`` its explanation, encoded by
    ``encode_words``. ``severity`` is that of the effect if there is one, else the worst that the
    robot's monitors reported. ``worst`` is the highest severity it has had, empty if that is
    ``severity``.
    """

    number: int
    kind: AlarmKind
    robot: str
    origin: str
    severity: Severity
    level: Level
    reason: str
    opened_ns: int
    changed_ns: int
    cause: str = ""
    diagnosis: str = ""
    active: bool = True
    cleared_ns: int | None = None
    count: int = 1
    state: AlarmState = "open"
    late: bool = False
    acknowledged_by: str = ""
    acknowledged_ns: int | None = None
    shelved_by: str = ""
    shelved_until_ns: int | None = None
    owner: str = ""
    resolved_by: str = ""
    resolved_ns: int | None = None
    resolution: str = ""
    merged_into: int | None = None
    told: Severity | Literal[""] = ""
    notify_ns: int | None = None
    revision: int = 1
    revised: int = 0
    effect: Severity | Literal[""] = ""
    worst: Severity | Literal[""] = ""
    words: str = ""


@dataclass(frozen=True, slots=True)
class AlarmPart:
    """An alarm as a robot reports it (``source`` is its id there), all or part of an ``Alarm``."""

    robot: str
    source: str
    alarm: int
    component: str
    severity: Severity
    level: Level
    reason: str
    cause: str
    diagnosis: str
    active: bool
    opened_ns: int
    changed_ns: int
    count: int
    store_id: str
    run: int
    seq: int


@dataclass(frozen=True, slots=True)
class HistoryEntry:
    """An entry of an alarm's history; ``who`` is empty for the server itself."""

    at_ns: int
    what: str
    text: str = ""
    who: str = ""


Step: TypeAlias = "tuple[Alarm, Sequence[HistoryEntry]]"
"""An alarm after something happened to it, and what that adds to its history."""


def is_worse(severity: str, than: str) -> bool:
    """Return whether a severity is higher than another; empty text is the lowest."""
    return rank_of(severity) > rank_of(than)


def worst(severities: Sequence[Severity]) -> Severity:
    """Return the highest severity."""
    return max(severities, key=rank_of)


def rank_of(severity: str) -> int:
    """Return the rank of a severity, 0 for the lowest; -1 for empty or unknown text."""
    return SEVERITIES.index(severity) if severity in SEVERITIES else -1


_MOST: Final = 20
"""Causes, and names of failure modes, that are kept."""
_LONG: Final = 500
_FAULT: Final = re.compile(r"[^\s#()]+#[^\s#()]+")
"""A failure mode, as robots name a cause."""


@dataclass(frozen=True, slots=True)
class AlarmExplanation:
    """The explanation of a revision of a robot's diagnosis, for the alarms of that diagnosis."""

    robot: str
    diagnosis: str
    revision: int
    effect: Severity | Literal[""]
    words: Words


def explanation_of(robot: str, answer: Mapping[str, Any]) -> AlarmExplanation | None:
    """Return the explanation in an answer of ``POST .../diagnose``; None if it has none."""
    explanation = answer.get("explanation")
    if explanation is None:
        return None
    broken, severity = explanation["broken"], explanation["use"]["severity"]
    members = broken["members"] if broken else ()
    causes = [
        LeadingCause(_cut(one["text"]), kind_of(ids), ids)
        for one in members[:_MOST]
        for ids in ([fault["id"] for fault in one["faults"]],)
    ]
    groups = [*([broken] if broken else ()), *explanation["others"]]
    faults = [f for group in groups for one in group["members"] for f in one["faults"]]
    names = {fault["id"]: _cut(fault["text"]) for fault in faults[:_MOST]}
    effect: Severity | Literal[""] = severity if severity in SEVERITIES else ""
    words = Words(causes, explanation["sure"]["probability"], names)
    return AlarmExplanation(robot, answer["id"], answer["revision"], effect, words)


def encode_words(words: Words) -> str:
    """Return the words of an explanation as JSON, as the database stores them."""
    return msgspec.json.encode(words).decode()


def decode_words(text: str) -> Words | None:
    """Read what ``encode_words`` wrote; None for empty text."""
    return msgspec.json.decode(text, type=Words) if text else None


def kind_of(ids: Sequence[str]) -> CauseKind:
    """Return the kind of a set of failure modes; the empty set is a false alarm."""
    if not ids:
        return "false_alarm"
    return "other" if list(ids) == [UNKNOWN_FAULT] else "fault"


def _cut(text: str) -> str:
    return text.replace("\0", "")[:_LONG]
