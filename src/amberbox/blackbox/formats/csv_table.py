"""CSV files as recordings of one item: one row is one message, one column one variable."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.formats import csv_times
from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.blackbox.formats.csv_columns import convert
from amberbox.blackbox.formats.csv_lines import Row, find_dialect
from amberbox.blackbox.formats.csv_scan import Batch, Table, batches, read_times, scan
from amberbox.blackbox.formats.options import ReadOptions
from amberbox.blackbox.formats.recording import (
    Origin,
    Part,
    RecordedMessage,
    Recording,
    Report,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.timetext import format_time
from amberbox.core.types import Topic

SUFFIXES = (".csv", ".tsv", ".txt")
_STAMP = "stamp"
_IMPOSSIBLE = "a time before 1970 or after 2262"


@dataclass(frozen=True, slots=True)
class _Plan:
    """How rows become messages, decided over the whole file.

    ``stamp`` is the variable with the own stamp, empty without one; ``adds_stamp`` if no column
    of the table has it under that name.
    """

    unit: str
    shift_ns: int
    stamp: str
    adds_stamp: bool
    stamp_unit: str
    kinds: tuple[tuple[int, str, str], ...]
    """Place, name and kind of each variable."""


def is_csv(path: Path, head: bytes) -> bool:
    """Tell whether a file is a text table, by its ending."""
    return bool(head) and path.suffix.lower() in SUFFIXES


def open_csv(path: Path, options: ReadOptions) -> Recording:
    """Open a table; it is read once to find what its columns are."""
    file = FileBytes(path)
    try:
        return _open(path, file, options)
    except AmberboxError as error:
        file.close()
        raise type(error)(f"{path}: {error.what}", error.hint) from None
    except BaseException:
        file.close()
        raise


def _open(path: Path, file: FileBytes, options: ReadOptions) -> Recording:
    dialect = find_dialect(file)
    table = scan(file, dialect, options.time)
    if not table.batches or table.begin is None:
        raise AmberboxError("there is a header, but no row with a time", "look at its lines")
    plan = _decide(table, table.begin, options.start_ns)
    found = [batch for batch in (_possible(batch, table, plan) for batch in table.batches) if batch]
    report = Report("CSV file", accounts=[table.account])
    _tell(table, plan, report, options)
    topic = Topic(f"/{path.stem}", "msgpack")
    origin = Origin("", stamp=plan.stamp, kind=_kind(plan))
    parts = [_part(batch, table, plan) for batch in found]
    return Recording(path, [topic], parts, report, file.close, [origin])


# -- what is decided over the whole file


def _decide(table: Table, begin: Decimal, start_ns: int | None) -> _Plan:
    unit = csv_times.unit_for(table.received, table.largest)
    shift_ns = 0 if start_ns is None else start_ns - csv_times.in_ns(begin, unit)
    stamp, adds = _stamp(table)
    stamp_unit = "" if table.stamp is None else _stamp_unit(table, table.stamp)
    kinds = tuple((place, column.name, column.kind) for place, column in table.columns.items())
    return _Plan(unit, shift_ns, stamp, adds, stamp_unit, kinds)


def _stamp_unit(table: Table, stamp: csv_times.TimeColumn) -> str:
    return csv_times.unit_for(stamp, table.stamp_largest)


def _stamp(table: Table) -> tuple[str, bool]:
    """Name the variable of the own stamp, and say whether rows need it beside their columns."""
    if table.stamp is None or not table.stamp_differs:
        return "", False
    same = [table.columns[place].name for place in sorted(table.same_as_stamp)]
    known = next((name for name in same if name.isidentifier()), "")
    if known and table.stamp.is_text:
        return known, False
    taken = {column.name.casefold() for column in table.columns.values()}
    names = [_STAMP, *(f"{_STAMP}_{number}" for number in range(2, len(taken) + 3))]
    return next(name for name in names if name not in taken), True


def _possible(batch: Batch, table: Table, plan: _Plan) -> Batch | None:
    """Leave out the rows whose time no journal can hold; None if there is no other."""
    edges = [_log_ns(plan, time) for time in (batch.first, batch.last)]
    if all(map(csv_times.is_possible, edges)):
        return batch
    times = []
    for row, time in _rows_with_times(batch, table):
        if csv_times.is_possible(_log_ns(plan, time)):
            times.append(time)
        else:
            table.refuse(row.line, _IMPOSSIBLE)
    if not times:
        return None
    return Batch(batch.start, batch.stop, batch.line, min(times), max(times), len(times))


def _rows_with_times(batch: Batch, table: Table) -> list[tuple[Row, Decimal]]:
    stretch = batches(table.file, table.dialect, batch.start, batch.stop, batch.line)
    return [
        (row, time)
        for rows in stretch
        for row, time in zip(rows, read_times(rows, table.received), strict=True)
        if time is not None
    ]


def _log_ns(plan: _Plan, time: Decimal) -> int:
    return csv_times.in_ns(time, plan.unit) + plan.shift_ns


# -- the report


def _kind(plan: _Plan) -> str:
    counts = Counter(kind or "empty" for _, _, kind in plan.kinds)
    return "from a table: " + ", ".join(f"{count} {kind}" for kind, count in counts.items())


def _tell(table: Table, plan: _Plan, report: Report, options: ReadOptions) -> None:
    for note in _notes(table, plan, options):
        report.add_note(note)


def _notes(table: Table, plan: _Plan, options: ReadOptions) -> list[str]:
    notes = [f"the time is the column {table.received.name!r}, in {_in(plan.unit)}"]
    if table.stamp is not None and plan.stamp:
        unit = f"in {_in(plan.stamp_unit)}"
        place = f"kept as the variable {plan.stamp!r}"
        notes.append(f"the own stamp is the column {table.stamp.name!r}, {unit}, {place}")
    if options.start_ns is not None:
        notes.append(f"the first row is at {format_time(options.start_ns)}, as given")
    elif plan.unit != csv_times.ISO and csv_times.is_relative(_log_ns(plan, table.largest)):
        notes.append("times count from 1970, for they are no dates; --start TIME says when they do")
    empty = [name for _, name, kind in plan.kinds if not kind]
    if empty:
        notes.append(f"empty in every row: {', '.join(empty)}")
    if any(kind == "comma" for _, _, kind in plan.kinds):
        notes.append("commas inside numbers are decimal points")
    if table.bad_lines:
        more = table.account.refused.total() - len(table.bad_lines)
        notes.append("refused: " + ", ".join(table.bad_lines) + (f", {more} more" * bool(more)))
    return notes


def _in(unit: str) -> str:
    return unit if unit == csv_times.ISO else f"{unit} since 1970 or the start"


# -- the second reading


def _part(batch: Batch, table: Table, plan: _Plan) -> Part:
    load = partial(_load, batch, table, plan)
    return Part(_log_ns(plan, batch.first), _log_ns(plan, batch.last), batch.count, load)


def _load(batch: Batch, table: Table, plan: _Plan) -> list[RecordedMessage]:
    timed = [(row, _log_ns(plan, time)) for row, time in _rows_with_times(batch, table)]
    timed = [(row, log_ns) for row, log_ns in timed if csv_times.is_possible(log_ns)]
    columns = list(zip(*(row.cells for row, _ in timed), strict=True))
    names = [name for _, name, _ in plan.kinds]
    values = [convert(kind, columns[place]) for place, _, kind in plan.kinds]
    if table.stamp is not None and plan.adds_stamp:
        names.append(plan.stamp)
        values.append(_stamp_texts(columns[table.stamp.place], table.stamp, plan))
    encode = msgspec.msgpack.Encoder().encode
    rows = zip(*values, strict=True) if values else ((),) * len(timed)
    return [
        RecordedMessage(0, log_ns, None, encode(dict(zip(names, row, strict=True))))
        for (_, log_ns), row in zip(timed, rows, strict=True)
    ]


def _stamp_texts(cells: Sequence[str], stamp: csv_times.TimeColumn, plan: _Plan) -> list[Any]:
    """Write own stamps as texts that any reader takes for times; None where there is none."""
    times = csv_times.read_cells(cells, stamp.is_text)
    stamps_ns = [None if t is None else csv_times.in_ns(t, plan.stamp_unit) for t in times]
    return [None if s is None or s < 0 else format_time(s) for s in stamps_ns]
