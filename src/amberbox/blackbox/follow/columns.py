"""Batches out of segments: a journal's rows after its file is gone, in the order they came."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.segments import columns as col
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.flat import Flat, TableSchema, join
from amberbox.blackbox.segments.manifest import Manifest, Part, Segment
from amberbox.core.types import Batch, ColumnData, Gap, ItemSchema, Ragged

WINDOW_ROWS = 4096
_KEYS = ("index", "parent_index")


def can_read() -> bool:
    """Tell whether segments can be read here (pyarrow is installed)."""
    return importlib.util.find_spec("pyarrow") is not None


@dataclass(frozen=True, slots=True)
class Stretch:
    """Rows of a journal, or of several: ``[first_seq, end_seq)`` of a writer's run."""

    journal: str
    writer: str
    run: int
    first_seq: int
    end_seq: int

    def meets(self, part: Part) -> bool:
        """Tell whether a part of a segment may have rows of it."""
        same = (part.writer, part.run) == (self.writer, self.run)
        return same and part.last_seq >= self.first_seq and part.first_seq < self.end_seq


class TableRows:
    """One table's rows of a stretch, in ``seq`` order, read one row group at a time."""

    def __init__(self, store: Path, segment: Segment, schema: TableSchema, of: Stretch) -> None:
        self.schema = schema
        self.damage = ""
        self._store = store
        self._segment = segment
        self._path = segment.path
        self._flats = _row_groups(store, segment, schema, of)
        self._none = _empty(schema, of)
        self._next = self._none
        self._read_on()

    @property
    def next_seq(self) -> int | None:
        """Position of the next row; None after the last one."""
        return int(self._next.seq[0]) if len(self._next) else None

    def take(self, end_seq: int) -> Flat:
        """Return the rows before ``end_seq`` that were not taken yet."""
        taken = []
        while len(self._next):
            cut = int(np.searchsorted(self._next.seq, end_seq))
            taken.append(self._next.take(slice(0, cut)))
            if cut < len(self._next):
                self._next = self._next.take(slice(cut, None))
                break
            self._read_on()
        found = [flat for flat in taken if len(flat)]
        return join(found) if found else self._none

    def _read_on(self) -> None:
        try:
            self._next = next((flat for flat in self._flats if len(flat)), self._none)
        except mf.UNREADABLE as error:
            if not mf.is_listed(self._store, self._segment):  # joined or deleted meanwhile
                raise FileNotFoundError(self._path) from error
            self.damage = f"{self._path} is damaged: {mf.why(error)}"
            self._next = self._none


def _row_groups(store: Path, segment: Segment, schema: TableSchema, of: Stretch) -> Iterator[Flat]:
    from amberbox.blackbox.segments.parquet import read_row_group, row_groups

    names = {column.name for column in schema.columns}
    for group in row_groups(store, segment, schema, "received"):
        for flat in read_row_group(store, segment, schema, names, group.number):
            if (flat.writer, flat.run) == (of.writer, of.run):
                yield flat.take((flat.seq >= of.first_seq) & (flat.seq < of.end_seq))


def _empty(schema: TableSchema, of: Stretch) -> Flat:
    none = np.empty(0, np.int64)
    columns = {column.name: col.empty(column.type) for column in schema.columns}
    return Flat(schema, of.writer, of.run, none, none, none, none, columns)


def tables_of(
    store: Path, known: Manifest, of: Stretch, items: Collection[str] | None
) -> list[TableRows]:
    """Open the tables of the given items (None: all) that have rows of a stretch."""
    found = []
    for segments in known.segments.values():
        for segment in segments:
            schema = known.schemas[segment.schema]
            wanted = items is None or (schema.parent or schema.item) in items
            if wanted and any(of.meets(part) for part in segment.parts):
                found.append(TableRows(store, segment, schema, of))
    return found


def windows(tables: Sequence[TableRows], of: Stretch) -> Iterator[int]:
    """Give positions up to which rows may be taken together, each once those before are taken.

    No table has rows of two versions of its schema in one piece.
    """
    begins = sorted({table.next_seq for table in tables if table.next_seq is not None})
    while True:
        waiting = [table.next_seq for table in tables if table.next_seq is not None]
        if not waiting:
            break
        first = min(waiting)
        later = (begin for begin in begins if begin > first)
        end_seq = min(first + WINDOW_ROWS, next(later, of.end_seq))
        if end_seq >= of.end_seq:
            break
        yield end_seq
    yield of.end_seq


def batches(tables: Sequence[TableRows], end_seq: int) -> list[Batch]:
    """Take all rows before ``end_seq``: a batch per item, in the order of their first rows."""
    taken = [table.take(end_seq) for table in tables]
    tops = [flat for flat in taken if len(flat) and not flat.schema.parent]
    made = [_batch(flat, _children(flat, taken)) for flat in tops]
    return sorted(made, key=lambda batch: int(batch.seq[0]))


def damage(tables: Sequence[TableRows]) -> Iterator[tuple[str, str]]:
    """Name the tables that could not be read to their end, and why, once."""
    for table in tables:
        if table.damage:
            why, table.damage = table.damage, ""
            yield table.schema.item, why


def _children(top: Flat, taken: Sequence[Flat]) -> dict[str, Flat]:
    """Return the child tables of an item by name, with the rows of these messages only."""
    mine = [flat for flat in taken if flat.schema.parent == top.schema.item]
    tables: dict[str, Flat] = {}
    for flat in mine:  # of two versions the one that has rows here
        if flat.schema.item not in tables or len(flat):
            tables[flat.schema.item] = flat
    return {name: flat.take(np.isin(flat.seq, top.seq)) for name, flat in tables.items()}


def _batch(flat: Flat, below: Mapping[str, Flat]) -> Batch:
    """Build a batch with the child tables among ``below`` that hang directly on it."""
    name, schema = flat.schema.item, flat.schema
    direct = [n for n in below if n.startswith(f"{name}__") and not _between(name, n, below)]
    children = {n.removeprefix(f"{name}__"): _batch(below[n], below) for n in direct}
    keys: dict[str, ColumnData] = {"parent_seq": flat.seq} if schema.parent else {}
    own = tuple(c for c in schema.columns if not (schema.parent and c.name in _KEYS))
    stamp = "" if schema.parent else schema.stamp
    below_schemas = {path: child.schema for path, child in children.items()}
    return Batch(
        item=name,
        schema=ItemSchema(schema.type, own, below_schemas, stamp),
        writer=flat.writer,
        run=flat.run,
        seq=flat.seq,
        log_time_ns=flat.log_time_ns,
        received_ns=flat.received_ns,
        timestamp_ns=flat.timestamp_ns,
        columns={**keys, **flat.columns},
        children=children,
        topic=schema.topic,
        source=schema.source,
    )


def _between(name: str, below: str, tables: Mapping[str, Flat]) -> bool:
    """Tell whether a table hangs on another one that is nearer than ``name``."""
    return any(
        other not in (name, below)
        and other.startswith(f"{name}__")
        and below.startswith(f"{other}__")
        for other in tables
    )


def rest_of(batch: Batch, from_seq: int) -> Batch | None:
    """Leave out what has been read before; None when nothing is left."""
    if int(batch.seq[0]) >= from_seq:
        return batch
    rows = batch.seq >= from_seq
    return _taken(batch, from_seq) if rows.any() else None


def _taken(batch: Batch, from_seq: int) -> Batch:
    rows = batch.seq >= from_seq
    return replace(
        batch,
        seq=batch.seq[rows],
        log_time_ns=batch.log_time_ns[rows],
        received_ns=batch.received_ns[rows],
        timestamp_ns=batch.timestamp_ns[rows],
        columns={name: col.take(column, rows) for name, column in batch.columns.items()},
        children={path: _taken(child, from_seq) for path, child in batch.children.items()},
    )


def gaps_recorded(batch: Batch) -> Iterator[Gap]:
    """Turn the closed gap records of a batch of the gap channel into gaps."""
    names = ("from_ns", "to_ns", "reason", "item", "count")
    values = [_plain(batch.columns.get(name), len(batch)) for name in names]
    offsets = (batch.received_ns - batch.log_time_ns).tolist()
    for offset, from_ns, to_ns, reason, item, count in zip(offsets, *values, strict=True):
        if to_ns is not None:
            edges = from_ns + offset, to_ns + offset
            yield Gap(batch.writer, batch.run, *edges, reason, item, count)


def _plain(column: ColumnData | None, count: int) -> list[Any]:
    return [None] * count if column is None or isinstance(column, Ragged) else column.tolist()
