"""Types shared by all parts: topics and schemas, batches, gaps, cursors, statuses, diagnoses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

IntArray: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Missing:
    """Marks a field of an API answer that older servers do not send, with its value in
    that case.
    """

    default: Any = None


_T = TypeVar("_T")
Later: TypeAlias = Annotated[_T, Missing()]
"""A field that older servers do not send: for the client it is then None, zero or empty."""


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition as the source gave it (the fields of an MCAP schema).

    ``encoding`` is ``ros1msg``, ``ros2msg``, ``ros2idl``, ``protobuf``, ``jsonschema`` or another
    MCAP name, or ``amberbox_layout`` (``blackbox.columns.frame_layout``).
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream as a source found it on its bus.

    ``message_encoding`` is MCAP's: ``ros1``, ``cdr``, ``protobuf``, ``json``, ``msgpack``, or
    ``frame`` for the raw frames of a bus. For ``json`` and ``msgpack`` the schema may be None: the
    recorder infers it and widens it when it must.
    """

    name: str
    message_encoding: str
    schema: Schema | None = None
    latched: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Ragged:
    """A list column: row ``i`` is ``values[offsets[i]:offsets[i + 1]]``.

    ``offsets`` has one more entry than there are rows.
    """

    offsets: IntArray
    values: NDArray[Any]

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, row: int) -> NDArray[Any]:
        return self.values[self.offsets[row] : self.offsets[row + 1]]


# Numbers and bools as their own dtype; strings as object arrays of ``str``, binary as object
# arrays of ``bytes``; time and duration as int64 nanoseconds. A column with nulls is a numpy
# masked array (numbers) or holds None (objects). NaN is a value, not a null.
ColumnData: TypeAlias = "NDArray[Any] | Ragged"


@dataclass(frozen=True, slots=True)
class Column:
    """A flat column: its name, its path in the message, and its type.

    ``type`` is one of bool, int8..int64, uint8..uint64, float32, float64, string, binary, time,
    duration, or ``list<...>`` of one of these. ``labels`` are the message's constants for it.
    """

    name: str
    path: str
    type: str
    unit: str = ""
    labels: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ItemSchema:
    """The columns of a data item, and of its child tables by their path.

    ``stamp`` is the path of the item's own time stamp (``header/stamp``), empty if it has none:
    then ``timestamp`` is the time of receipt.
    """

    type: str
    columns: tuple[Column, ...]
    children: Mapping[str, ItemSchema] = field(default_factory=dict)
    stamp: str = ""


class Position(NamedTuple):
    """The position of a record: ``seq`` counts without holes within a writer's run."""

    store_id: str
    writer: str
    run: int
    seq: int


@dataclass(frozen=True, slots=True)
class WriterCursor:
    """How far one writer's journal has been read.

    All rows below ``(run, seq)`` are read; of the items in ``ahead`` also those below theirs.
    """

    run: int = 0
    seq: int = 0
    ahead: Mapping[str, int] = field(default_factory=dict)

    def has_read(self, run: int, seq: int, item: str) -> bool:
        """Return whether a row is before this cursor."""
        return (run, seq) < (self.run, max(self.seq, self.ahead.get(item, 0)))


@dataclass(frozen=True, slots=True)
class Cursor:
    """The position of a follower in each writer's journal; converts to text and back
    without loss.
    """

    store_id: str = ""
    writers: Mapping[str, WriterCursor] = field(default_factory=dict)

    def to_json(self) -> str:
        """Write the cursor as one line of JSON."""
        writers = {w: [c.run, c.seq, dict(c.ahead)] for w, c in self.writers.items()}
        return json.dumps({"store_id": self.store_id, "writers": writers})

    @classmethod
    def from_json(cls, text: str) -> Cursor:
        """Read what ``to_json`` wrote."""
        data = json.loads(text)
        writers = {w: WriterCursor(*c) for w, c in data["writers"].items()}
        return cls(data["store_id"], writers)


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Columns of equal length, as unrolled from a batch of messages of one schema.

    ``children`` holds one table per sequence of structures. In a child table ``parent_row`` is
    the row of the table above that each row belongs to, ``index`` its place in the sequence.
    """

    count: int
    columns: Mapping[str, ColumnData]
    children: Mapping[str, Rows] = field(default_factory=dict)
    stamp_ns: IntArray | None = None
    parent_row: IntArray | None = None
    index: IntArray | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Batch:
    """Rows of one item, one schema, one writer's run, in ``seq`` order.

    ``timestamp_ns`` is the item's own stamp, else ``received_ns`` (the paper's rule);
    ``received_ns`` is the corrected time of receipt, ``log_time_ns`` the time in the journal.
    ``encoding`` is that of the messages, empty if only their columns are left.
    """

    item: str
    schema: ItemSchema
    writer: str
    run: int
    seq: IntArray
    log_time_ns: IntArray
    received_ns: IntArray
    timestamp_ns: IntArray
    columns: Mapping[str, ColumnData]
    children: Mapping[str, Batch] = field(default_factory=dict)
    cursor: Cursor = field(default_factory=Cursor)
    topic: str = ""
    source: str = ""
    encoding: str = ""

    def __len__(self) -> int:
        return len(self.seq)

    def __repr__(self) -> str:
        first = f"{self.seq[0]}" if len(self) else "-"
        place = f"{self.writer} run {self.run} seq {first}"
        return f"Batch({self.item}, {len(self)} rows, {len(self.columns)} columns, {place})"


@dataclass(frozen=True, slots=True)
class Gap:
    """A missing range of the record, with the reason.

    ``item`` is empty if all items of the writer are missing; ``count`` is None if it is unknown.
    ``peer`` names the publisher whose messages are missing; messages of other publishers of the
    topic may have been received.
    """

    writer: str
    run: int
    from_ns: int
    to_ns: int
    reason: str
    item: str = ""
    count: int | None = None
    from_seq: int | None = None
    to_seq: int | None = None
    cursor: Cursor = field(default_factory=Cursor)
    peer: str = ""


@dataclass(frozen=True, slots=True)
class Watermark:
    """Everything of this writer received before ``received_ns`` has been delivered.

    Rows at or above ``durable_seq`` of ``run`` are provisional: a power cut may take them.
    """

    writer: str
    run: int
    received_ns: int
    durable_seq: int
    cursor: Cursor = field(default_factory=Cursor)


# of a component; ``docs/robot/monitoring.md`` describes each
Level: TypeAlias = Literal["ok", "warn", "error", "stale", "unknown"]

Output: TypeAlias = "bool | int | float | str | None"


@dataclass(frozen=True, slots=True)
class Status:
    """The result of the monitors for one mode of a component, or for the component (``mode``
    empty).

    ``state`` is ``nominal``, ``not_initialised``, ``not_monitored``, or the name of a fault state.
    ``blocked_by`` names the nearest dependencies that are not ok. ``measured_ns`` is the evaluated
    instant of the record, ``since_ns`` when the present level and state began. ``live_only`` marks
    results that a replay cannot reproduce, such as that the recorder was dead.
    """

    robot: str
    component: str
    mode: str
    level: Level
    state: str
    outputs: Mapping[str, Output]
    blocked_by: tuple[str, ...]
    measured_ns: int
    since_ns: int
    reason: str
    config_hash: str
    live_only: bool = False


SymptomState: TypeAlias = Literal["present", "absent", "unknown"]


class FaultFacts(NamedTuple):
    """Facts about a failure mode: its severity, and the symptoms it may show."""

    severity: Literal["warning", "urgent", "critical", "fatal"]
    shows: frozenset[str]


@dataclass(frozen=True, slots=True)
class Symptom:
    """One observation that is evidence for or against faults.

    ``id`` is the address of a monitor's output (``component/mode/output``) or
    ``detector.finding.item[.variable]``; ``source`` names the kind of provider, ``strength`` is the
    trust in the observation (1: full). ``evidence`` names the measured data: address, from and to.
    ``blocked_by`` names dependencies of its component that are not ok: then it is no evidence.
    ``reason`` gives the measured value and its limit, if known. ``gone_ns`` is when a symptom
    disappeared that is still remembered: it continues to count for a while. ``size`` is how large a
    present symptom is, signed, in the unit that the FMEA states; None if that is not known.
    """

    id: str
    state: SymptomState
    address: str = ""
    onset_ns: int | None = None
    confirmed_ns: int | None = None
    strength: float = 1.0
    source: str = "monitor"
    evidence: tuple[tuple[str, int, int], ...] = ()
    blocked_by: tuple[str, ...] = ()
    reason: str = ""
    gone_ns: int | None = None
    size: float | None = None


UNKNOWN_FAULT: Final = "unknown#other"  # stands for every failure mode that is not in the FMEA


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A set of failure modes (``component#mode``) as a possible cause.

    ``ambiguity`` are the ids of hypotheses that no symptom distinguishes from this one. ``follows``
    are those of its faults that may have followed from others of them: they are no further faults.
    """

    id: str
    faults: frozenset[str]
    probability: float
    explains: tuple[str, ...] = ()
    unexplained: tuple[str, ...] = ()
    contradicted: tuple[str, ...] = ()
    ambiguity: tuple[str, ...] = ()
    proof: str = ""
    criticality: float = 0.0
    follows: frozenset[str] = frozenset()


RunKind: TypeAlias = Literal["experiment", "unit_test"]
"""Kinds of tests that are run: by a robot, or with it; people answer the others."""
TestKind: TypeAlias = Literal["read", "question", "check"] | RunKind


@dataclass(frozen=True, slots=True)
class Test:
    """A reading, question, check or experiment that gives more information.

    ``gain_bits`` is the expected information, ``outcomes`` the probability of each answer. ``run``
    is the name of the experiment or unit test, ``moves`` whether the robot moves in it.
    """

    id: str
    kind: TestKind
    text: str
    role: str = ""
    cost_s: float = 0.0
    risk: float = 0.0
    gain_bits: float = 0.0
    outcomes: Mapping[str, float] = field(default_factory=dict)
    run: str = ""
    moves: bool = False


@dataclass(frozen=True, slots=True)
class AmbiguityGroup:
    """Hypotheses that the evidence cannot distinguish, by id, the most probable first.

    ``wider`` are sets that only add faults without any symptom to a member. ``split_by`` is the id
    of the test that distinguishes the members best, empty if there is none or only one member.
    """

    members: tuple[str, ...]
    probability: float
    wider: tuple[str, ...] = ()
    split_by: str = ""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """A diagnosis: hypotheses from likely to unlikely, and the next tests.

    ``mass_covered`` is the probability of all enumerated hypotheses; ``incomplete`` names the
    budget that ended the search, empty if none did. ``findings`` are results that belong to no
    failure mode. ``symptoms`` are the present ones, in order of onset; once all have healed the
    last revision has the ``state`` healed and keeps the last answer. ``live_only`` marks a record
    that a replay does not reproduce: repeated in a new file, or ended by a restart. ``make_safe``
    are the actions of the FMEA that are needed before any of ``next_tests``. ``asked`` are the
    providers of evidence that a tracker has asked: their findings are among its evidence.
    """

    id: str
    revision: int
    robot: str
    at_ns: int
    config_hash: str
    hypotheses: tuple[Hypothesis, ...]
    mass_covered: float
    incomplete: str = ""
    findings: tuple[str, ...] = ()
    next_tests: tuple[Test, ...] = ()
    groups: tuple[AmbiguityGroup, ...] = ()
    symptoms: tuple[str, ...] = ()
    state: Literal["open", "healed"] = "open"
    live_only: bool = False
    make_safe: tuple[str, ...] = ()
    asked: tuple[str, ...] = ()

    def members(self, group: AmbiguityGroup) -> tuple[Hypothesis, ...]:
        """Return the hypotheses of a group."""
        by_id = {hypothesis.id: hypothesis for hypothesis in self.hypotheses}
        return tuple(by_id[name] for name in group.members if name in by_id)

    def leading(self) -> tuple[Hypothesis, ...]:
        """Return the most probable hypothesis, and those that the evidence cannot distinguish from
        it.
        """
        return self.members(self.groups[0]) if self.groups else self.hypotheses[:1]
