"""A ROS message definition as a flat table, and that table as bytes on the wire.

Fields are columns, lists of structures child tables; adjacent fields of fixed size are read as one
piece. Alignment (CDR, XCDR1) is computed beforehand as far as the offset of a field is known; after
strings and sequences it is computed while reading. ROS 1 packs everything without gaps.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from amberbox.blackbox.columns import check_places
from amberbox.blackbox.columns.ros_definition import (
    FILLER,
    HEADER,
    SIZES,
    FieldType,
    RosDefinition,
    RosStructure,
    field_labels,
    known_unit,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.names import unique_names
from amberbox.core.types import Column, ItemSchema

LONGEST_UNROLLED = 64
# a fixed array of structures that would unroll into more columns becomes a child table
MOST_COLUMNS = 4096
DEEPEST = 12  # child tables within child tables; Python itself compiles no reader for 20


@dataclass(frozen=True, slots=True)
class ScalarEntry:
    """A number, bool, time or duration of fixed size; without a column one byte of padding."""

    column: Column | None


@dataclass(frozen=True, slots=True)
class TextEntry:
    """A string with its length before it; ``wide`` has 4 bytes per UTF-16 unit."""

    column: Column
    wide: bool


@dataclass(frozen=True, slots=True)
class NumbersEntry:
    """A sequence, or a long fixed array, of ``item``: a list column or a binary one."""

    column: Column
    item: str
    count: int | None


@dataclass(frozen=True, slots=True)
class TextsEntry:
    """A sequence, or a long fixed array, of strings."""

    column: Column
    wide: bool
    count: int | None


@dataclass(frozen=True, slots=True)
class ChildrenEntry:
    """A sequence, or a long fixed array, of structures."""

    path: str
    table: EntryTable
    count: int | None


Entry: TypeAlias = ScalarEntry | TextEntry | NumbersEntry | TextsEntry | ChildrenEntry


@dataclass(frozen=True, slots=True)
class EntryTable:
    """Entries in wire order with the schema of the rows they make."""

    entries: tuple[Entry, ...]
    schema: ItemSchema


def flatten_definition(definition: RosDefinition, type_name: str, ros1: bool) -> EntryTable:
    """Return a message type as a table; ``schema.stamp`` is the message's own stamp, if any."""
    walk = _Walk(definition, ros1)
    check_places(type_name, walk.places(definition.root))
    if walk.depth(definition.root) > DEEPEST:
        raise AmberboxError(
            f"{type_name} has lists in lists, more than {DEEPEST} deep",
            "the messages are still recorded, but have no columns",
        )
    table = _table(definition, definition.root, type_name, ros1)
    stamp = _own_stamp(definition.structures[definition.root])
    return replace(table, schema=replace(table.schema, stamp=stamp))


def _own_stamp(structure: RosStructure) -> str:
    singles = [(name, field.base) for name, field in structure.fields if field.count is None]
    headers = [f"{name}/stamp" for name, base in singles if base == HEADER]
    stamps = [name for name, base in singles if name == "stamp" and base == "time"]
    return next(iter(headers + stamps), "")


def _table(definition: RosDefinition, name: str, type_name: str, ros1: bool) -> EntryTable:
    entries = list(_Walk(definition, ros1).structure(name, "", ""))
    columns = [c for entry in entries if (c := getattr(entry, "column", None)) is not None]
    names = unique_names(column.path for column in columns)
    children = {e.path: e.table.schema for e in entries if isinstance(e, ChildrenEntry)}
    return EntryTable(
        tuple(_named(entry, names) for entry in entries),
        ItemSchema(type_name, tuple(replace(c, name=names[c.path]) for c in columns), children),
    )


def _named(entry: Entry, names: Mapping[str, str]) -> Entry:
    if isinstance(entry, ChildrenEntry) or entry.column is None:
        return entry
    return replace(entry, column=replace(entry.column, name=names[entry.column.path]))


@dataclass(frozen=True, slots=True)
class _Walk:
    """One pass over a definition; columns are named when all paths are known."""

    definition: RosDefinition
    ros1: bool
    _widths: dict[str, int] = field(default_factory=dict)
    _places: dict[str, int] = field(default_factory=dict)
    _depths: dict[str, int] = field(default_factory=dict)

    def structure(self, name: str, path: str, unit: str) -> Iterator[Entry]:
        structure = self.definition.structures[name]
        if not structure.fields and not self.ros1:
            yield ScalarEntry(None)  # DDS sends one byte for a structure without members
        labels = field_labels(structure)
        for member, field_type in structure.fields:
            place = f"{path}/{member}" if path else member
            field_unit = known_unit(name, member) or unit
            column = Column("", place, field_type.base, field_unit, labels.get(member, {}))
            yield from self.field(column, field_type)

    def field(self, column: Column, kind: FieldType) -> Iterator[Entry]:
        if column.path.endswith(FILLER):
            yield ScalarEntry(None)
        elif kind.count is None:
            yield from self.single(column)
        elif self.is_unrolled(kind):
            for index in range(kind.count):
                yield from self.single(replace(column, path=f"{column.path}/{index}"))
        else:
            yield self.many(column, None if kind.count < 0 else kind.count)

    def single(self, column: Column) -> Iterator[Entry]:
        base = column.type
        if base in self.definition.structures:
            yield from self.structure(base, column.path, column.unit)
        elif base in ("string", "wstring"):
            yield TextEntry(_plain(column, "string"), base == "wstring")
        else:
            yield ScalarEntry(_plain(column, self.number(base)))

    def number(self, base: str) -> str:
        """Return the type of a number; ``byte`` is signed in ROS 1, an octet in ROS 2."""
        return base if base != "byte" else ("int8" if self.ros1 else "uint8")

    def many(self, column: Column, count: int | None) -> Entry:
        base = column.type
        if base in self.definition.structures:
            table = _table(self.definition, base, base.replace("/msg/", "/"), self.ros1)
            return ChildrenEntry(column.path, table, count)
        if base in ("string", "wstring"):
            return TextsEntry(_plain(column, "list<string>"), base == "wstring", count)
        kind = "binary" if base in ("uint8", "byte") else f"list<{base}>"
        return NumbersEntry(_plain(column, kind), self.number(base), count)

    def is_unrolled(self, kind: FieldType) -> bool:
        """Return whether a fixed array becomes columns instead of a list or a child table."""
        count = kind.count or 0
        return 0 <= count <= LONGEST_UNROLLED and count * self.width(kind.base) <= MOST_COLUMNS

    def width(self, base: str) -> int:
        """Return the number of columns of one value, at most ``MOST_COLUMNS + 1``."""
        if base not in self.definition.structures:
            return 1
        if base not in self._widths:
            total = 0
            for _, kind in self.definition.structures[base].fields:
                unrolled = kind.count is not None and 0 <= kind.count <= LONGEST_UNROLLED
                total += self.width(kind.base) * ((kind.count or 0) if unrolled else 1)
            self._widths[base] = min(total, MOST_COLUMNS + 1)
        return self._widths[base]

    def places(self, base: str) -> int:
        """Return how many entries one value has, child tables and empty structures included."""
        if base not in self.definition.structures:
            return 1
        if base not in self._places:
            fields = self.definition.structures[base].fields
            self._places[base] = 1 + sum(
                self.places(kind.base)
                * (kind.count if kind.count is not None and self.is_unrolled(kind) else 1)
                for _, kind in fields
            )
        return self._places[base]

    def depth(self, base: str) -> int:
        """Return how deep child tables are nested."""
        if base not in self.definition.structures:
            return 0
        if base not in self._depths:
            self._depths[base] = max(
                (
                    self.depth(kind.base) + (kind.count is not None and not self.is_unrolled(kind))
                    for _, kind in self.definition.structures[base].fields
                ),
                default=0,
            )
        return self._depths[base]


def _plain(column: Column, kind: str) -> Column:
    labels = column.labels if "int" in kind else {}
    unit = column.unit if kind not in ("string", "bool", "time", "duration", "binary") else ""
    return replace(column, type=kind, labels=labels, unit=unit)


_FILLER = "uint8"
_PREFIX = 4


@dataclass(frozen=True, slots=True)
class Padding:
    """The padding before an operation: up to a multiple of ``align``, or ``skip`` bytes."""

    align: int = 1
    skip: int = 0


@dataclass(frozen=True, slots=True)
class ScalarRun:
    """Adjacent columns of one type, from ``offset`` in their piece."""

    kind: str
    offset: int
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FixedOp:
    """A piece of fixed size. Records its start."""

    slot: int
    lead: Padding
    size: int
    runs: tuple[ScalarRun, ...]
    slots = 1


@dataclass(frozen=True, slots=True)
class TextOp:
    """A string. Records start and end of its characters."""

    slot: int
    lead: Padding
    name: str
    wide: bool
    slots = 2


@dataclass(frozen=True, slots=True)
class NumbersOp:
    """A list of numbers. Records start and count."""

    slot: int
    lead: Padding
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
    lead: Padding
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
    lead: Padding
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
class _Alignment:
    """The known part of the current offset: it is ``rest`` modulo ``known``."""

    known: int
    rest: int = 0

    def lead(self, align: int) -> Padding:
        if align <= self.known:
            return Padding(1, -self.rest % align)
        self.known, self.rest = align, 0
        return Padding(align)

    def move(self, size: int) -> None:
        self.rest = (self.rest + size) % self.known

    def lose(self, known: int = 1) -> None:
        self.known, self.rest = known, 0


@dataclass(slots=True)
class _Fuser:
    """Converts entries into operations and assigns the slots that they record into."""

    cdr: bool
    next_slot: int = 0
    smallest: list[int] = field(default_factory=list)

    def table(self, table: EntryTable, place: _Alignment) -> WireTable:
        ops: list[Op] = []
        piece = _Piece(self, place)
        smallest = 0
        for entry in table.entries:
            smallest += _smallest(entry)
            if isinstance(entry, ScalarEntry):
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

    def prefix(self, place: _Alignment) -> Padding:
        lead = place.lead(_PREFIX if self.cdr else 1)
        place.lose(_PREFIX if self.cdr else 1)
        return lead

    def op(
        self, entry: TextEntry | NumbersEntry | TextsEntry | ChildrenEntry, place: _Alignment
    ) -> Op:
        if isinstance(entry, TextEntry):
            op: Op = TextOp(self.slot(2), self.prefix(place), entry.column.name, entry.wide)
            place.lose(_PREFIX if entry.wide and self.cdr else 1)
            return op
        if isinstance(entry, NumbersEntry):
            return self.numbers(entry, place)
        if isinstance(entry, TextsEntry):
            lead = Padding() if entry.count is not None else self.prefix(place)
            place.lose()
            return TextsOp(self.slot(3), lead, entry.column.name, entry.wide, entry.count)
        return self.children(entry, place)

    def numbers(self, entry: NumbersEntry, place: _Alignment) -> NumbersOp:
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

    def children(self, entry: ChildrenEntry, place: _Alignment) -> ChildrenOp:
        lead = Padding() if entry.count is not None else self.prefix(place)
        place.lose()
        slot = self.slot(2)
        table = self.table(entry.table, place)
        place.lose()
        align, stride = _stride(table.ops)
        return ChildrenOp(slot, lead, entry.path, table, entry.count, align, stride)


def _stride(ops: Sequence[Op]) -> tuple[int, int | None]:
    """Return alignment and stride of rows that are one piece and have no gaps between them."""
    if len(ops) == 1 and isinstance(ops[0], FixedOp) and ops[0].size % ops[0].lead.align == 0:
        return ops[0].lead.align, ops[0].size
    return 1, None


@dataclass(slots=True)
class _Piece:
    """Neighbouring scalars gathered so far, which become one piece of fixed size."""

    fuser: _Fuser
    place: _Alignment
    first: Padding | None = None
    size: int = 0
    runs: list[tuple[str, int, list[str]]] = field(default_factory=list)

    def add(self, entry: ScalarEntry, ops: list[Op]) -> None:
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
            runs = tuple(ScalarRun(kind, offset, tuple(names)) for kind, offset, names in self.runs)
            lead = Padding(self.first.align)  # a known gap is part of the piece
            ops.append(FixedOp(self.fuser.slot(1), lead, self.size, runs))
        self.first, self.size, self.runs = None, 0, []


def _smallest(entry: Entry) -> int:
    if isinstance(entry, ScalarEntry):
        return SIZES[entry.column.type if entry.column else _FILLER]
    if isinstance(entry, TextEntry) or entry.count is None:
        return _PREFIX
    if isinstance(entry, NumbersEntry):
        return SIZES[entry.item] * entry.count
    each = _PREFIX if isinstance(entry, TextsEntry) else sum(map(_smallest, entry.table.entries))
    return each * entry.count


@dataclass(frozen=True, slots=True)
class WirePlan:
    """How to read one message type: its wire table and the number of slots it records into."""

    table: WireTable
    slots: int
    cdr: bool


def plan(table: EntryTable, cdr: bool) -> WirePlan:
    """Compile the entries of a table for ROS 1 or CDR (offsets count from behind its header)."""
    fuser = _Fuser(cdr)
    wire = fuser.table(table, _Alignment(8 if cdr else 1))
    return WirePlan(wire, fuser.next_slot, cdr)


def text_slots(table: WireTable) -> Iterator[tuple[int, bool]]:
    """Yield the slots of string starts (ends are in the next slot) and whether they are wide."""
    for op in table.ops:
        if isinstance(op, TextOp):
            yield op.slot, op.wide
        elif isinstance(op, TextsOp):
            yield op.slot + 1, op.wide
        elif isinstance(op, ChildrenOp):
            yield from text_slots(op.table)
