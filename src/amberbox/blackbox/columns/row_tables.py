"""Tables of rows with child tables: append them, take rows, put them in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amberbox.blackbox.columns.arrays import concatenate, offsets_of, ranges, take
from amberbox.core.types import IntArray, Rows


def concat_rows(parts: Sequence[Rows]) -> Rows:
    """Append tables with the same columns, in the order given."""
    first = parts[0]
    if len(parts) == 1:
        return first
    bases = np.cumsum([0] + [part.count for part in parts]).tolist()
    return Rows(
        bases[-1],
        {name: concatenate([part.columns[name] for part in parts]) for name in first.columns},
        {
            path: concat_rows(
                [
                    replace(part.children[path], parent_row=_moved(part.children[path], base))
                    for part, base in zip(parts, bases, strict=False)
                ]
            )
            for path in first.children
        },
        _concat_ints([part.stamp_ns for part in parts]),
        _concat_ints([part.parent_row for part in parts]),
        _concat_ints([part.index for part in parts]),
    )


def _moved(child: Rows, base: int) -> IntArray | None:
    return None if child.parent_row is None else child.parent_row + base


def _concat_ints(parts: Sequence[IntArray | None]) -> IntArray | None:
    arrays = [part for part in parts if part is not None]
    return np.concatenate(arrays) if arrays else None


def take_rows(rows: Rows, order: IntArray) -> Rows:
    """Return rows by number; child rows follow their parents and keep their own order."""
    return Rows(
        len(order),
        {name: take(column, order) for name, column in rows.columns.items()},
        {path: _take_children(child, rows.count, order) for path, child in rows.children.items()},
        None if rows.stamp_ns is None else rows.stamp_ns[order],
    )


def _take_children(child: Rows, parents: int, order: IntArray) -> Rows:
    if child.parent_row is None or child.index is None:
        raise ValueError("a child table without parents")
    counts = np.bincount(child.parent_row, minlength=parents)[order]
    starts = np.searchsorted(child.parent_row, order)
    picked = ranges(starts, offsets_of(counts))
    taken = take_rows(child, picked)
    parent_row = np.repeat(np.arange(len(order), dtype=np.int64), counts)
    return Rows(taken.count, taken.columns, taken.children, None, parent_row, child.index[picked])


def join_in_order(parts: Sequence[Rows], members: Sequence[IntArray]) -> Rows:
    """Append tables and put their rows in the order of the messages they came from."""
    if len(parts) == 1:
        return parts[0]
    return take_rows(concat_rows(parts), np.argsort(np.concatenate(members)))
