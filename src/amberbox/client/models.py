"""What a server answers, typed. Times are RFC 3339 texts: ``times.time_ns`` makes them numbers.

What a newer server says beyond this is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

Value = bool | int | float | str | None


def _json_name(name: str) -> str:
    return name.removesuffix("_")


class Answer(msgspec.Struct, frozen=True, kw_only=True, rename=_json_name):
    """A part of an answer; ``from_`` is ``from`` in JSON."""


class Battery(Answer, frozen=True):
    """Charge of the battery, as an output of its component says."""

    output: str
    value: float


class OnMission(Answer, frozen=True):
    """The mission that a robot is on."""

    id: str
    name: str
    since: str | None = None


class Lead(Answer, frozen=True):
    """The first answer of a robot's newest open diagnosis."""

    id: str
    faults: tuple[str, ...]
    probability: float
    at: str | None = None


class RobotStatus(Answer, frozen=True):
    """The one status of a robot, as the server makes it of everything that it knows.

    ``level`` is ``unknown`` where nothing is known of now; then ``last_level`` is what it was at
    ``as_of``. ``severity`` is what it can still do, ``text`` a sentence, ``reason`` what is worst.
    The higher ``rank``, the worse.
    """

    level: str
    last_level: str = "unknown"
    severity: str = ""
    text: str = ""
    reason: str = ""
    as_of: str | None = None
    contact: str = ""
    monitoring: str = ""
    rank: int = 0


class Card(Answer, frozen=True):
    """A robot at a glance; ``level`` is ``unknown`` where nobody can know."""

    robot: str
    groups: tuple[str, ...] = ()
    model: str = ""
    disabled: bool = False
    online: bool = False
    last_seen: str | None = None
    connected_since: str | None = None
    backlog_rows: int = 0
    backlog_bytes: int = 0
    version: str = ""
    config_hash: str = ""
    level: str = "unknown"
    last_level: str = ""
    severity: str = ""
    cause: str = ""
    components: Mapping[str, int] = {}
    alarms: int = 0
    battery: Battery | None = None
    mission: OnMission | None = None
    diagnosis: Lead | None = None
    alarms_over: int = 0
    damaged_files: int = 0
    damaged_new: int = 0
    signing_key: str = ""
    monitoring: str = ""
    monitoring_delay_s: float = 0.0
    status: RobotStatus | None = None


class Output(Answer, frozen=True):
    """An output of a mode, and what is expected of it (empty: nothing)."""

    name: str
    value: Value = None
    type: str = ""
    expected: str = ""
    severity: str = ""
    description: str = ""
    unit: str = ""


class Condition(Answer, frozen=True):
    """How a component or a mode is; ``age_s`` is how old the measurement is."""

    level: str
    state: str
    reason: str = ""
    blocked_by: tuple[str, ...] = ()
    measured: str | None = None
    since: str | None = None
    age_s: float = 0.0
    for_s: float = 0.0


class Mode(Answer, frozen=True):
    """A mode of a component."""

    mode: str
    name: str
    condition: Condition
    outputs: tuple[Output, ...] = ()


class Need(Answer, frozen=True):
    """What a component needs, and how that is."""

    name: str
    component: str
    level: str


class Component(Answer, frozen=True):
    """A component in the tree; ``condition`` is None where nothing was said of it."""

    component: str
    name: str
    depth: int = 0
    description: str = ""
    part_of: str = ""
    needs: tuple[Need, ...] = ()
    needs_rule: str = ""
    recovery_actions: tuple[str, ...] = ()
    condition: Condition | None = None
    modes: tuple[Mode, ...] = ()


class StatusTree(Answer, frozen=True):
    """All components of a robot, and its one status (None: an older server).

    ``silence`` says why nothing counts, ``note`` what is missing.
    """

    robot: str
    online: bool
    silence: str = ""
    note: str = ""
    clock_offset_s: float | None = None
    components: tuple[Component, ...] = ()
    status: RobotStatus | None = None


class Stretch(Answer, frozen=True):
    """From when to when something was so."""

    from_: str
    to: str
    level: str
    state: str
    reason: str = ""
    changes: int = 0


class Lane(Answer, frozen=True):
    """What was of a component, or of a mode of it."""

    component: str
    mode: str
    stretches: tuple[Stretch, ...]


class Timeline(Answer, frozen=True):
    """The lanes of a window; not ``complete`` where there was more than can be shown."""

    from_: str
    to: str
    lanes: tuple[Lane, ...]
    complete: bool = True


class Event(Answer, frozen=True):
    """An event; ``at`` by the robot's clock, ``server_at`` by the server's."""

    at: str | None
    kind: str
    text: str
    server_at: str | None = None
    source: str = ""
    details: str = ""
    aside: str = ""


class DiagnosisLine(Answer, frozen=True):
    """A diagnosis in a list; ``faults`` and ``probability`` are those of the leading answer."""

    id: str
    state: str
    first: str
    last: str
    revisions: int
    faults: tuple[str, ...] = ()
    probability: float | None = None
    config_hash: str = ""


class AuditRow(Answer, frozen=True):
    """A row of the audit log."""

    seq: int
    time: str
    principal: str
    address: str
    action: str
    object: str
    result: str
    details: Mapping[str, Any] = {}
    hash: str = ""
