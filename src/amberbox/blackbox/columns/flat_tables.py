"""Flat tables: the rows of an item, or of a child table of it, with their schema."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.core.names import child_name
from amberbox.core.types import Batch, Column, ColumnData, IntArray, ItemSchema


@dataclass(frozen=True, slots=True)
class TableSchema:
    """The columns of a table; written into each segment and into the manifest.

    ``parent`` is the item whose messages hold a child table: then ``seq`` is the message's, and
    the first columns are ``index`` and, for a grandchild, ``parent_index``.
    """

    item: str
    type: str
    columns: tuple[Column, ...]
    stamp: str = ""
    parent: str = ""
    topic: str = ""
    source: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the schema as plain data."""
        names = ("item", "type", "stamp", "parent", "topic", "source")
        return {name: getattr(self, name) for name in names} | {
            "columns": [_column_to_json(column) for column in self.columns]
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> TableSchema:
        """Read what ``to_json`` returned."""
        return msgspec.convert(data, cls, str_keys=True)

    @property
    def id(self) -> str:
        """Return the id of the schema: 16 hex digits of a hash of its content."""
        return _schema_id(self)

    def column(self, name: str) -> Column | None:
        """Find a column by its exact name."""
        return next((column for column in self.columns if column.name == name), None)

    def __hash__(self) -> int:
        return hash((self.item, self.type, len(self.columns)))


def _column_to_json(column: Column) -> dict[str, Any]:
    data: dict[str, Any] = {"name": column.name, "path": column.path, "type": column.type}
    if column.unit:
        data["unit"] = column.unit
    if column.labels:
        data["labels"] = {str(number): text for number, text in column.labels.items()}
    return data


@lru_cache(maxsize=4096)
def _schema_id(schema: TableSchema) -> str:
    text = json.dumps(schema.to_json(), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True, eq=False)
class FlatTable:
    """Rows of one table: one schema, one writer's run. ``seq`` is the parent's in a child."""

    schema: TableSchema
    writer: str
    run: int
    seq: IntArray
    log_time_ns: IntArray
    received_ns: IntArray
    timestamp_ns: IntArray
    columns: Mapping[str, ColumnData] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.seq)

    def take(self, rows: col.RowIndex) -> FlatTable:
        """Return the given rows."""
        return FlatTable(
            self.schema,
            self.writer,
            self.run,
            self.seq[rows],
            self.log_time_ns[rows],
            self.received_ns[rows],
            self.timestamp_ns[rows],
            {name: col.take(column, rows) for name, column in self.columns.items()},
        )

    def with_columns(self, columns: Mapping[str, ColumnData]) -> FlatTable:
        """Return the same rows with these columns only."""
        return replace(self, columns=columns)


def join_tables(flats: Sequence[FlatTable]) -> FlatTable:
    """Join rows of one schema and one writer's run."""
    first = flats[0]
    if len(flats) == 1:
        return first
    return FlatTable(
        first.schema,
        first.writer,
        first.run,
        np.concatenate([flat.seq for flat in flats]),
        np.concatenate([flat.log_time_ns for flat in flats]),
        np.concatenate([flat.received_ns for flat in flats]),
        np.concatenate([flat.timestamp_ns for flat in flats]),
        {name: col.concatenate([f.columns[name] for f in flats]) for name in first.columns},
    )


def flatten(batch: Batch) -> Iterator[FlatTable]:
    """Yield a batch and, recursively, its child tables as flat tables."""
    yield from _flatten(batch, "", batch.schema.stamp)


def _flatten(batch: Batch, parent: str, stamp: str) -> Iterator[FlatTable]:
    keys = [key for key in ("index", "parent_index") if parent and key in batch.columns]
    schema = _table(batch.item, batch.schema, keys, parent, stamp, batch.topic, batch.source)
    yield FlatTable(
        schema,
        batch.writer,
        batch.run,
        batch.seq,
        batch.log_time_ns,
        batch.received_ns,
        batch.timestamp_ns,
        {column.name: batch.columns[column.name] for column in schema.columns},
    )
    for child in batch.children.values():
        yield from _flatten(child, parent or batch.item, stamp)


def _table(
    item: str,
    schema: ItemSchema,
    keys: Sequence[str],
    parent: str,
    stamp: str,
    topic: str,
    source: str,
) -> TableSchema:
    columns = (*(Column(key, key, "int64") for key in keys), *schema.columns)
    return TableSchema(item, schema.type, columns, stamp, parent, topic, source)


def tables_of(item: str, schema: ItemSchema, topic: str, source: str) -> list[TableSchema]:
    """Return the schemas of the tables that an item's batches flatten to."""
    tables = [_table(item, schema, (), "", schema.stamp, topic, source)]
    for path, child in schema.children.items():
        name = child_name(item, path)
        tables += _child_tables(name, child, tables[0], ("index",))
    return tables


def _child_tables(
    name: str, schema: ItemSchema, top: TableSchema, keys: Sequence[str]
) -> list[TableSchema]:
    tables = [_table(name, schema, keys, top.item, top.stamp, top.topic, top.source)]
    for path, child in schema.children.items():
        below = child_name(name, path)
        tables += _child_tables(below, child, top, ("index", "parent_index"))
    return tables
