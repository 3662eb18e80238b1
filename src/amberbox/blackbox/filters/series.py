"""All that a change filter looks at, as plain series: one value per row, or a run of values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.filters.watched import Bands, Group, Watched
from amberbox.core.types import ColumnData, IntArray, Ragged, Rows


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Lines of values, one column each; row ``i`` has ``values[offsets[i]:offsets[i + 1]]``.

    Without ``offsets`` each row has one line. Values that are null are 0, or None in objects.
    Without ``bands`` any difference is a change.
    """

    values: NDArray[Any]
    nulls: NDArray[np.bool_] | None
    offsets: IntArray | None
    bands: Bands | None = None

    def of_rows(self, first: int, last: int) -> NDArray[Any]:
        """Return the lines of rows ``first`` to ``last - 1``, one after the other."""
        return self.values[self._places(first, last)]

    def row(self, row: int) -> Series:
        """Return one row as a series of its own that holds nothing else in memory."""
        part = self._places(row, row + 1)
        nulls = None if self.nulls is None else self.nulls[part].copy()
        offsets = None if self.offsets is None else np.array([0, part.stop - part.start])
        return Series(self.values[part].copy(), nulls, offsets, self.bands)

    def _places(self, first: int, last: int) -> slice:
        if self.offsets is None:
            return slice(first, last)
        return slice(int(self.offsets[first]), int(self.offsets[last]))


def flatten(rows: Rows, watched: Watched, offsets: IntArray | None = None) -> Iterator[Series]:
    """Lay the watched columns of a table and of its child tables out as series.

    ``offsets`` says which rows of this table belong to each message, None if each is one message.
    Yields the same number of series, in the same order, for all batches of one schema.
    """
    for group in watched.groups:
        columns = [rows.columns[name] for name in group.names]
        yield from (
            _lists(columns[0], group, offsets)
            if group.is_list
            else [_series(columns, group, offsets)]
        )
    for path, child in watched.children.items():
        starts = np.searchsorted(_parent_rows(rows.children[path]), np.arange(rows.count + 1))
        yield Series(np.diff(starts)[:, None], None, offsets)
        inner = starts if offsets is None else starts[offsets]
        yield from flatten(rows.children[path], child, inner)


def joined(first: Sequence[Series], then: Sequence[Series]) -> list[Series]:
    """Append rows to rows, series by series."""
    return [_join(one, other) for one, other in zip(first, then, strict=True)]


def _series(columns: Sequence[ColumnData], group: Group, offsets: IntArray | None) -> Series:
    plain = [column for column in columns if not isinstance(column, Ragged)]
    values = np.stack([np.ma.filled(column, 0) for column in plain], axis=1)
    if not any(isinstance(column, np.ma.MaskedArray) for column in plain):
        return Series(values, None, offsets, group.bands)
    nulls = np.stack([np.ma.getmaskarray(column) for column in plain], axis=1)
    return Series(values, nulls, offsets, group.bands)


def _lists(column: ColumnData, group: Group, offsets: IntArray | None) -> Iterator[Series]:
    """Yield the lengths (-1 for a null) and then the elements of a list column."""
    lists, lengths = _as_ragged(column)
    yield Series(lengths[:, None], None, offsets)
    inner = lists.offsets if offsets is None else lists.offsets[offsets]
    yield _series([lists.values], group, inner)


def _as_ragged(column: ColumnData) -> tuple[Ragged, IntArray]:
    if isinstance(column, Ragged):
        return column, np.diff(column.offsets)
    lengths = np.array([-1 if row is None else len(row) for row in column], dtype=np.int64)
    offsets = np.concatenate(([0], np.cumsum(np.maximum(lengths, 0))))
    present = [row for row in column if row is not None]
    return Ragged(offsets, np.concatenate(present) if present else np.empty(0)), lengths


def _parent_rows(child: Rows) -> IntArray:
    assert child.parent_row is not None, "a child table says which row each of its rows belongs to"
    return child.parent_row


def _join(first: Series, then: Series) -> Series:
    values = np.concatenate([_compact(first), _compact(then)])
    return Series(values, _joined_nulls(first, then), _joined_offsets(first, then), then.bands)


def _compact(series: Series) -> NDArray[Any]:
    offsets = series.offsets
    return series.values if offsets is None else series.of_rows(0, len(offsets) - 1)


def _joined_nulls(first: Series, then: Series) -> NDArray[np.bool_] | None:
    if first.nulls is None and then.nulls is None:
        return None
    return np.concatenate([_compact(_null_series(first)), _compact(_null_series(then))])


def _null_series(series: Series) -> Series:
    nulls = np.zeros(series.values.shape, bool) if series.nulls is None else series.nulls
    return Series(nulls, None, series.offsets)


def _joined_offsets(first: Series, then: Series) -> IntArray | None:
    if first.offsets is None or then.offsets is None:
        return None
    start = first.offsets - first.offsets[0]
    return np.concatenate([start, then.offsets[1:] - then.offsets[0] + start[-1]])
