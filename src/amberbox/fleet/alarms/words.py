"""What the diagnosis of an alarm says, in words: kept with the alarm, also when it is over."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, TypeAlias

import msgspec

from amberbox.core.sureness import LIKELY
from amberbox.core.types import UNKNOWN_FAULT
from amberbox.monitoring.engine.outputs import SEVERITIES
from amberbox.monitoring.plan import Severity

CauseKind: TypeAlias = Literal["fault", "false_alarm", "other"]
_MOST: Final = 20
"""Causes, and names of failure modes, that are kept."""
_LONG: Final = 500
_FAULT: Final = re.compile(r"[^\s#()]+#[^\s#()]+")
"""A failure mode, as robots name a cause."""


@dataclass(frozen=True, slots=True)
class LeadingCause:
    """What may be broken; ``kind`` tells a failure from none, and from one nobody described.

    ``faults`` are the ids of failure modes that are broken together.
    """

    text: str
    kind: CauseKind = "fault"
    faults: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Words:
    """The leading causes, and the probability that it is one of them.

    ``names`` are failure modes in words, by id.
    """

    causes: Sequence[LeadingCause] = ()
    probability: float = 0.0
    names: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_likely(self) -> bool:
        """Whether it is a described failure, rather than not."""
        described = [cause.kind == "fault" for cause in self.causes]
        return bool(described) and all(described) and self.probability >= LIKELY

    def about(self, cause: str) -> Words:
        """Return these words as far as they are about what a robot names as an alarm's cause.

        An answer of several faults is about several alarms, each of which names its own.
        """
        named = set(_FAULT.findall(cause))
        causes = [self._part(one, named) for one in self.causes]
        return replace(self, causes=list({one.text: one for one in causes}.values()))

    def _part(self, one: LeadingCause, named: Collection[str]) -> LeadingCause:
        ids = [fault for fault in one.faults if fault in named and fault in self.names]
        if not ids or len(ids) == len(one.faults):
            return one
        return LeadingCause(" and ".join(self.names[fault] for fault in ids), one.kind, ids)


@dataclass(frozen=True, slots=True)
class Explanation:
    """What a revision of a robot's diagnosis means for the alarms that it explains."""

    robot: str
    diagnosis: str
    revision: int
    effect: Severity | Literal[""]
    words: Words


def explanation_of(robot: str, answer: Mapping[str, Any]) -> Explanation | None:
    """Read an answer of ``POST .../diagnose``; None for one that explains nothing."""
    told = answer.get("explanation")
    if told is None:
        return None
    broken, severity = told["broken"], told["use"]["severity"]
    members = broken["members"] if broken else ()
    causes = [
        LeadingCause(_cut(one["text"]), kind_of(ids), ids)
        for one in members[:_MOST]
        for ids in ([fault["id"] for fault in one["faults"]],)
    ]
    groups = [*([broken] if broken else ()), *told["others"]]
    faults = [f for group in groups for one in group["members"] for f in one["faults"]]
    names = {fault["id"]: _cut(fault["text"]) for fault in faults[:_MOST]}
    effect: Severity | Literal[""] = severity if severity in SEVERITIES else ""
    words = Words(causes, told["sure"]["probability"], names)
    return Explanation(robot, answer["id"], answer["revision"], effect, words)


def written(words: Words) -> str:
    """Write words as a row keeps them."""
    return msgspec.json.encode(words).decode()


def read(text: str) -> Words | None:
    """Read what ``written`` made; None for nothing."""
    return msgspec.json.decode(text, type=Words) if text else None


def kind_of(ids: Sequence[str]) -> CauseKind:
    """Tell what failure modes that are broken together stand for; none is a false alarm."""
    if not ids:
        return "false_alarm"
    return "other" if list(ids) == [UNKNOWN_FAULT] else "fault"


def _cut(text: str) -> str:
    return text.replace("\0", "")[:_LONG]
