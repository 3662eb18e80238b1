"""The own stamp of messages: the column that holds it, and its values as nanoseconds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from amberbox.core.errors import UsageError
from amberbox.core.timestamps import stamp_of
from amberbox.core.types import Column, ItemSchema, Ragged, Rows

_TYPES = frozenset(
    (
        *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
        *("float32", "float64", "time", "string"),
    )
)


def stamp_column(schema: ItemSchema, stamp: str | None) -> Column | None:
    """Find the column of the own stamp: the message's, or the one the configuration names.

    Raises UsageError if there is no such column, or if it can hold no time.
    """
    wanted = schema.stamp if stamp is None else stamp.strip("/").replace(".", "/")
    if not wanted:
        return None
    candidates = [column for column in schema.columns if column.type in _TYPES]
    for column in candidates:
        if column.path == wanted:
            return column
    times = [column.path for column in candidates if column.type == "time"]
    raise UsageError(
        f"{schema.type} has no time stamp {wanted!r}",
        f"it has {', '.join(times)}" if times else "leave stamp empty: receipt time is used",
    )


def with_stamps(rows: Rows, column: Column | None) -> Rows:
    """Return rows with the stamps in a column, 0 where there is none; unchanged without a column.

    Numbers and texts are times as ``core.timestamps.stamp_of`` reads them.
    """
    if column is None:
        return rows
    stamps = rows.columns[column.name]
    assert not isinstance(stamps, Ragged), "a list holds no stamp"
    if column.type != "time":
        stamps = np.array([stamp_of(value) for value in stamps.tolist()], np.int64)
    return replace(rows, stamp_ns=np.ma.filled(stamps, 0))


def first_value(rows: Rows, column: Column) -> Any:
    """Return the value in the first row of a column as Python has it; None if it is empty or 0."""
    values = rows.columns[column.name]
    assert not isinstance(values, Ragged), "a list holds no stamp"
    return values.tolist()[0] or None
