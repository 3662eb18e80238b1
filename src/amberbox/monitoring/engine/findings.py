"""What is found of a robot: statuses, transitions, alarms, symptoms; and what it is found from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Level, Output, Status, Symptom
from amberbox.monitoring.plan import Severity

__all__ = [
    "NS", "TICK_NS", "AlarmChange", "AlarmState", "Condition", "Diagnosis", "Finding", "Found",
    "Level", "Output", "Status", "Symptom", "Transition", "View", "What", "is_live_only",
]  # fmt: skip

TICK_NS = NS // 20
"""Everything happens at multiples of this."""
What: TypeAlias = Literal["ok", "bad", "unknown", "stale"]
AlarmState: TypeAlias = Literal["open", "acknowledged", "shelved", "healed"]


class Found(NamedTuple):
    """What was found of one output at an instant.

    ``output`` is its number in ``states.outputs_of(plan)``. ``reason`` says why it is unknown,
    stale or bad; for bad it may be empty. Changes of bools and texts come as such too, also
    where nothing is expected of them.
    """

    at_ns: int
    output: int
    what: What
    value: Output = None
    reason: str = ""


class View(Protocol):
    """The values of outputs at the instants of a block."""

    def outputs(self, mode: int, at_ns: int) -> Mapping[str, Output]:
        """Return all outputs of a mode (its number in ``plan.modes()``), in order."""


class Condition(NamedTuple):
    """What a mode or component is in: ``error front_laser_working``."""

    level: Level
    state: str


@dataclass(frozen=True, slots=True)
class Transition:
    """A mode or component (``mode`` empty) went from one condition to another.

    ``hint`` is what its outputs say that can be done.
    """

    robot: str
    component: str
    mode: str
    before: Condition
    after: Condition
    at_ns: int
    reason: str
    blocked_by: tuple[str, ...]
    hint: str
    config_hash: str
    live_only: bool = False

    @property
    def text(self) -> str:
        """The transition in one line: ``laser: nominal -> front_laser_working: ...``."""
        name = f"{self.component}/{self.mode}" if self.mode else self.component
        before, after = self._named(self.before, self.after), self._named(self.after, self.before)
        line = f"{name}: {before} -> {after}"
        return f"{line}: {self.reason}" if self.reason else line

    @staticmethod
    def _named(one: Condition, other: Condition) -> str:
        return one.state if one.state != other.state else f"{one.state} ({one.level})"


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """An alarm as it is after a change.

    ``count`` is how often it has opened. ``who`` acknowledged or shelved it, ``until_ns`` is when
    a shelved one comes back. ``cause`` is the leading answer of the ``diagnosis`` (its id) that
    the component is part of, both empty while there is none. ``also`` are components whose own
    alarms are part of this one, since they have the same leading cause.
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


Finding: TypeAlias = "Status | Transition | AlarmChange | Symptom | Diagnosis"
"""The engine finds all but diagnoses: these are made of what it finds."""


def is_live_only(finding: Finding) -> bool:
    """Tell whether a replay of the record cannot find it too."""
    return not isinstance(finding, Symptom) and finding.live_only
