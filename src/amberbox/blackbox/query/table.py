"""A table: what a query gives; named, typed columns that go to Arrow, pandas, polars or a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from amberbox.blackbox.query import tabletext
from amberbox.blackbox.segments import columns as col
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, ColumnData

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows in order of time. ``fields`` say what each column is (type, unit, labels).

    A column is a numpy array, a masked array where values may be null, an object array of
    strings or bytes, or ``Ragged`` for lists. Times are int64 nanoseconds since the Unix epoch.
    ``notes`` name what could not be read.
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
        return tabletext.preview(self.item, self.fields, self.columns, len(self))

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [column.name for column in self.fields]

    def take(self, rows: col.RowIndex) -> Table:
        """Return the given rows."""
        columns = {name: col.take(column, rows) for name, column in self.columns.items()}
        return Table(self.item, self.fields, columns, self.notes)

    def values(self, name: str) -> list[Any]:
        """Return a column as plain Python values; times as int, nulls as None."""
        return tabletext.plain(self.columns[name])

    def rows(self) -> Iterator[dict[str, Any]]:
        """Give each row as plain Python values; times as int, nulls as None."""
        for row in zip(*map(self.values, self.names), strict=True):
            yield dict(zip(self.names, row, strict=True))

    def to_arrow(self) -> pa.Table:
        """Return a pyarrow Table; times are ``timestamp[ns, UTC]``."""
        import pyarrow as pa

        from amberbox.blackbox.segments.columns_io import to_arrow

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

        Text that a spreadsheet would take for a formula (it begins with ``= + - @``, a tab or a
        carriage return) gets a ``'`` before it, unless ``raw_text``.
        """
        with _opened(to) as file:
            tabletext.write_csv(file, self.fields, self.columns, header=header, raw_text=raw_text)

    def to_json(self, to: IO[str] | Path | str, *, lines: bool = False) -> None:
        """Write a JSON array of objects, or one object per line; times as RFC 3339 strings."""
        with _opened(to) as file:
            tabletext.write_json(file, self.fields, self.columns, lines=lines)

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
