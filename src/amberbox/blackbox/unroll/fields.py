"""A message definition as a flat table: fields are columns, lists of structures child tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from amberbox.blackbox.unroll.contract import check_places
from amberbox.blackbox.unroll.definition import FILLER, HEADER, Definition, FieldType, Structure
from amberbox.blackbox.unroll.labels import field_labels
from amberbox.blackbox.unroll.units import known_unit
from amberbox.core.errors import AmberboxError
from amberbox.core.names import unique_names
from amberbox.core.types import Column, ItemSchema

LONGEST_UNROLLED = 64
MOST_COLUMNS = 4096
"""A fixed array of structures that would unroll into more columns becomes a child table."""
DEEPEST = 12
"""Child tables within child tables; Python itself compiles no reader for 20."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A number, bool, time or duration of fixed size; one byte that says nothing if None."""

    column: Column | None


@dataclass(frozen=True, slots=True)
class Text:
    """A string with its length before it; ``wide`` has 4 bytes per UTF-16 unit."""

    column: Column
    wide: bool


@dataclass(frozen=True, slots=True)
class Numbers:
    """A sequence, or a long fixed array, of ``item``: a list column or a binary one."""

    column: Column
    item: str
    count: int | None


@dataclass(frozen=True, slots=True)
class Texts:
    """A sequence, or a long fixed array, of strings."""

    column: Column
    wide: bool
    count: int | None


@dataclass(frozen=True, slots=True)
class Children:
    """A sequence, or a long fixed array, of structures."""

    path: str
    table: Table
    count: int | None


Entry: TypeAlias = Scalar | Text | Numbers | Texts | Children


@dataclass(frozen=True, slots=True)
class Table:
    """Entries in wire order with the schema of the rows they make."""

    entries: tuple[Entry, ...]
    schema: ItemSchema


def flatten(definition: Definition, type_name: str, ros1: bool) -> Table:
    """Lay a message type out as a table; ``schema.stamp`` is the message's own stamp, if any."""
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


def _own_stamp(structure: Structure) -> str:
    singles = [(name, field.base) for name, field in structure.fields if field.count is None]
    headers = [f"{name}/stamp" for name, base in singles if base == HEADER]
    stamps = [name for name, base in singles if name == "stamp" and base == "time"]
    return next(iter(headers + stamps), "")


def _table(definition: Definition, name: str, type_name: str, ros1: bool) -> Table:
    entries = list(_Walk(definition, ros1).structure(name, "", ""))
    columns = [c for entry in entries if (c := getattr(entry, "column", None)) is not None]
    names = unique_names(column.path for column in columns)
    children = {e.path: e.table.schema for e in entries if isinstance(e, Children)}
    return Table(
        tuple(_named(entry, names) for entry in entries),
        ItemSchema(type_name, tuple(replace(c, name=names[c.path]) for c in columns), children),
    )


def _named(entry: Entry, names: Mapping[str, str]) -> Entry:
    if isinstance(entry, Children) or entry.column is None:
        return entry
    return replace(entry, column=replace(entry.column, name=names[entry.column.path]))


@dataclass(frozen=True, slots=True)
class _Walk:
    """One pass over a definition; columns are named when all paths are known."""

    definition: Definition
    ros1: bool
    _widths: dict[str, int] = field(default_factory=dict)
    _places: dict[str, int] = field(default_factory=dict)
    _depths: dict[str, int] = field(default_factory=dict)

    def structure(self, name: str, path: str, unit: str) -> Iterator[Entry]:
        structure = self.definition.structures[name]
        if not structure.fields and not self.ros1:
            yield Scalar(None)  # DDS sends one byte for a structure without members
        labels = field_labels(structure)
        for member, field_type in structure.fields:
            place = f"{path}/{member}" if path else member
            field_unit = known_unit(name, member) or unit
            column = Column("", place, field_type.base, field_unit, labels.get(member, {}))
            yield from self.field(column, field_type)

    def field(self, column: Column, kind: FieldType) -> Iterator[Entry]:
        if column.path.endswith(FILLER):
            yield Scalar(None)
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
            yield Text(_plain(column, "string"), base == "wstring")
        else:
            yield Scalar(_plain(column, self.number(base)))

    def number(self, base: str) -> str:
        """Resolve ``byte``: signed in ROS 1, an octet in ROS 2."""
        return base if base != "byte" else ("int8" if self.ros1 else "uint8")

    def many(self, column: Column, count: int | None) -> Entry:
        base = column.type
        if base in self.definition.structures:
            table = _table(self.definition, base, base.replace("/msg/", "/"), self.ros1)
            return Children(column.path, table, count)
        if base in ("string", "wstring"):
            return Texts(_plain(column, "list<string>"), base == "wstring", count)
        kind = "binary" if base in ("uint8", "byte") else f"list<{base}>"
        return Numbers(_plain(column, kind), self.number(base), count)

    def is_unrolled(self, kind: FieldType) -> bool:
        """Tell whether a fixed array becomes columns, not a list or a child table."""
        count = kind.count or 0
        return 0 <= count <= LONGEST_UNROLLED and count * self.width(kind.base) <= MOST_COLUMNS

    def width(self, base: str) -> int:
        """Count the columns of one value, up to ``MOST_COLUMNS`` and one."""
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
        """Count what a walk over one value visits, child tables and empty structures included."""
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
        """Count how deep child tables lie within each other."""
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
