"""The first reading of a table: what its columns are, when it begins, which rows are no good."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal

from amberbox.blackbox.formats import csv_times
from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.blackbox.formats.csv_columns import ColumnKind
from amberbox.blackbox.formats.csv_lines import Dialect, Row, read_rows
from amberbox.blackbox.formats.csv_times import TimeColumn
from amberbox.blackbox.formats.recording import Account

NO_TIME = "no time"
_BATCH_ROWS = 2000
_BATCH_BYTES = 1 << 20
_SHOWN_LINES = 20


@dataclass(frozen=True, slots=True)
class Batch:
    """Rows that are read at once: where they stand, and their first and last time."""

    start: int
    stop: int
    line: int
    first: Decimal
    last: Decimal
    count: int


@dataclass
class Table:
    """What is known of a table after its first reading; columns by their place."""

    file: FileBytes
    dialect: Dialect
    received: TimeColumn
    stamp: TimeColumn | None
    account: Account
    columns: dict[int, ColumnKind]
    batches: list[Batch] = field(default_factory=list)
    bad_lines: list[str] = field(default_factory=list)
    begin: Decimal | None = None
    largest: Decimal = Decimal(0)
    stamp_differs: bool = False
    stamp_largest: Decimal = Decimal(0)
    same_as_stamp: set[int] = field(default_factory=set)

    def refuse(self, line: int, reason: str) -> None:
        """Count a row that is left out, and remember the first lines."""
        self.account.refused[reason] += 1
        if len(self.bad_lines) < _SHOWN_LINES:
            self.bad_lines.append(f"line {line} ({reason})")


def scan(file: FileBytes, dialect: Dialect, wanted: str | None) -> Table:
    """Read a table once, to its end.

    Raises UsageError or AmberboxError when it has no column of times.
    """
    received, stamp = csv_times.choose(dialect.names, wanted)
    first = next(batches(file, dialect, dialect.start, file.size, dialect.first_line), [])
    received = _with_kind(received, first)
    stamp = None if stamp is None else _with_kind(stamp, first)
    times = {column.place for column in (received, stamp) if column is not None}
    columns = {
        place: ColumnKind(name, dialect.delimiter != ",")
        for place, name in enumerate(dialect.names)
        if place not in times
    }
    account = Account(file.path.name, "rows", topics=(0,))
    table = Table(file, dialect, received, stamp, account, columns, same_as_stamp=set(columns))
    for rows in batches(file, dialect, dialect.start, file.size, dialect.first_line):
        _look_at(table, rows)
    return table


def batches(
    file: FileBytes, dialect: Dialect, start: int, stop: int, line: int
) -> Iterator[list[Row]]:
    """Give the rows of a stretch of the file, some thousands at a time."""
    rows: list[Row] = []
    for row in read_rows(file, dialect, start, stop, line):
        rows.append(row)
        if len(rows) >= _BATCH_ROWS or row.end - rows[0].start >= _BATCH_BYTES:
            yield rows
            rows = []
    if rows:
        yield rows


def _with_kind(column: TimeColumn, rows: Sequence[Row]) -> TimeColumn:
    cells = [row.cells[column.place] for row in rows if not row.problem]
    return replace(column, is_text=csv_times.is_iso(cells, column.name))


def read_times(rows: Sequence[Row], column: TimeColumn) -> list[Decimal | None]:
    """Read the times of rows; None for those that cannot be used."""
    sound = [row for row in rows if not row.problem]
    found = csv_times.read_cells([row.cells[column.place] for row in sound], column.is_text)
    if len(sound) == len(rows):
        return found
    times = iter(found)
    return [None if row.problem else next(times) for row in rows]


def _look_at(table: Table, rows: list[Row]) -> None:
    """Learn from some rows what the columns are, and when they begin and end."""
    table.account.total += len(rows)
    usable: list[Row] = []
    times: list[Decimal] = []
    for row, time in zip(rows, read_times(rows, table.received), strict=True):
        if time is None:
            table.refuse(row.line, row.problem or NO_TIME)
        else:
            usable.append(row)
            times.append(time)
    if usable:
        _look_at_usable(table, usable, times)
        table.batches.append(
            Batch(rows[0].start, rows[-1].end, rows[0].line, min(times), max(times), len(times))
        )


def _look_at_usable(table: Table, rows: list[Row], times: list[Decimal]) -> None:
    table.begin = times[0] if table.begin is None else table.begin
    table.largest = max(table.largest, abs(min(times)), abs(max(times)))
    columns = list(zip(*(row.cells for row in rows), strict=True))
    for place, column in table.columns.items():
        column.observe(columns[place])
    if table.stamp is not None:
        _compare_stamps(table, table.stamp, columns)


def _compare_stamps(table: Table, stamp: TimeColumn, columns: Sequence[Sequence[str]]) -> None:
    """See whether stamps are the times of receipt, or stand in another column, too."""
    cells = columns[stamp.place]
    table.stamp_differs |= cells != columns[table.received.place]
    table.same_as_stamp = {place for place in table.same_as_stamp if columns[place] == cells}
    found = [t for t in csv_times.read_cells(cells, stamp.is_text) if t is not None]
    table.stamp_largest = max([table.stamp_largest, *map(abs, found)])
