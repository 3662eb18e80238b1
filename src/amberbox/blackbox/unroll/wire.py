"""A flat table as bytes on the wire: fields that always lie alike are read as one piece.

Alignment (CDR, XCDR1) is worked out beforehand as far as the place of a field is known; behind
strings and sequences it is found again while reading. ROS 1 packs everything without gaps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from amberbox.blackbox.unroll.definition import SIZES
from amberbox.blackbox.unroll.fields import Children, Entry, Numbers, Scalar, Table, Text, Texts
from amberbox.core.types import ItemSchema

_FILLER = "uint8"
_PREFIX = 4


@dataclass(frozen=True, slots=True)
class Lead:
    """The gap before an operation: up to a multiple of ``align``, or ``skip`` bytes."""

    align: int = 1
    skip: int = 0


@dataclass(frozen=True, slots=True)
class Run:
    """Columns of one type that lie next to each other, from ``offset`` in their piece."""

    kind: str
    offset: int
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FixedOp:
    """A piece of fixed size. Records its start."""

    slot: int
    lead: Lead
    size: int
    runs: tuple[Run, ...]
    slots = 1


@dataclass(frozen=True, slots=True)
class TextOp:
    """A string. Records start and end of its characters."""

    slot: int
    lead: Lead
    name: str
    wide: bool
    slots = 2


@dataclass(frozen=True, slots=True)
class NumbersOp:
    """A list of numbers. Records start and count."""

    slot: int
    lead: Lead
    name: str
    item: str
    align: int
    count: int | None
    binary: bool
    slots = 2


@dataclass(frozen=True, slots=True)
class TextsOp:
    """A list of strings. Records the count, then start and end of each."""

    slot: int
    lead: Lead
    name: str
    wide: bool
    count: int | None
    slots = 3


@dataclass(frozen=True, slots=True)
class ChildrenOp:
    """A list of structures. Records the count and, when its rows have one ``stride``, the start.

    Without a stride the operations of ``table`` record their own places for each row.
    """

    slot: int
    lead: Lead
    path: str
    table: WireTable
    count: int | None
    align: int
    stride: int | None
    slots = 2


Op: TypeAlias = FixedOp | TextOp | NumbersOp | TextsOp | ChildrenOp


@dataclass(frozen=True, slots=True)
class WireTable:
    """Operations in wire order; ``smallest`` is the least number of bytes a row can have."""

    ops: tuple[Op, ...]
    schema: ItemSchema
    smallest: int


@dataclass(slots=True)
class _Place:
    """What is known of the place reached: it is ``rest`` modulo ``known``."""

    known: int
    rest: int = 0

    def lead(self, align: int) -> Lead:
        if align <= self.known:
            return Lead(1, -self.rest % align)
        self.known, self.rest = align, 0
        return Lead(align)

    def move(self, size: int) -> None:
        self.rest = (self.rest + size) % self.known

    def lose(self, known: int = 1) -> None:
        self.known, self.rest = known, 0


@dataclass(slots=True)
class _Fuser:
    """Turns entries into operations and hands out the slots that they record into."""

    cdr: bool
    next_slot: int = 0
    smallest: list[int] = field(default_factory=list)

    def table(self, table: Table, place: _Place) -> WireTable:
        ops: list[Op] = []
        piece = _Piece(self, place)
        smallest = 0
        for entry in table.entries:
            smallest += _smallest(entry)
            if isinstance(entry, Scalar):
                piece.add(entry, ops)
            else:
                piece.close(ops)
                ops.append(self.op(entry, place))
        piece.close(ops)
        return WireTable(tuple(ops), table.schema, smallest)

    def slot(self, count: int) -> int:
        self.next_slot += count
        return self.next_slot - count

    def align(self, kind: str) -> int:
        if not self.cdr:
            return 1
        return 4 if kind in ("time", "duration") else SIZES[kind]

    def prefix(self, place: _Place) -> Lead:
        lead = place.lead(_PREFIX if self.cdr else 1)
        place.lose(_PREFIX if self.cdr else 1)
        return lead

    def op(self, entry: Text | Numbers | Texts | Children, place: _Place) -> Op:
        if isinstance(entry, Text):
            op: Op = TextOp(self.slot(2), self.prefix(place), entry.column.name, entry.wide)
            place.lose(_PREFIX if entry.wide and self.cdr else 1)
            return op
        if isinstance(entry, Numbers):
            return self.numbers(entry, place)
        if isinstance(entry, Texts):
            lead = Lead() if entry.count is not None else self.prefix(place)
            place.lose()
            return TextsOp(self.slot(3), lead, entry.column.name, entry.wide, entry.count)
        return self.children(entry, place)

    def numbers(self, entry: Numbers, place: _Place) -> NumbersOp:
        size, align = SIZES[entry.item], self.align(entry.item)
        if entry.count is None:
            lead = self.prefix(place)
            place.lose(min(size, _PREFIX) if self.cdr else 1)
        else:
            lead = place.lead(align)
            place.move(lead.skip + size * entry.count)
        binary = entry.column.type == "binary"
        name = entry.column.name
        return NumbersOp(self.slot(2), lead, name, entry.item, align, entry.count, binary)

    def children(self, entry: Children, place: _Place) -> ChildrenOp:
        lead = Lead() if entry.count is not None else self.prefix(place)
        place.lose()
        slot = self.slot(2)
        table = self.table(entry.table, place)
        place.lose()
        align, stride = _stride(table.ops)
        return ChildrenOp(slot, lead, entry.path, table, entry.count, align, stride)


def _stride(ops: Sequence[Op]) -> tuple[int, int | None]:
    """Give alignment and stride of rows that are one piece and pack without gaps between."""
    if len(ops) == 1 and isinstance(ops[0], FixedOp) and ops[0].size % ops[0].lead.align == 0:
        return ops[0].lead.align, ops[0].size
    return 1, None


@dataclass(slots=True)
class _Piece:
    """Scalars gathered so far that lie alike in every message."""

    fuser: _Fuser
    place: _Place
    first: Lead | None = None
    size: int = 0
    runs: list[tuple[str, int, list[str]]] = field(default_factory=list)

    def add(self, entry: Scalar, ops: list[Op]) -> None:
        kind = entry.column.type if entry.column else _FILLER
        align = self.fuser.align(kind)
        if align > self.place.known:
            self.close(ops)
        lead = self.place.lead(align)
        if self.first is None:
            self.first = lead
        self.size += lead.skip
        if entry.column:
            self._append(kind, entry.column.name)
        self.size += SIZES[kind]
        self.place.move(lead.skip + SIZES[kind])

    def _append(self, kind: str, name: str) -> None:
        if self.runs:
            last, offset, names = self.runs[-1]
            if last == kind and offset + len(names) * SIZES[kind] == self.size:
                names.append(name)
                return
        self.runs.append((kind, self.size, [name]))

    def close(self, ops: list[Op]) -> None:
        if self.first is not None:
            runs = tuple(Run(kind, offset, tuple(names)) for kind, offset, names in self.runs)
            lead = Lead(self.first.align)  # a known gap is part of the piece
            ops.append(FixedOp(self.fuser.slot(1), lead, self.size, runs))
        self.first, self.size, self.runs = None, 0, []


def _smallest(entry: Entry) -> int:
    if isinstance(entry, Scalar):
        return SIZES[entry.column.type if entry.column else _FILLER]
    if isinstance(entry, Text) or entry.count is None:
        return _PREFIX
    if isinstance(entry, Numbers):
        return SIZES[entry.item] * entry.count
    each = _PREFIX if isinstance(entry, Texts) else sum(map(_smallest, entry.table.entries))
    return each * entry.count


@dataclass(frozen=True, slots=True)
class Plan:
    """How to read one message type: the table and the number of slots it records into."""

    table: WireTable
    slots: int
    cdr: bool


def plan(table: Table, cdr: bool) -> Plan:
    """Fuse the entries of a table for ROS 1 or CDR (places count from behind its header)."""
    fuser = _Fuser(cdr)
    wire = fuser.table(table, _Place(8 if cdr else 1))
    return Plan(wire, fuser.next_slot, cdr)


def text_slots(table: WireTable) -> Iterator[tuple[int, bool]]:
    """List the slots of string starts (ends are in the next one) and whether they are wide."""
    for op in table.ops:
        if isinstance(op, TextOp):
            yield op.slot, op.wide
        elif isinstance(op, TextsOp):
            yield op.slot + 1, op.wide
        elif isinstance(op, ChildrenOp):
            yield from text_slots(op.table)
