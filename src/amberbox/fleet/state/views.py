"""How robots are shown over the API. Times are RFC 3339, by the server's clock if it is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from amberbox.core.robotstatus import RobotStatus

Value = bool | int | float | str | None


@dataclass(frozen=True, slots=True)
class Battery:
    """Charge of the battery, as an output of its component says."""

    output: str
    value: float

    @property
    def percent(self) -> float:
        """Return it in percent: an output that is not called so may be a share of 1."""
        is_share = self.value <= 1.0 and "percent" not in self.output.casefold()
        return self.value * 100.0 if is_share else self.value


@dataclass(frozen=True, slots=True)
class OnMission:
    """The mission that a robot is on."""

    id: str
    name: str
    since: str | None


@dataclass(frozen=True, slots=True)
class Lead:
    """The first answer of a robot's newest open diagnosis."""

    id: str
    faults: Sequence[str]
    probability: float
    at: str | None


@dataclass(frozen=True, slots=True)
class Card:
    """A robot at a glance.

    ``status`` is the one status of the robot; ``level`` and ``last_level`` are its own. ``cause``
    says in words what is worst, or why nothing is known. ``alarms`` are those that nobody has said
    anything about yet, of which ``alarms_over`` have stopped; ``severity`` is the highest of those
    that last, also of acknowledged ones. Of its files ``damaged_files`` are set aside as damaged,
    ``damaged_new`` of these in the last 24 hours. ``silent``: its link holds, and three heartbeats
    are missing. ``signing_key`` is ``pending`` or ``refused`` where it signs with another key than
    before that no admin has confirmed: what it says of itself may come from somebody else.
    ``monitoring`` is how its watcher is doing by its link (``running``, ``overloaded``, ``silent``,
    ``absent``; empty where that is not known), ``monitoring_delay_s`` how late that evaluates.
    """

    robot: str
    groups: Sequence[str]
    model: str
    disabled: bool
    online: bool
    last_seen: str | None
    connected_since: str | None
    backlog_rows: int
    backlog_bytes: int
    version: str
    config_hash: str
    level: str
    last_level: str
    severity: str
    cause: str
    components: Mapping[str, int]
    alarms: int
    battery: Battery | None
    mission: OnMission | None
    diagnosis: Lead | None
    status: RobotStatus
    silent: bool = False
    alarms_over: int = 0
    damaged_files: int = 0
    damaged_new: int = 0
    signing_key: Literal["", "pending", "refused"] = ""
    monitoring: str = ""
    monitoring_delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Output:
    """An output of a mode, and what is expected of it (empty: nothing)."""

    name: str
    type: str
    value: Value
    expected: str
    severity: str
    description: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Condition:
    """How a component or a mode is.

    ``age_s`` is how old the measurement is, ``for_s`` how long it has been so when it was made.
    """

    level: str
    state: str
    reason: str
    blocked_by: Sequence[str]
    measured: str | None
    since: str | None
    age_s: float
    for_s: float


@dataclass(frozen=True, slots=True)
class Mode:
    """A mode of a component."""

    mode: str
    name: str
    condition: Condition
    outputs: Sequence[Output]


@dataclass(frozen=True, slots=True)
class Need:
    """What a component needs, and how that is."""

    name: str
    component: str
    level: str


@dataclass(frozen=True, slots=True)
class Component:
    """A component in the tree; ``condition`` is null where nothing was said of it."""

    component: str
    name: str
    depth: int
    description: str
    part_of: str
    needs: Sequence[Need]
    needs_rule: str
    recovery_actions: Sequence[str]
    condition: Condition | None
    modes: Sequence[Mode] = field(default=())


@dataclass(frozen=True, slots=True)
class StatusTree:
    """All components of a robot, and the status of the robot that they are part of.

    ``silence`` says why nothing counts now, ``note`` what is missing.
    """

    robot: str
    online: bool
    silence: str
    note: str
    clock_offset_s: float | None
    components: Sequence[Component]
    status: RobotStatus | None = None
