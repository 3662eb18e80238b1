"""Columns in memory as NumPy arrays: take rows, join, fill with nulls, widen."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.types import ColumnData, IntArray, Ragged

RowIndex: TypeAlias = slice | IntArray | NDArray[np.bool_]

NUMPY_TYPES = {
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "bool": "bool",
    "float32": "float32",
    "float64": "float64",
    "time": "int64",
    "duration": "int64",
}


def element_type(column_type: str) -> str | None:
    """Return the element type of a list column; None for any other column."""
    return column_type[5:-1] if column_type.startswith("list<") else None


def numpy_type(column_type: str) -> np.dtype[Any]:
    """Return the dtype that holds a column of this type (object for strings and binary)."""
    return np.dtype(NUMPY_TYPES.get(column_type, "object"))


def empty(column_type: str) -> ColumnData:
    """Return a column without rows."""
    element = element_type(column_type)
    if element is None:
        return np.empty(0, numpy_type(column_type))
    return Ragged(np.zeros(1, np.int64), np.empty(0, numpy_type(element)))


def nulls(column_type: str, count: int) -> ColumnData:
    """Return a column of ``count`` nulls; lists become an object array, as Ragged has no null."""
    if column_type not in NUMPY_TYPES:
        return np.full(count, None, object)
    zeros = np.zeros(count, numpy_type(column_type))
    return np.ma.masked_array(zeros, mask=np.ones(count, bool))


def null_mask(column: ColumnData) -> NDArray[np.bool_]:
    """Return a mask of the rows that are null."""
    if isinstance(column, Ragged):
        return np.zeros(len(column), bool)
    if isinstance(column, np.ma.MaskedArray):
        return np.ma.getmaskarray(column)
    if column.dtype == object:
        return np.fromiter((value is None for value in column), bool, len(column))
    return np.zeros(len(column), bool)


def take(column: ColumnData, rows: RowIndex) -> ColumnData:
    """Return the given rows of a column."""
    if not isinstance(column, Ragged):
        return column[rows]
    if isinstance(rows, slice):
        start, stop, step = rows.indices(len(column))
        if step == 1:
            return Ragged(column.offsets[start : max(start, stop) + 1], column.values)
    wanted = np.arange(len(column))[rows]
    starts = column.offsets[wanted]
    offsets = offsets_of(column.offsets[wanted + 1] - starts)
    return Ragged(offsets, column.values[ranges(starts, offsets)])


def offsets_of(counts: Sequence[int] | IntArray) -> IntArray:
    """Return the offsets of rows of these lengths, beginning with 0."""
    offsets = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    return offsets


def ranges(starts: IntArray, offsets: IntArray) -> IntArray:
    """Return the value indices of rows that begin at ``starts``, of the lengths in ``offsets``."""
    places: IntArray = np.repeat(starts - offsets[:-1], np.diff(offsets))
    return places + np.arange(offsets[-1])


def compact(column: Ragged) -> Ragged:
    """Return the same lists with offsets from 0 and without values that no row uses."""
    first, last = int(column.offsets[0]), int(column.offsets[-1])
    if first == 0 and last == len(column.values):
        return column
    return Ragged(column.offsets - first, column.values[first:last])


def concatenate(columns: Sequence[ColumnData]) -> ColumnData:
    """Join columns of one type."""
    if len(columns) == 1:
        return columns[0]
    lists = [compact(column) for column in columns if isinstance(column, Ragged)]
    if len(lists) == len(columns):
        lengths = np.concatenate([np.diff(column.offsets) for column in lists])
        return Ragged(offsets_of(lengths), np.concatenate([column.values for column in lists]))
    arrays = [lists_as_objects(c) if isinstance(c, Ragged) else c for c in columns]
    if any(isinstance(array, np.ma.MaskedArray) for array in arrays):
        values = np.concatenate([np.ma.getdata(array) for array in arrays])
        return np.ma.masked_array(values, mask=np.concatenate([null_mask(a) for a in arrays]))
    return np.concatenate(arrays)


def lists_as_objects(column: Ragged) -> NDArray[Any]:
    """Return a list column as an object array of arrays, which can hold None."""
    rows = np.empty(len(column), object)
    for row in range(len(column)):
        rows[row] = column[row]
    return rows


def wider(first: str, second: str) -> str:
    """Return the type that holds both: int -> float -> string; lists by their elements."""
    if first == second:
        return first
    inner = element_type(first), element_type(second)
    if inner[0] is not None and inner[1] is not None:
        return f"list<{wider(inner[0], inner[1])}>"
    if _is_number(first) and _is_number(second):
        return np.result_type(numpy_type(first), numpy_type(second)).name
    return "string"


def _is_number(column_type: str) -> bool:
    return column_type in NUMPY_TYPES and column_type != "bool"


def cast(column: ColumnData, old: str, new: str) -> ColumnData:
    """Widen a column from one type to another (see ``wider``)."""
    if old == new:
        return column
    inner = element_type(old), element_type(new)
    if isinstance(column, Ragged):
        if inner[0] is None or inner[1] is None:
            return objects(json_text(column[row].tolist()) for row in range(len(column)))
        values = cast(column.values, inner[0], inner[1])
        assert not isinstance(values, Ragged)
        return Ragged(column.offsets, values)
    if new in NUMPY_TYPES:
        return column.astype(numpy_type(new))
    return objects(None if value is None else json_text(value) for value in column.tolist())


def objects(values: Iterable[Any]) -> NDArray[Any]:
    """Return a one-dimensional object array of any values."""
    listed = list(values)
    array = np.empty(len(listed), object)
    array[:] = listed
    return array


def json_text(value: Any) -> str:
    """Return a value as JSON text; a string is returned unchanged."""
    if isinstance(value, str):
        return value
    return value.hex() if isinstance(value, bytes) else json.dumps(value, default=str)


def element(column: ColumnData, index: int) -> ColumnData:
    """Return one element of each list; null where the list is shorter."""
    if not isinstance(column, Ragged):
        return _object_element(column, index)
    lengths = np.diff(column.offsets)
    place = index if index >= 0 else lengths + index
    inside = (place >= 0) & (place < lengths)
    values = np.zeros(len(column), column.values.dtype)
    values[inside] = column.values[(column.offsets[:-1] + place)[inside]]
    if values.dtype == object:
        values[~inside] = None
        return values
    return values if inside.all() else np.ma.masked_array(values, mask=~inside)


def _object_element(column: NDArray[Any], index: int) -> ColumnData:
    """Return one element of each list in an object array (a list column with nulls)."""
    present = [row is not None and -len(row) <= index < len(row) for row in column]
    picked = [row[index] if here else None for row, here in zip(column, present, strict=True)]
    kinds = {type(value) for value in picked if value is not None}
    if not kinds or issubclass(next(iter(kinds)), str | bytes):
        return objects(picked)
    mask = ~np.array(present, bool)
    return np.ma.masked_array(np.array([0 if v is None else v for v in picked]), mask=mask)
