"""An alarm as it stands, and what it is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from amberbox.core.types import Level
from amberbox.monitoring.engine.outputs import SEVERITIES
from amberbox.monitoring.plan import Severity

Kind: TypeAlias = Literal["robot", "offline"]
State: TypeAlias = Literal["open", "acknowledged", "shelved", "resolved"]


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm; ``number`` is its id, which stays whatever becomes of it.

    ``origin`` is the component that it comes from, or what offline robots share. ``active`` says
    whether what it is about lasts, ``state`` what people made of it; neither decides the other.
    ``late`` is one that was told long after it happened. ``told`` is the highest severity that was
    notified, ``notify_ns`` when the next notification is due. ``revision`` counts what people
    should know before they change it.

    ``revised`` is the revision of its diagnosis that was last while it lasted (0: none is known),
    ``effect`` the severity by that, ``words`` what that says, as ``Words`` writes it. ``severity``
    is that of the effect where there is one, else the worst that the robot's monitors said.
    ``worst`` is the highest it has had, empty if that is ``severity``.
    """

    number: int
    kind: Kind
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
    state: State = "open"
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
class Part:
    """An alarm of a robot (``source`` is its id there), which is all or a part of one of ours."""

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
class Entry:
    """A line of an alarm's history; ``who`` is empty for the server itself."""

    at_ns: int
    what: str
    text: str = ""
    who: str = ""


Step: TypeAlias = "tuple[Alarm, Sequence[Entry]]"
"""An alarm after something happened to it, and what that adds to its history."""


def is_worse(severity: str, than: str) -> bool:
    """Tell whether a severity is higher than another; any is higher than none."""
    return rank_of(severity) > rank_of(than)


def worst(severities: Sequence[Severity]) -> Severity:
    """Return the highest severity."""
    return max(severities, key=rank_of)


def rank_of(severity: str) -> int:
    """Tell how high a severity is; none, and a word that is none, come before all."""
    return SEVERITIES.index(severity) if severity in SEVERITIES else -1
