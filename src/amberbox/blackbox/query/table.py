"""A table, the answer to a query: named, typed columns for Arrow, pandas, polars or a file.

``downsample`` thins out rows for plotting so that no extreme and no gap disappears.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns import table_text
from amberbox.blackbox.columns.arrays import null_mask
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, ColumnData, IntArray, Ragged

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows in order of time. ``fields`` describe each column (type, unit, labels).

    A column is a numpy array, a masked array where values may be null, an object array of strings
    or bytes, or ``Ragged`` for lists. Times are int64 nanoseconds since the Unix epoch. ``notes``
    name the unreadable parts.
    """

    item: str
    fields: tuple[Column, ...]
    columns: Mapping[str, ColumnData]
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, name: str) -> ColumnData:
        return self.columns[name]

    def __repr__(self) -> str:
        return table_text.preview(self.item, self.fields, self.columns, len(self))

    @property
    def names(self) -> list[str]:
        """Return the names of the columns."""
        return [column.name for column in self.fields]

    def take(self, rows: col.RowIndex) -> Table:
        """Return the given rows."""
        columns = {name: col.take(column, rows) for name, column in self.columns.items()}
        return Table(self.item, self.fields, columns, self.notes)

    def values(self, name: str) -> list[Any]:
        """Return a column as plain Python values; times as int, nulls as None."""
        return table_text.plain(self.columns[name])

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield each row as plain Python values; times as int, nulls as None."""
        for row in zip(*map(self.values, self.names), strict=True):
            yield dict(zip(self.names, row, strict=True))

    def to_arrow(self) -> pa.Table:
        """Return a pyarrow Table; times are ``timestamp[ns, UTC]``."""
        import pyarrow as pa

        from amberbox.blackbox.columns.arrow import to_arrow

        arrays = [to_arrow(self.columns[f.name], f.type) for f in self.fields]
        return pa.Table.from_arrays(arrays, names=self.names)

    def to_pandas(self) -> pd.DataFrame:
        """Return a pandas DataFrame; raises UsageError without pandas."""
        _need("pandas")
        return self.to_arrow().to_pandas()

    def to_polars(self) -> pl.DataFrame:
        """Return a polars DataFrame; raises UsageError without polars."""
        _need("polars")
        import polars as pl

        frame = pl.from_arrow(self.to_arrow())
        assert isinstance(frame, pl.DataFrame)
        return frame

    def to_csv(
        self, to: IO[str] | Path | str, *, header: bool = True, raw_text: bool = False
    ) -> None:
        """Write comma-separated values: times as RFC 3339, nulls empty, lists as JSON.

        Text that a spreadsheet would run as a formula (it begins with ``= + - @``, a tab or a
        carriage return) gets a ``'`` before it, unless ``raw_text``.
        """
        with _opened(to) as file:
            table_text.write_csv(file, self.fields, self.columns, header=header, raw_text=raw_text)

    def to_json(self, to: IO[str] | Path | str, *, lines: bool = False) -> None:
        """Write a JSON array of objects, or one object per line; times as RFC 3339 strings."""
        with _opened(to) as file:
            table_text.write_json(file, self.fields, self.columns, lines=lines)

    def to_parquet(self, path: Path | str) -> None:
        """Write a Parquet file (zstd)."""
        import pyarrow.parquet as pq

        pq.write_table(self.to_arrow(), str(path), compression="zstd")


def _need(package: str) -> None:
    if find_spec(package) is None:
        raise UsageError(f"{package} is not installed here", f"pip install {package}")


@contextmanager
def _opened(to: IO[str] | Path | str) -> Iterator[IO[str]]:
    """Open a path for writing; leave an open file as it is."""
    if not isinstance(to, str | Path):
        yield to
        return
    with Path(to).open("w", encoding="utf-8", newline="") as file:
        yield file


_PER_BUCKET = 4


def downsample(columns: Sequence[ColumnData], count: int, points: int) -> IntArray:
    """Choose at most ``points`` of ``count`` rows, in order.

    The rows are cut into buckets of equal length. Of each column every bucket keeps its smallest
    and its largest value, its first and last row, and one missing value (null or NaN) if it has
    any, so that a gap stays a gap; this needs at least 5 points per column, with fewer some of
    these are dropped. Columns that are not numbers keep the first and last row of each bucket.
    ``tsdownsample`` is used where installed, with the same guarantee.
    """
    if count <= points:
        return np.arange(count)
    share = max(points // max(len(columns), 1), _PER_BUCKET)
    chosen = [_choose(column, share) for column in columns] or [_edges(count, points // 2)]
    rows = np.unique(np.concatenate(chosen))
    return rows if len(rows) <= points else rows[_evenly(len(rows), points)]


def _evenly(count: int, points: int) -> IntArray:
    places: IntArray = np.linspace(0, count - 1, points).astype(np.int64)
    return places


def _choose(column: ColumnData, points: int) -> IntArray:
    values = None if isinstance(column, Ragged) else _as_numbers(column)
    if values is None:
        return _edges(len(column), max(points // 2, 1))
    nulls = null_mask(column)
    missing = nulls | np.isnan(values) if values.dtype.kind == "f" else nulls
    if missing.any():
        return _extremes(values, missing, max(points // (_PER_BUCKET + 1), 1))
    buckets = max(points // _PER_BUCKET, 1)
    try:
        from tsdownsample import M4Downsampler
    except ImportError:
        return _extremes(values, np.zeros(len(values), bool), buckets)
    sampler: Any = M4Downsampler
    rows = sampler().downsample(np.ascontiguousarray(values), n_out=buckets * _PER_BUCKET)
    return np.asarray(rows, np.int64)


def _as_numbers(column: NDArray[Any]) -> NDArray[Any] | None:
    values = np.ma.getdata(column)
    if values.dtype == bool:
        return values.view(np.uint8)
    return values if values.dtype.kind in "iuf" else None


def _bounds(count: int, buckets: int) -> IntArray:
    """Return the first row of each bucket, and the end of the last."""
    edges: IntArray = np.linspace(0, count, min(buckets, count) + 1).astype(np.int64)
    return edges


def _edges(count: int, buckets: int) -> IntArray:
    edges = _bounds(count, max(buckets, 1))
    return np.concatenate((edges[:-1], edges[1:] - 1))


def _extremes(values: NDArray[Any], missing: NDArray[np.bool_], buckets: int) -> IntArray:
    edges = _bounds(len(values), buckets)
    low, high = _limits(values.dtype)
    smallest = _first_equal(np.where(missing, high, values), np.minimum, edges)
    largest = _first_equal(np.where(missing, low, values), np.maximum, edges)
    rows = [_edges(len(values), buckets), smallest, largest]
    if missing.any():
        rows.append(_first_per_bucket(missing, edges))
    return np.unique(np.concatenate(rows))


def _limits(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    if dtype.kind == "f":
        return dtype.type(-np.inf), dtype.type(np.inf)
    return np.iinfo(dtype).min, np.iinfo(dtype).max


def _first_equal(values: NDArray[Any], ufunc: np.ufunc, edges: IntArray) -> IntArray:
    """Return for each bucket the first row that holds its extreme."""
    extremes = ufunc.reduceat(values, edges[:-1])
    return _first_per_bucket(values == np.repeat(extremes, np.diff(edges)), edges)


def _first_per_bucket(hits: NDArray[np.bool_], edges: IntArray) -> IntArray:
    rows = np.flatnonzero(hits)
    first: IntArray = rows[
        np.unique(np.searchsorted(edges, rows, side="right"), return_index=True)[1]
    ]
    return first
