"""Where the values of a protobuf message are: the plan of a type, the walk over a message, layouts.

A walk records for each column the row, and the start and end of its value. Messages of one size
whose keys, lengths and continuation bits of numbers are equal have all values at the same places:
the first key lies at a fixed place and tells what follows it, so by induction everything does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import check_places
from amberbox.blackbox.columns.arrays import offsets_of
from amberbox.blackbox.columns.layout_cache import LayoutGroup
from amberbox.blackbox.columns.protobuf_definition import (
    BYTES,
    FIXED32,
    FIXED64,
    GROUP,
    LONGEST_VARINT,
    STRUCTURES,
    VARINT,
    ProtoDefinition,
    ProtoField,
    extent,
    read_varint,
)
from amberbox.core.names import unique_names
from amberbox.core.types import Column, IntArray, ItemSchema

DEEPEST = 32  # structures in structures; a deeper one, or one within itself, is a binary column
# a message may stand for so many values per byte: a structure of zeros in a list takes two bytes
_VALUES_PER_BYTE = 64
_FREE_VALUES = 1 << 16

TIMES = {"google.protobuf.Timestamp": "time", "google.protobuf.Duration": "duration"}

# wire type and column type of each kind of number
NUMBERS: Mapping[str, tuple[int, str]] = {
    "double": (FIXED64, "float64"),
    "float": (FIXED32, "float32"),
    "int64": (VARINT, "int64"),
    "uint64": (VARINT, "uint64"),
    "int32": (VARINT, "int32"),
    "fixed64": (FIXED64, "uint64"),
    "fixed32": (FIXED32, "uint32"),
    "bool": (VARINT, "bool"),
    "uint32": (VARINT, "uint32"),
    "enum": (VARINT, "int32"),
    "sfixed32": (FIXED32, "int32"),
    "sfixed64": (FIXED64, "int64"),
    "sint32": (VARINT, "int32"),
    "sint64": (VARINT, "int64"),
}
WIDTHS = {FIXED32: 4, FIXED64: 8}


@dataclass(frozen=True, slots=True)
class Presence:
    """Whether a value is there: in its slot, behind those of its oneof, in a structure that is.

    ``rivals`` are the slots of all members of the oneof; of those sent the last one is there.
    """

    slot: int
    above: Presence | None
    rivals: Sequence[int] = ()


@dataclass(frozen=True, slots=True)
class Leaf:
    """A column: its values are in ``slot``, those of a time in the slots of its two numbers.

    Without ``presence`` a missing value is zero. ``elements`` is the table whose rows are the
    elements of a list of times.
    """

    column: Column
    kind: str
    slot: int
    presence: Presence | None = None
    time: tuple[int, int] | None = None
    elements: int | None = None


@dataclass(slots=True)
class Table:
    """A table: its columns, and its child tables with the slot of their rows."""

    number: int
    type_name: str
    leaves: list[Leaf] = field(default_factory=list)
    children: dict[str, tuple[int, Table]] = field(default_factory=dict)
    schema: ItemSchema = field(default_factory=lambda: ItemSchema("", ()))


@dataclass(slots=True)
class Step:
    """What to do with a field: record it, walk its structure, in a row of its own if repeated.

    ``unit`` is the width of a packed number (0: varints), None for anything that is not packed.
    """

    slot: int
    unit: int | None = None
    inside: Mapping[int, Step] | None = None
    table: Table | None = None


@dataclass(frozen=True, slots=True)
class ProtoPlan:
    """How to read one message type: its steps by key, its tables, and the table of each slot."""

    steps: Mapping[int, Step]
    table: Table
    slot_tables: Sequence[int]
    table_count: int


def plan(definition: ProtoDefinition) -> ProtoPlan:
    """Compile a message type; raises AmberboxError for one with too many columns."""
    planner = _Planner(definition)
    table = planner.table(definition.root)
    steps = planner.structure(definition.root, table, "", None, ())
    planner.name(table)
    return ProtoPlan(steps, table, planner.slot_tables, planner.table_count)


@dataclass(slots=True)
class _Planner:
    definition: ProtoDefinition
    slot_tables: list[int] = field(default_factory=list)
    table_count: int = 0
    places: int = 0

    def table(self, type_name: str) -> Table:
        self.table_count += 1
        return Table(self.table_count - 1, type_name)

    def slot(self, table: Table) -> int:
        self.slot_tables.append(table.number)
        return len(self.slot_tables) - 1

    def structure(
        self, name: str, table: Table, path: str, above: Presence | None, inside: tuple[str, ...]
    ) -> dict[int, Step]:
        """Plan the fields of a structure that lies in rows of a table; return its steps by key."""
        steps: dict[int, Step] = {}
        oneofs: dict[int, list[int]] = {}
        for one in self.definition.messages[name]:
            self.places += 1
            check_places(self.definition.root, self.places)
            slot = self.slot(table)
            rivals: list[int] = []
            if one.oneof is not None:
                rivals = oneofs.setdefault(one.oneof, [])
                rivals.append(slot)
            presence = Presence(slot, above, rivals) if one.has_presence else above
            place = f"{path}/{one.name}" if path else one.name
            if one.kind in STRUCTURES:
                wire = BYTES if one.kind == "message" else GROUP
                step = self.nested(one, slot, table, place, presence, (*inside, name))
                steps[one.number << 3 | wire] = step
            else:
                steps |= self.plain(one, slot, table, place, presence)
        return steps

    def plain(
        self, one: ProtoField, slot: int, table: Table, place: str, presence: Presence | None
    ) -> dict[int, Step]:
        wire, kind = NUMBERS.get(one.kind, (BYTES, "string" if one.kind == "string" else "binary"))
        labels = self.definition.labels.get(one.type_name, {}) if one.kind == "enum" else {}
        listed = f"list<{kind}>" if one.is_repeated else kind
        column = Column("", place, listed, "", labels)
        table.leaves.append(Leaf(column, one.kind, slot, presence))
        steps = {one.number << 3 | wire: Step(slot)}
        if one.is_repeated and wire != BYTES:  # readers accept both forms of a list of numbers
            steps[one.number << 3 | BYTES] = Step(slot, WIDTHS.get(wire, 0))
        return steps

    def nested(
        self,
        one: ProtoField,
        slot: int,
        table: Table,
        place: str,
        presence: Presence | None,
        inside: tuple[str, ...],
    ) -> Step:
        name = one.type_name
        if name in inside or len(inside) >= DEEPEST:
            kind = "list<binary>" if one.is_repeated else "binary"
            table.leaves.append(Leaf(Column("", place, kind), "bytes", slot, presence))
            return Step(slot)
        if name in TIMES and self.is_time(name):
            return self.time(one, slot, table, place, presence)
        if not one.is_repeated:
            return Step(slot, None, self.structure(name, table, place, presence, inside))
        child = self.table(name)
        table.children[place] = slot, child
        return Step(slot, None, self.structure(name, child, "", None, inside), child)

    def is_time(self, name: str) -> bool:
        """Return whether a type of that name has the two numbers of a time."""
        fields = {(one.number, one.kind) for one in self.definition.messages[name]}
        return fields == {(1, "int64"), (2, "int32")}

    def time(
        self, one: ProtoField, slot: int, table: Table, place: str, presence: Presence | None
    ) -> Step:
        kind = TIMES[one.type_name]
        elements = self.table(one.type_name) if one.is_repeated else None
        of = elements or table
        numbers = self.slot(of), self.slot(of)
        inside = {number << 3: Step(s) for number, s in enumerate(numbers, 1)}
        column = Column("", place, f"list<{kind}>" if elements else kind)
        number = elements.number if elements else None
        table.leaves.append(Leaf(column, kind, slot, presence, numbers, number))
        return Step(slot, None, inside, elements)

    def name(self, table: Table) -> None:
        """Give the columns of a table and of its child tables their names."""
        names = unique_names(leaf.column.path for leaf in table.leaves)
        for number, leaf in enumerate(table.leaves):
            column = replace(leaf.column, name=names[leaf.column.path])
            table.leaves[number] = replace(leaf, column=column)
        for _, child in table.children.values():
            self.name(child)
        table.schema = ItemSchema(
            table.type_name,
            tuple(leaf.column for leaf in table.leaves),
            {path: child.schema for path, (_, child) in table.children.items()},
        )


@dataclass(slots=True)
class Watch:
    """The bytes of a message that its layout depends on: equal ones, and continuation bits."""

    equal: list[tuple[int, int]] = field(default_factory=list)
    bits: list[tuple[int, int]] = field(default_factory=list)


class Walk:
    """A walk over the messages in a buffer.

    ``places`` are row, start and end of each value, one after the other, for each slot; ``counts``
    the rows of each table so far.
    """

    def __init__(self, plan: ProtoPlan, data: bytes, watch: Watch | None = None) -> None:
        self.plan = plan
        self.data = data
        self.watch = watch
        self.places: list[list[int]] = [[] for _ in plan.slot_tables]
        self.counts = [0] * plan.table_count
        self.left = 0

    def message(self, start: int, end: int) -> None:
        """Walk one message; raises one of ``MISFITS`` if it is damaged."""
        self.left = _FREE_VALUES + _VALUES_PER_BYTE * (end - start)
        row = self.counts[0]
        self.counts[0] += 1
        self.structure(self.plan.steps, start, end, row)

    def structure(  # noqa: C901  # one loop over all fields, for speed
        self, steps: Mapping[int, Step], at: int, end: int, row: int
    ) -> None:
        data, places, watch = self.data, self.places, self.watch
        while at < end:
            first = at
            key = data[at]
            at += 1
            if key > 0x7F:
                key, at = read_varint(data, first)
            wire = key & 7
            if wire == VARINT and 7 < key < 1 << 32:
                start = at
                while data[at] > 0x7F:
                    at += 1
                at += 1
                stop = at
                if at - start > LONGEST_VARINT or at > end:
                    raise ValueError("a damaged varint")
            else:
                start, stop, at = extent(data, at, end, key >> 3, wire)
            step = steps.get(key)
            if watch is not None:
                watch.equal += ((first, start), (stop, at))
                if wire == VARINT:
                    watch.bits.append((start, stop))
                elif wire == GROUP:
                    watch.equal.append((start, stop))
            if step is None:
                continue
            places[step.slot] += (row, start, stop)
            if step.inside is not None:
                below = row if step.table is None else self.row(step.table)
                self.structure(step.inside, start, stop, below)
            elif step.unit is not None:
                self.packed(step.unit, start, stop)

    def row(self, table: Table) -> int:
        """Return the number of a new row of a table."""
        self.left -= len(table.leaves) + 1
        if self.left < 0:
            raise ValueError("more values than a message of this size may stand for")
        self.counts[table.number] += 1
        return self.counts[table.number] - 1

    def packed(self, unit: int, start: int, stop: int) -> None:
        if unit:
            if (stop - start) % unit:
                raise ValueError("a packed list that ends within a number")
        elif stop > start:
            if self.watch is not None:
                self.watch.bits.append((start, stop))
            check_varints(np.frombuffer(self.data, np.uint8, stop - start, start))


def check_varints(packed: NDArray[np.uint8]) -> None:
    """Raise ValueError if these are not whole varints of at most 10 bytes."""
    ends = np.flatnonzero(packed < 0x80)
    if packed[-1] >= 0x80 or int(np.diff(ends, prepend=-1).max()) > LONGEST_VARINT:
        raise ValueError("a damaged packed list")


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Row, start and end of the values in a slot, in any order of rows."""

    rows: IntArray
    starts: IntArray
    ends: IntArray

    def in_order(self) -> Places:
        """Return them in order of rows; values of one row keep their order."""
        if (self.rows[1:] >= self.rows[:-1]).all():
            return self
        order = np.argsort(self.rows, kind="stable")
        return Places(self.rows[order], self.starts[order], self.ends[order])


@dataclass(frozen=True, slots=True, eq=False)
class ValuePlaces:
    """The places of all values of a batch in a buffer, by slot, and the rows of each table."""

    data: bytes
    slots: Sequence[Places]
    counts: Sequence[int]


def walked(walk: Walk) -> ValuePlaces:
    """Return the places that a walk has recorded."""
    tables = (np.array(flat, np.int64).reshape(-1, 3).T for flat in walk.places)
    return ValuePlaces(walk.data, [Places(*table) for table in tables], walk.counts)


@dataclass(frozen=True, slots=True, eq=False)
class ProtoLayout:
    """The places of all values in messages of one size, and the bits that identify the layout.

    A message has it if its bytes ``at``, masked, are ``expected``. ``places`` are those of all
    slots, one after the other; those of slot ``n`` are from ``cuts[n]`` to ``cuts[n + 1]``.
    ``tables`` are the numbers of their tables, ``counts`` the rows of each table in a message.
    """

    size: int
    at: NDArray[np.int64]
    mask: NDArray[np.uint8]
    expected: NDArray[np.uint8]
    places: Places
    cuts: Sequence[int]
    tables: IntArray
    counts: IntArray

    def fits(self, message: bytes) -> bool:
        """Return whether one message of the right size has this layout."""
        found = np.frombuffer(message, np.uint8)[self.at] & self.mask
        return bool((found == self.expected).all())

    def repeats(self, data: bytes, count: int) -> bool:
        """Return False: texts that repeat are found when they are read."""
        return False

    def matches(self, data: bytes, count: int) -> NDArray[np.bool_]:
        """Return which of ``count`` joined messages, all of the right size, have this layout."""
        block = np.frombuffer(data, np.uint8).reshape(count, self.size)
        matching: NDArray[np.bool_] = (block[:, self.at] & self.mask == self.expected).all(axis=1)
        return matching


def find_layout(plan: ProtoPlan, message: bytes) -> ProtoLayout:
    """Return the layout of a message; raises one of ``MISFITS`` if it is damaged."""
    watch = Watch()
    walk = Walk(plan, message, watch)
    walk.message(0, len(message))
    mask = np.zeros(len(message), np.uint8)
    for start, stop in watch.bits:
        mask[start:stop] = 0x80
    for start, stop in watch.equal:
        mask[start:stop] = 0xFF
    at = np.flatnonzero(mask)
    lengths = [len(flat) // 3 for flat in walk.places]
    flat = np.array([number for places in walk.places for number in places], np.int64)
    return ProtoLayout(
        len(message),
        at,
        mask[at],
        np.frombuffer(message, np.uint8)[at] & mask[at],
        Places(*flat.reshape(-1, 3).T),
        offsets_of(lengths).tolist(),
        np.repeat(np.array(plan.slot_tables, np.int64), lengths),
        np.array(walk.counts, np.int64),
    )


def places_of(groups: Sequence[LayoutGroup[ProtoLayout]]) -> ValuePlaces:
    """Return the places of all values of the messages of a batch; rows are in their order."""
    shape = sum(len(group.members) for group in groups), len(groups[0].layout.counts)
    counts = np.zeros(shape, np.int64)
    for group in groups:
        counts[group.members] = group.layout.counts
    totals = np.zeros((len(counts) + 1, counts.shape[1]), np.int64)
    np.cumsum(counts, axis=0, out=totals[1:])
    found: list[list[Places]] = [[] for _ in groups[0].layout.cuts[1:]]
    base = 0
    for group in groups:
        layout, one = group.layout, group.layout.places
        bases = base + np.arange(len(group.members), dtype=np.int64) * layout.size
        rows = totals[group.members][:, layout.tables] + one.rows
        starts, ends = np.add.outer(bases, one.starts), np.add.outer(bases, one.ends)
        for parts, (first, last) in zip(found, pairwise(layout.cuts), strict=True):
            if first < last:
                inside = (table[:, first:last].reshape(-1) for table in (rows, starts, ends))
                parts.append(Places(*inside))
        base += len(group.data)
    data = groups[0].data if len(groups) == 1 else b"".join(group.data for group in groups)
    return ValuePlaces(data, [_joined(parts) for parts in found], totals[-1].tolist())


_NO_PLACES = Places(*np.empty((3, 0), np.int64))


def _joined(parts: Sequence[Places]) -> Places:
    if len(parts) < 2:
        return parts[0] if parts else _NO_PLACES
    return Places(
        np.concatenate([part.rows for part in parts]),
        np.concatenate([part.starts for part in parts]),
        np.concatenate([part.ends for part in parts]),
    )
