"""Rows of a table as JSON messages, with a schema that viewers plot at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.exporting.tables import TableStream
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.query.tabletext import plain, rows_at_once
from amberbox.blackbox.segments.columns import element_type, null_mask
from amberbox.core.clock import NS
from amberbox.core.types import Column, ColumnData, Schema, Topic

ROWS = 2000
"""At most so many rows are turned into text together."""

_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_TYPES = {"bool": "boolean", "string": "string", "float32": "number", "float64": "number"}


def json_topic(stream: TableStream) -> Topic:
    """Return the topic of a table: its item's name, JSON with a schema."""
    columns = {column.name: _property(column) for column in stream.empty.fields}
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": stream.schema.item,
        "type": "object",
        "properties": columns | {"timestamp": _TIME},
    }
    schema = Schema(stream.schema.item, "jsonschema", msgspec.json.encode(document))
    return Topic(stream.schema.item, "json", schema)


def _property(column: Column) -> dict[str, Any]:
    inner = element_type(column.type)
    if inner == "binary":  # viewers refuse a content encoding in a list
        return {"type": "array", "items": {"type": "string"}}
    if inner is not None:
        return {"type": "array", "items": {"type": _TYPES.get(inner, "integer")}}
    if column.type == "binary":
        return {"type": "string", "contentEncoding": "base64"}
    unit = {"description": column.unit} if column.unit else {}
    return {"type": _TYPES.get(column.type, "integer"), **unit}


def json_rows(table: Table) -> Iterator[list[bytes]]:
    """Encode rows, some at a time.

    Times are integer nanoseconds, the first one ``timestamp: {sec, nsec}``; binary is base64. A
    value that is missing is left out of its row. NaN and infinities, which JSON does not have,
    are null.
    """
    step = rows_at_once(list(table.columns.values()), ROWS)
    for start in range(0, len(table), step):
        part = table.take(slice(start, start + step))
        names = part.names
        columns = [_values(name, part.columns[name]) for name in names]
        rows = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
        for name in names:
            _leave_out(rows, name, part.columns[name])
        yield [msgspec.json.encode(row) for row in rows]


def _values(name: str, column: ColumnData) -> Sequence[Any]:
    if name != "timestamp" or not isinstance(column, np.ndarray):
        return plain(column)
    seconds, rest = np.divmod(column, NS)
    pairs = zip(seconds.tolist(), rest.tolist(), strict=True)
    return [{"sec": sec, "nsec": nsec} for sec, nsec in pairs]


def _leave_out(rows: list[dict[str, Any]], name: str, column: ColumnData) -> None:
    for row in np.flatnonzero(null_mask(column)).tolist():
        del rows[row][name]
