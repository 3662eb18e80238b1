"""The values of a DiagnosticArray by name and key: a child table beside those of its definition.

One row per status and key, so that one condition names a status and a value of it.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from amberbox.blackbox.columns.arrays import offsets_of, take
from amberbox.core.types import Column, ColumnData, ItemSchema, Rows

PATH = "by_key"
_TYPES = ("diagnostic_msgs/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticArray")
_OF_STATUS = ("name", "hardware_id", "level")
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|nan)\s*", re.I)


def has_values(schema: ItemSchema) -> bool:
    """Return whether messages are a DiagnosticArray with the fields that its package has."""
    status = schema.children.get("status")
    if schema.type not in _TYPES or status is None or "values" not in status.children:
        return False
    values = {column.path for column in status.children["values"].columns}
    return values >= {"key", "value"} and {c.path for c in status.columns} >= set(_OF_STATUS)


def with_values_schema(schema: ItemSchema) -> ItemSchema:
    """Return the schema of a DiagnosticArray with the additional table."""
    status = {column.path: column for column in schema.children["status"].columns}
    columns = (
        *(status[path] for path in _OF_STATUS),
        Column("key", "key", "string"),
        Column("value", "value", "string"),
        Column("number", "number", "float64"),
    )
    table = ItemSchema("diagnostic_msgs/KeyValue by name and key", columns)
    return replace(schema, children={**schema.children, PATH: table})


def with_values(rows: Rows) -> Rows:
    """Add the rows of the additional table; ``number`` is null where a value is none."""
    status = rows.children["status"]
    values = status.children["values"]
    assert status.parent_row is not None
    assert values.parent_row is not None
    message = status.parent_row[values.parent_row]
    first = offsets_of(np.bincount(message, minlength=rows.count))[message]
    texts = values.columns["value"]
    assert isinstance(texts, np.ndarray)
    numbers = [float(text) if _NUMBER.fullmatch(text) else None for text in texts]
    columns: dict[str, ColumnData] = {
        **{name: take(status.columns[name], values.parent_row) for name in _OF_STATUS},
        "key": values.columns["key"],
        "value": texts,
        "number": np.ma.MaskedArray(
            np.array([number or 0.0 for number in numbers], np.float64),
            mask=np.array([number is None for number in numbers], bool),
        ),
    }
    table = Rows(values.count, columns, {}, None, message, np.arange(values.count) - first)
    return replace(rows, children={**rows.children, PATH: table})
