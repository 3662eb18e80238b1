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
    """All components of a robot; ``silence`` says why nothing counts, ``note`` what is missing."""

    robot: str
    online: bool
    silence: str = ""
    note: str = ""
    clock_offset_s: float | None = None
    components: tuple[Component, ...] = ()


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


class Item(Answer, frozen=True):
    """A data item or child table."""

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first: str | None = None
    last: str | None = None
    rate_hz: float | None = None


class Variable(Answer, frozen=True):
    """A column: ``path`` is where it stands in the message, ``labels`` name its values."""

    name: str
    path: str = ""
    type: str = ""
    unit: str = ""
    labels: Mapping[str, str] = {}


class ItemDetail(Item, frozen=True):
    """An item with its columns; ``chosen`` are those that the robot's black_box.yaml names."""

    stamp: str = ""
    parent: str = ""
    children: tuple[str, ...] = ()
    chosen: tuple[str, ...] = ()
    columns: tuple[Variable, ...] = ()


class Gap(Answer, frozen=True):
    """A range without data, and why; ``count`` is None when nobody can know."""

    item: str
    writer: str
    run: int
    from_: str
    to: str
    reason: str
    kind: str = ""
    count: int | None = None


class Gaps(Answer, frozen=True):
    """What is missing; ``more`` says that the list was cut."""

    gaps: tuple[Gap, ...]
    more: bool = False


class Summary(Answer, frozen=True):
    """Numbers of a variable summed up."""

    name: str
    count: int
    unit: str = ""
    min: float | None = None
    max: float | None = None
    mean: float | None = None


class Summaries(Answer, frozen=True):
    """Sums over a range; if not ``exact``, its edges are right to a thousandth of its length."""

    exact: bool
    variables: tuple[Summary, ...]
    complete_to: str | None = None


class Note(Answer, frozen=True):
    """A remark of somebody."""

    at: str
    who: str
    text: str


class MomentNote(Answer, frozen=True):
    """A remark on a moment of a robot; ``mission`` is empty where it is on no mission."""

    id: int
    at: str
    who: str
    text: str
    mission: str = ""


class Mission(Answer, frozen=True):
    """A mission; ``to`` is None while it lasts, ``origin`` is ``robot`` or ``server``."""

    id: str
    name: str
    origin: str
    from_: str
    to: str | None = None
    outcome: str = ""
    failed: bool = False
    who: str = ""
    parameters: Mapping[str, Any] = {}
    notes: tuple[Note, ...] = ()


class Incident(Answer, frozen=True):
    """A window that is kept; ``state`` is ``open``, ``complete`` or ``released``."""

    id: str
    origin: str
    state: str
    from_: str
    to: str
    reason: str = ""
    who: str = ""
    trigger: str = ""


class Recording(Answer, frozen=True):
    """A journal on the server, or on its way to it; times are None where they are not known."""

    store_id: str
    journal: str
    keeping: str
    sha256: str
    state: str
    integrity: str
    bytes: int
    from_: str | None
    to: str | None
    reason: str = ""
    copied: int = 0
    rows: int = 0
    came: str | None = None
    journal_until: str | None = None
    columns_until: str | None = None


class FetchedJournal(Answer, frozen=True):
    """A journal of a window; ``state`` is empty until it has come."""

    store_id: str
    journal: str
    bytes: int
    state: str = ""


class Fetch(Answer, frozen=True):
    """A window asked of a robot: ``waiting``, ``asked``, ``copying``, ``ready``, ``gone``..."""

    id: str
    robot: str
    item: str
    from_: str
    to: str
    who: str
    state: str
    copied: int = 0
    journals: tuple[FetchedJournal, ...] = ()
    asked: str = ""
    sent: str | None = None
    ended: str | None = None

    @property
    def is_over(self) -> bool:
        """Tell whether nothing more will come of it."""
        return self.state in ("ready", "gone", "cancelled")


class Download(Answer, frozen=True):
    """A file that the server makes; it is there when the state is ``done``."""

    id: str
    owner: str
    state: str
    progress: float
    format: str
    robots: tuple[str, ...] = ()
    items: tuple[str, ...] = ()
    missions: tuple[str, ...] = ()
    file: str | None = None
    bytes: int = 0
    notes: tuple[str, ...] = ()
    error: str = ""
    asked: str = ""
    started: str | None = None
    ended: str | None = None

    @property
    def is_over(self) -> bool:
        """Tell whether it is made, or never will be."""
        return self.state not in ("queued", "running")


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
