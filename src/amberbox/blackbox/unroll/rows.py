"""Rows put together from parts, and put into another order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.types import ColumnData, IntArray, Ragged, Rows


def concat_rows(parts: Sequence[Rows]) -> Rows:
    """Append tables with the same columns, in the order given."""
    first = parts[0]
    if len(parts) == 1:
        return first
    bases = np.cumsum([0] + [part.count for part in parts]).tolist()
    return Rows(
        bases[-1],
        {name: _concat([part.columns[name] for part in parts]) for name in first.columns},
        {
            path: _concat_children([part.children[path] for part in parts], bases)
            for path in first.children
        },
        _concat_ints([part.stamp_ns for part in parts]),
        _concat_ints([part.parent_row for part in parts]),
        _concat_ints([part.index for part in parts]),
    )


def _concat_children(parts: Sequence[Rows], bases: Sequence[int]) -> Rows:
    moved = [_with_parents(part, base) for part, base in zip(parts, bases, strict=False)]
    return concat_rows(moved)


def _with_parents(rows: Rows, base: int) -> Rows:
    parent_row = None if rows.parent_row is None else rows.parent_row + base
    return Rows(rows.count, rows.columns, rows.children, rows.stamp_ns, parent_row, rows.index)


def _concat(parts: Sequence[ColumnData]) -> ColumnData:
    arrays = [part for part in parts if not isinstance(part, Ragged)]
    if arrays:
        masked = any(isinstance(array, np.ma.MaskedArray) for array in arrays)
        join: Callable[..., NDArray[Any]] = np.ma.concatenate if masked else np.concatenate
        return join(arrays)
    lists = [part for part in parts if isinstance(part, Ragged)]
    counts = np.concatenate([np.diff(part.offsets) for part in lists])
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    return Ragged(offsets, np.concatenate([part.values for part in lists]))


def _concat_ints(parts: Sequence[IntArray | None]) -> IntArray | None:
    arrays = [part for part in parts if part is not None]
    return np.concatenate(arrays) if arrays else None


def take_rows(rows: Rows, order: IntArray) -> Rows:
    """Pick rows by number; child rows follow their parents and keep their own order."""
    return Rows(
        len(order),
        {name: _take(column, order) for name, column in rows.columns.items()},
        {path: _take_children(child, rows.count, order) for path, child in rows.children.items()},
        None if rows.stamp_ns is None else rows.stamp_ns[order],
    )


def _take(column: ColumnData, order: IntArray) -> ColumnData:
    if not isinstance(column, Ragged):
        return column[order]
    starts, counts = column.offsets[:-1][order], np.diff(column.offsets)[order]
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    return Ragged(offsets, column.values[_ranges(starts, counts)])


def _take_children(child: Rows, parents: int, order: IntArray) -> Rows:
    if child.parent_row is None or child.index is None:
        raise ValueError("a child table without parents")
    counts = np.bincount(child.parent_row, minlength=parents)[order]
    starts = np.searchsorted(child.parent_row, order)
    picked = _ranges(starts, counts)
    taken = take_rows(child, picked)
    parent_row = np.repeat(np.arange(len(order), dtype=np.int64), counts)
    return Rows(taken.count, taken.columns, taken.children, None, parent_row, child.index[picked])


def _ranges(starts: IntArray, counts: IntArray) -> IntArray:
    """Join ``arange(start, start + count)`` of all rows."""
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    shift: IntArray = np.repeat(starts - (ends - counts), counts)
    return np.arange(total, dtype=np.int64) + shift
