"""Answers of the server's API: one set of types, for the server and for the client.

The server answers with them, and OpenAPI is made of them; the client reads answers into types that
it makes of them (``client.models``). Times are RFC 3339. A field whose name is a word of Python
ends in an underscore: ``from_`` is ``from`` in JSON.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Annotated, Any, ClassVar, Final, Literal, TypeAlias

from amberbox.core.command import FINAL, Risk
from amberbox.core.robot_status import RobotStatus, Severity
from amberbox.core.types import Later, Missing
from amberbox.core.units import LIKELY

Value: TypeAlias = bool | int | float | str | None
Origin: TypeAlias = Literal["robot", "server"]
Integrity: TypeAlias = Literal["intact", "altered", "missing", "deleted", "unsigned", "unknown"]
RecordingState: TypeAlias = Literal[
    "copying", "waiting", "in_columns", "refused", "quarantined", "aside"
]
GapKind: TypeAlias = Literal[
    "to_come", "waiting", "refused", "deleted", "filtered", "lost", "uncovered"
]
FetchState: TypeAlias = Literal["waiting", "asked", "copying", "ready", "gone", "cancelled"]
DownloadState: TypeAlias = Literal["queued", "running", "done", "failed", "cancelled", "expired"]
DownloadFormat: TypeAlias = Literal["csv", "parquet", "mcap", "journals"]
ModelState: TypeAlias = Literal["queued", "running", "done", "failed", "cancelled"]
AlarmKind: TypeAlias = Literal["robot", "offline"]
AlarmState: TypeAlias = Literal["open", "acknowledged", "shelved", "resolved"]
CauseKind: TypeAlias = Literal["fault", "false_alarm", "other"]

_FAULT: Final = re.compile(r"[^\s#()]+#[^\s#()]+")
"""A failure mode, as robots name a cause."""


def json_name(name: str) -> str:
    """Return the JSON key of a field."""
    return name.removesuffix("_")


def to_json(value: Any) -> Any:
    """Convert an answer, or a collection of answers, to JSON-compatible values."""
    if is_dataclass(value):
        return {json_name(f.name): to_json(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_json(inner) for key, inner in value.items()}
    return [to_json(inner) for inner in value] if isinstance(value, list | tuple) else value


class _Answer:
    """A part of an answer."""

    __slots__ = ()
    # pydantic reads this where there is pydantic: on the server
    __pydantic_config__: ClassVar[Mapping[str, Any]] = {
        "alias_generator": json_name, "populate_by_name": True,
    }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Battery(_Answer):
    """Charge of the battery, as an output of its component says."""

    output: str
    value: float

    @property
    def percent(self) -> float:
        """Return it in percent: an output that is not called so may be a share of 1."""
        is_share = self.value <= 1.0 and "percent" not in self.output.casefold()
        return self.value * 100.0 if is_share else self.value


@dataclass(frozen=True, slots=True)
class OnMission(_Answer):
    """The mission that a robot is on."""

    id: str
    name: str
    since: Later[str | None]


@dataclass(frozen=True, slots=True)
class Lead(_Answer):
    """The first answer of a robot's newest open diagnosis."""

    id: str
    faults: Sequence[str]
    probability: float
    at: Later[str | None]


@dataclass(frozen=True, slots=True)
class Card(_Answer):
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
    groups: Later[Sequence[str]]
    model: Later[str]
    disabled: Later[bool]
    online: Later[bool]
    last_seen: Later[str | None]
    connected_since: Later[str | None]
    backlog_rows: Later[int]
    backlog_bytes: Later[int]
    version: Later[str]
    config_hash: Later[str]
    level: Annotated[str, Missing("unknown")]
    last_level: Later[str]
    severity: Later[str]
    cause: Later[str]
    components: Later[Mapping[str, int]]
    alarms: Later[int]
    battery: Later[Battery | None]
    mission: Later[OnMission | None]
    diagnosis: Later[Lead | None]
    status: Annotated[RobotStatus, Missing(None)]
    silent: bool = False
    alarms_over: int = 0
    damaged_files: int = 0
    damaged_new: int = 0
    signing_key: Literal["", "pending", "refused"] = ""
    monitoring: str = ""
    monitoring_delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Output(_Answer):
    """An output of a mode, and what is expected of it (empty: nothing)."""

    name: str
    type: Later[str]
    value: Annotated[Value, Missing(None)]
    expected: Later[str]
    severity: Later[str]
    description: Later[str]
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Condition(_Answer):
    """How a component or a mode is.

    ``age_s`` is how old the measurement is, ``for_s`` how long it has been so when it was made.
    """

    level: str
    state: str
    reason: Later[str]
    blocked_by: Later[Sequence[str]]
    measured: Later[str | None]
    since: Later[str | None]
    age_s: Later[float]
    for_s: Later[float]


@dataclass(frozen=True, slots=True)
class Mode(_Answer):
    """A mode of a component."""

    mode: str
    name: str
    condition: Condition
    outputs: Later[Sequence[Output]]


@dataclass(frozen=True, slots=True)
class Need(_Answer):
    """What a component needs, and how that is."""

    name: str
    component: str
    level: str


@dataclass(frozen=True, slots=True)
class Component(_Answer):
    """A component in the tree; ``condition`` is null where nothing was said of it."""

    component: str
    name: str
    depth: Later[int]
    description: Later[str]
    part_of: Later[str]
    needs: Later[Sequence[Need]]
    needs_rule: Later[str]
    recovery_actions: Later[Sequence[str]]
    condition: Later[Condition | None]
    modes: Sequence[Mode] = ()


@dataclass(frozen=True, slots=True)
class StatusTree(_Answer):
    """All components of a robot, and the status of the robot that they are part of.

    ``silence`` says why nothing counts now, ``note`` what is missing.
    """

    robot: str
    online: bool
    silence: Later[str]
    note: Later[str]
    clock_offset_s: Later[float | None]
    components: Later[Sequence[Component]]
    status: RobotStatus | None = None


@dataclass(frozen=True, slots=True)
class Stretch(_Answer):
    """From when to when something was so, by the robot's clock.

    ``changes`` counts the changes within it where short stretches were joined: then ``level`` and
    ``state`` are the worst of them.
    """

    from_: str
    to: str
    level: str
    state: str
    reason: Later[str]
    changes: Later[int]


@dataclass(frozen=True, slots=True)
class Lane(_Answer):
    """What was of a component, or of a mode of it."""

    component: str
    mode: str
    stretches: Sequence[Stretch]


@dataclass(frozen=True, slots=True)
class Timeline(_Answer):
    """The lanes of a window; not ``complete`` where there was more than can be shown."""

    from_: str
    to: str
    complete: Annotated[bool, Missing(True)]
    lanes: Sequence[Lane]


@dataclass(frozen=True, slots=True)
class Event(_Answer):
    """An event; ``at`` by the robot's clock, ``server_at`` by the server's where it is known.

    Store, writer, run and number are its place; ``aside`` says why it is not in the robot's record
    any more.
    """

    at: str | None
    server_at: Later[str | None]
    kind: str
    text: str
    source: Later[str]
    details: Later[str]
    store_id: Later[str]
    writer: Later[str]
    run: Later[int]
    seq: Later[int]
    aside: Later[str]


@dataclass(frozen=True, slots=True)
class Item(_Answer):
    """A data item or child table; ``source`` is ``amberbox`` for what the box says of itself.

    ``first`` and ``last`` are when its first and its last row was received. ``no_columns`` says why
    its messages are there only as they came; empty for an item with columns.
    """

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first: Later[str | None]
    last: Later[str | None]
    rate_hz: Later[float | None]
    no_columns: str = ""


@dataclass(frozen=True, slots=True)
class Variable(_Answer):
    """A column: ``path`` is where it stands in the message, ``labels`` name its values."""

    name: str
    path: Later[str]
    type: Later[str]
    unit: Later[str]
    labels: Later[Mapping[str, str]]


@dataclass(frozen=True, slots=True)
class ItemDetail(_Answer):
    """An item with its columns.

    ``stamp`` is the path of its own time stamp, ``chosen`` are the variables that the robot's
    ``black_box.yaml`` names, ``children`` the tables of lists in its messages.
    """

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first: Later[str | None]
    last: Later[str | None]
    rate_hz: Later[float | None]
    stamp: Later[str]
    parent: Later[str]
    children: Later[Sequence[str]]
    chosen: Later[Sequence[str]]
    columns: Later[Sequence[Variable]]
    no_columns: str = ""


@dataclass(frozen=True, slots=True)
class Summary(_Answer):
    """Numbers of a variable summed up; NaN and missing values do not count.

    If the sums are not ``exact``, the histogram counts the means of short steps.
    """

    name: str
    unit: Later[str]
    count: int
    min: Later[float | None]
    max: Later[float | None]
    mean: Later[float | None]
    histogram: Later[Histogram | None]


@dataclass(frozen=True, slots=True)
class Summaries(_Answer):
    """Sums over a range; if not ``exact``, its edges are right to a thousandth of its length."""

    exact: bool
    complete_to: Later[str | None]
    variables: Sequence[Summary]


@dataclass(frozen=True, slots=True)
class Histogram(_Answer):
    """How many values lie in each bar; of bar ``n`` the ends are ``edges[n]``, ``edges[n + 1]``."""

    edges: Sequence[float]
    counts: Sequence[int]


@dataclass(frozen=True, slots=True)
class Gap(_Answer):
    """A range without data, and why; ``count`` is None when nobody can know.

    ``kind``: ``to_come`` (the robot has it), ``waiting`` (the server has it, and has not read it
    in yet), ``refused`` (the server has the file, and set it aside as damaged), ``deleted``,
    ``filtered`` (the value did not change), ``lost``, ``uncovered`` (nothing was recorded).
    ``publisher`` is the one that was not heard; others of the item may have been.
    """

    item: str
    writer: str
    run: int
    from_: str
    to: str
    kind: Later[GapKind]
    reason: str
    count: Later[int | None]
    publisher: str = ""


@dataclass(frozen=True, slots=True)
class Gaps(_Answer):
    """What is missing, in order of time; ``more`` says that the list was cut."""

    gaps: Sequence[Gap]
    more: Later[bool]


@dataclass(frozen=True, slots=True)
class Note(_Answer):
    """A remark of somebody."""

    at: str
    who: str
    text: str


@dataclass(frozen=True, slots=True)
class MomentNote(_Answer):
    """A note on a moment, or until ``to``; ``mission`` is empty where it is on no mission.

    ``note`` is the id that the robot's record has as well, ``about`` an item, a variable or a
    component.
    """

    id: int
    at: str
    who: str
    text: str
    mission: Later[str]
    note: Later[str]
    to: Later[str | None]
    about: Later[str]
    revision: Later[int]


@dataclass(frozen=True, slots=True)
class Mission(_Answer):
    """A mission; ``to`` is null while it lasts, ``origin`` says who began it."""

    id: str
    name: str
    origin: Origin
    from_: str
    to: Later[str | None]
    outcome: Later[str]
    failed: Later[bool]
    who: Later[str]
    parameters: Later[Mapping[str, Any]]
    notes: Later[Sequence[Note]]


@dataclass(frozen=True, slots=True)
class Incident(_Answer):
    """A window that is kept; ``state`` is ``open``, ``complete`` or ``released``.

    ``on_robot`` is what the robot does with one that was marked on the server: ``asked``,
    ``pinned``, ``released``, or why it does not; empty where it takes no commands.
    """

    id: str
    origin: Origin
    state: str
    reason: Later[str]
    who: Later[str]
    trigger: Later[str]
    from_: str
    to: str
    on_robot: Later[str] = ""


@dataclass(frozen=True, slots=True)
class Recording(_Answer):
    """A journal on the server, or on its way to it.

    ``state``: ``copying`` (``copied`` of ``bytes``), ``waiting`` for its columns, ``in_columns``,
    ``refused``, ``quarantined``, or ``aside``: sound, but of another history of the same store.
    ``integrity``: ``intact``, ``unsigned`` (holds, but the robot has signed no head behind it yet),
    ``altered``, ``missing``, ``deleted`` by retention, ``unknown`` while it is copied.
    ``from`` and ``to`` are null where they are not known: while it is copied, of what is damaged.
    ``journal_until`` and ``columns_until`` are when retention may take them; null is never.
    """

    store_id: str
    journal: str
    keeping: str
    sha256: str
    state: RecordingState
    integrity: Integrity
    reason: Later[str]
    bytes: int
    copied: Later[int]
    rows: Later[int]
    from_: str | None
    to: str | None
    came: Later[str | None]
    journal_until: Later[str | None]
    columns_until: Later[str | None]


@dataclass(frozen=True, slots=True)
class FetchedJournal(_Answer):
    """A journal of the window; ``state`` is empty until it has come, ``late`` when it did not."""

    store_id: str
    journal: str
    bytes: int
    state: Later[str]


@dataclass(frozen=True, slots=True)
class Fetch(_Answer):
    """What was asked of a robot.

    ``state``: ``waiting`` for the robot, ``asked``, ``copying`` (``copied`` of ``journals``),
    ``ready``, ``gone`` when nothing of it comes (any more), ``cancelled``. ``reason`` says why
    journals did not come that the robot had named.
    """

    id: str
    robot: str
    item: str
    from_: str
    to: str
    who: str
    state: FetchState
    reason: Later[str]
    copied: Later[int]
    journals: Later[Sequence[FetchedJournal]]
    asked: Later[str]
    sent: Later[str | None]
    ended: Later[str | None]

    @property
    def is_over(self) -> bool:
        """Return whether the fetch has ended: ready, gone or cancelled."""
        return self.state in ("ready", "gone", "cancelled")


@dataclass(frozen=True, slots=True)
class Download(_Answer):
    """A download; ``progress`` goes from 0 to 1, ``file`` is there when the state is ``done``."""

    id: str
    owner: str
    state: DownloadState
    progress: float
    robots: Later[Sequence[str]]
    items: Later[Sequence[str]]
    missions: Later[Sequence[str]]
    format: DownloadFormat
    file: Later[str | None]
    bytes: Later[int]
    notes: Later[Sequence[str]]
    error: Later[str]
    asked: Later[str]
    started: Later[str | None]
    ended: Later[str | None]

    @property
    def is_over(self) -> bool:
        """Return whether the download is no longer queued or running."""
        return self.state not in ("queued", "running")


@dataclass(frozen=True, slots=True)
class ModelLine(_Answer):
    """A file of a robot's ``models/``; ``kind`` is empty where it is no model.

    ``problems`` are its errors: with one it answers nothing.
    """

    name: str
    kind: Literal["components", "equations", ""]
    problems: Sequence[str]


@dataclass(frozen=True, slots=True)
class LearntModel(_Answer):
    """A model of detectors that the server learns, or has learnt; each ``version`` of a name once.

    Of a ``team`` the robots are learnt side by side.

    ``progress`` goes from 0 to 1; ``file``, ``sha256`` and ``report`` are there when the state is
    ``done``. ``report`` says what can be promised, a sentence each, and what was left out.
    """

    id: str
    name: str
    version: int
    owner: str
    state: ModelState
    progress: float
    robots: Later[Sequence[str]]
    missions: Later[Sequence[str]]
    from_: Later[str | None]
    to: Later[str | None]
    detectors: Later[Sequence[str]]
    team: Later[bool]
    false_alarms_per_hour: Later[float]
    file: Later[str | None]
    bytes: Later[int]
    sha256: Later[str]
    report: Later[Sequence[str]]
    error: Later[str]
    asked: Later[str]
    started: Later[str | None]
    ended: Later[str | None]

    @property
    def is_over(self) -> bool:
        """Return whether the model is no longer queued or being learnt."""
        return self.state not in ("queued", "running")


@dataclass(frozen=True, slots=True)
class DetectorAlarmLine(_Answer):
    """An alarm that a model of detectors raises on what a robot recorded.

    ``robot`` is empty for one of a team; ``gone`` is null if it lasts to the end of the range.
    ``contributions`` are shares of variables or events.
    """

    robot: str
    id: str
    detector: str
    series: str
    onset: str
    confirmed: str
    gone: str | None
    score: float
    threshold: float
    p_value: float
    baseline: str
    reason: str
    contributions: Mapping[str, float]
    transitions: Sequence[str]


@dataclass(frozen=True, slots=True)
class FollowingModel(_Answer):
    """A model of a team that follows its robots, since ``from``: the records are done up to
    ``to``, as far as all robots have handed theirs in.

    ``alarms`` are the newest ones, oldest first; ``gone`` of one is null while it lasts. ``error``
    says why the model does not go on.
    """

    id: str
    from_: str
    to: str
    error: str
    alarms: Sequence[DetectorAlarmLine]


@dataclass(frozen=True, slots=True)
class DiagnosisLine(_Answer):
    """A diagnosis in a list; ``faults`` and ``probability`` are those of the leading hypothesis.

    ``first`` and ``last`` are when its first and its last revision was made.
    """

    id: str
    state: Literal["open", "healed"]
    first: str
    last: str
    revisions: int
    faults: Later[Sequence[str]]
    probability: Later[float | None]
    config_hash: Later[str]


@dataclass(frozen=True, slots=True)
class LeadingCause(_Answer):
    """What may be broken; ``kind`` tells a failure from none, and from one nobody described.

    ``faults`` are the ids of failure modes that are broken together.
    """

    text: str
    kind: CauseKind = "fault"
    faults: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Words(_Answer):
    """The leading causes, and the probability that it is one of them.

    ``names`` are failure modes in words, by id.
    """

    causes: Sequence[LeadingCause] = ()
    probability: float = 0.0
    names: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_likely(self) -> bool:
        """Return whether a described failure is more probable than not."""
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
class AlarmRobot(_Answer):
    """A robot that an alarm is about; ``to`` is null while it lasts."""

    robot: str
    from_: str
    to: Later[str | None]


@dataclass(frozen=True, slots=True)
class Said(_Answer):
    """What somebody said, and when; ``until`` of what is shelved."""

    who: str
    at: Later[str | None]
    until: str | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Window(_Answer):
    """Where its data are: query or fetch them from the robot between these times."""

    robot: str
    from_: str
    to: Later[str | None]


@dataclass(frozen=True, slots=True)
class AlarmLine(_Answer):
    """An alarm. ``active`` is whether it lasts, ``state`` what people made of it.

    ``diagnosis_revision`` was the last while it lasted (0: not known), ``explained`` what that
    says in words, null where nobody has worked that out.
    """

    id: int
    kind: AlarmKind
    robots: Sequence[AlarmRobot]
    origin: str
    severity: Severity
    level: str
    state: AlarmState
    active: bool
    reason: str
    cause: Later[str]
    diagnosis: Later[str]
    opened: str
    changed: str
    cleared: Later[str | None]
    count: int
    late: Later[bool]
    owner: Later[str]
    acknowledged: Later[Said | None]
    shelved: Later[Said | None]
    resolved: Later[Said | None]
    merged_into: Later[int | None]
    window: Window
    revision: int
    diagnosis_revision: int = 0
    explained: Words | None = None


@dataclass(frozen=True, slots=True)
class Consequence(_Answer):
    """A component that suffers from the root of the alarm; ``to`` is null while it does."""

    component: str
    level: str
    reason: str
    from_: str
    to: Later[str | None]


@dataclass(frozen=True, slots=True)
class Happening(_Answer):
    """A line of the history; ``who`` is empty for the server itself."""

    at: str
    who: str
    what: str
    text: Later[str]


@dataclass(frozen=True, slots=True)
class AlarmPage(_Answer):
    """All that is known of an alarm."""

    alarm: AlarmLine
    consequences: Later[Sequence[Consequence]]
    history: Later[Sequence[Happening]]


@dataclass(frozen=True, slots=True)
class AuditRow(_Answer):
    """A row of the log; ``hash`` ties it to the row before."""

    seq: int
    time: str
    principal: str
    address: str
    action: str
    object: str
    result: str
    details: Later[Mapping[str, Any]]
    hash: Later[str]


CommandState: TypeAlias = Literal[
    "unsigned", "withdrawn", "waiting", "sent", "accepted", "refused", "done", "failed", "aborted",
    "outcome_unknown", "expired",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class AnswerLine(_Answer):
    """What a robot says of a command; ``at`` by its own clock, ``result`` is JSON text."""

    state: str
    reason: str
    result: str
    at: str
    received: str


@dataclass(frozen=True, slots=True)
class CommandLine(_Answer):
    """A command to a robot, and what became of it.

    ``parameters`` is the JSON text of an object, as it is signed. ``key_id`` is that of the key
    that signed it. ``state``: ``unsigned`` and ``withdrawn`` are states on the server, ``waiting``
    is one that was not sent yet, ``sent`` one without an answer; all others are what the robot
    answered, or ``expired``. ``number`` is for ``after``.
    """

    number: int
    id: str
    robot: str
    action: str
    parameters: str
    risk: Risk
    issuer: str
    run: str
    step: str
    key_id: str
    state: CommandState
    reason: str
    created: str
    expires: str
    sent: Later[str | None]
    answered: Later[str | None]
    answers: Later[Sequence[AnswerLine]]

    @property
    def is_over(self) -> bool:
        """Return whether nothing more comes."""
        return self.state == "withdrawn" or self.state in FINAL


@dataclass(frozen=True, slots=True)
class RobotLease(_Answer):
    """Who holds a robot; free without a ``holder``. ``number`` is what commands are signed for."""

    number: int
    holder: str
    run: str


@dataclass(frozen=True, slots=True)
class ActionParameter(_Answer):
    """A parameter of an action; without a ``default`` it is required."""

    name: str
    type: str
    unit: str
    min: Later[float | None]
    max: Later[float | None]
    choices: Later[Sequence[Value]]
    default: Annotated[Value, Missing(None)]
    description: str
    max_length: Later[int | None]


@dataclass(frozen=True, slots=True)
class RobotAction(_Answer):
    """An action that a robot has announced; ``recovers`` are failure modes it is a remedy of."""

    name: str
    risk: Risk
    description: str
    timeout_s: float
    simulated: bool
    parameters: Later[Sequence[ActionParameter]]
    recovers: Later[Sequence[str]]


@dataclass(frozen=True, slots=True)
class RobotCommands(_Answer):
    """How commands reach a robot now, and what it can do.

    ``takes_commands``: it is connected and has minted a challenge. ``server_id`` is what its trust
    file names. ``waiting`` is the id of the motion that waits for its confirmation at the robot,
    ``by_code`` whether a code is shown there for it, ``tries`` how many wrong ones were entered.
    ``challenge`` (hexadecimal, newest) is only for who may command. ``announced`` is when it sent
    its actions, ``left_out`` how many of them are not shown here.
    """

    robot: str
    online: bool
    takes_commands: bool
    server_id: str
    lease: RobotLease
    waiting: str
    by_code: bool
    tries: int
    challenge: str
    actions: Later[Sequence[RobotAction]]
    announced: Later[str | None]
    left_out: int = 0


@dataclass(frozen=True, slots=True)
class AbortReport(_Answer):
    """What an abort has reached: whether the robot got it, and commands that are not sent now."""

    delivered: bool
    withdrawn: Later[Sequence[str]]


@dataclass(frozen=True, slots=True)
class RevokedKeyLine(_Answer):
    """A person's key that signs nothing any more."""

    key_id: str
    who: str
    reason: str
    at: str


RunState: TypeAlias = Literal[
    "planned", "running", "paused", "stopping", "judging", "passed", "failed", "undecided",
    "aborted", "error",
]  # fmt: skip
RunRole: TypeAlias = Literal["technician", "operator"]


@dataclass(frozen=True, slots=True)
class ExperimentLine(_Answer):
    """An experiment that can be run on a robot; one with ``problems`` cannot.

    ``robot`` is that whose folder has it, empty for an uploaded one, of which ``who`` and ``added``
    tell. ``roles`` are those of the people who take part, ``about`` the failure modes that its
    verdict speaks of, ``sha256`` is over all its files.
    """

    name: str
    title: str
    description: str
    safety: str
    duration_s: float | None
    robot: str
    sha256: str
    roles: Later[Sequence[RunRole]]
    parameters: Later[Sequence[ActionParameter]]
    about: Later[Sequence[str]]
    problems: Later[Sequence[str]]
    who: str = ""
    added: Later[str | None] = None


@dataclass(frozen=True, slots=True)
class UnitTestLine(_Answer):
    """A unit test that a robot has announced; ``about`` are failure modes that it speaks of."""

    name: str
    description: str
    risk: Risk
    timeout_s: float
    about: Later[Sequence[str]]


@dataclass(frozen=True, slots=True)
class RunLine(_Answer):
    """A run of an experiment, or of a unit test.

    ``planned`` is one that has not begun, ``stopping`` one that is over while the robot still
    stops, ``judging`` one whose record has not come yet, ``undecided`` one whose record does not
    tell.
    ``series`` is the id of the first of runs that repeat each other, of which ``left`` follow.
    ``test`` is the test of the ``diagnosis`` that its verdict answers, ``version`` that of the
    robot's own software. ``number`` is for ``after``. A run ``at_robot`` was carried out there
    alone, and came with its record.
    """

    number: int
    id: str
    robot: str
    kind: Literal["experiment", "unit_test"]
    name: str
    title: str
    sha256: str
    state: RunState
    reason: str
    who: str
    series: str
    left: int
    diagnosis: str
    test: str
    version: str
    created: str
    begun: Later[str | None]
    ended: Later[str | None]
    at_robot: Later[bool] = False

    @property
    def is_over(self) -> bool:
        """Return whether nothing more comes."""
        return self.state in ("passed", "failed", "undecided", "aborted", "error")


@dataclass(frozen=True, slots=True)
class FormField(_Answer):
    """A field of a step; ``kind``: ``pass_fail``, ``confirm``, ``number``, ``choice``, ``text``."""

    name: str
    kind: str
    label: str
    unit: str
    min: Later[float | None]
    max: Later[float | None]
    choices: Later[Sequence[str]]
    required: bool


@dataclass(frozen=True, slots=True)
class PersonStep(_Answer):
    """A step that waits for a person of a role, or of a higher one; ``mine``: the caller may."""

    task: str
    element: str
    name: str
    role: str
    lane: str
    text: str
    expected: str
    deviation: str
    picture: str
    since: str
    mine: bool
    fields: Later[Sequence[FormField]]


@dataclass(frozen=True, slots=True)
class RobotStep(_Answer):
    """A step that the robot carries out, or is to: ``waits`` is what it waits for.

    ``command`` is empty before it was given; its state is that of ``CommandLine``. ``confirm``: its
    motion waits for the code that is shown at the robot. ``report`` is the last it has said.
    """

    task: str
    element: str
    name: str
    action: str
    parameters: Later[Mapping[str, Value]]
    since: str
    waits: str
    command: str
    state: str
    confirm: bool
    report: str


@dataclass(frozen=True, slots=True)
class RunHappening(_Answer):
    """Something that happened in a run."""

    number: int
    at: str
    kind: str
    element: str
    name: str
    task: str
    who: str
    text: str
    values: Later[Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Present(_Answer):
    """A person who is there for a run."""

    role: RunRole
    who: str


@dataclass(frozen=True, slots=True)
class RunDetail(_Answer):
    """A run with what waits now and all that has happened; ``verdict`` is that of its record."""

    run: RunLine
    parameters: Later[Mapping[str, Value]]
    people: Later[Sequence[PersonStep]]
    robot: Later[Sequence[RobotStep]]
    present: Later[Sequence[Present]]
    needs: Later[Sequence[RunRole]]
    holder: str
    events: Later[Sequence[RunHappening]]
    verdict: Later[Mapping[str, Any]]
