"""CSV files as recordings of one item: one row is one message, one column one variable."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.formats._recording import (
    FileBytes,
    PieceCounts,
    ReadOptions,
    RecordedMessage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicOrigin,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timestamps import format_time, parse_any_time
from amberbox.core.types import Topic

DELIMITERS = ",;\t|"
LARGEST_CELL = 4 << 20
_BLOCK = 1 << 20
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True, slots=True)
class CsvDialect:
    """Delimiter, encoding and header of a table."""

    delimiter: str
    encoding: str
    padded: bool
    names: tuple[str, ...]
    start: int  # byte at which the rows begin
    first_line: int  # number of the line at which the rows begin


@dataclass(frozen=True, slots=True)
class CsvRow:
    """One row: its line, its cells, its bytes; ``problem`` is why it cannot be used."""

    line: int
    cells: list[str]
    start: int
    end: int
    problem: str = ""


class CsvLines:
    """Iterates over the lines of a file from a byte on; ``at`` and ``number`` are the position."""

    def __init__(self, file: FileBytes, at: int, number: int) -> None:
        self.file = file
        self._block, self._place = b"", 0
        self.at, self.number = at, number
        self.encoding = "utf-8"

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._next_line()
        if not line:
            raise StopIteration
        self.at += len(line)
        self.number += 1
        return line.decode(self.encoding, "replace")

    def _next_line(self) -> bytes:
        end = self._block.find(b"\n", self._place) + 1
        if not end:
            pieces = [self._block[self._place :]]
            read_from = self.at + len(pieces[0])
            size = 0
            while size < 2 * LARGEST_CELL:
                block = self.file.read(read_from + size, _BLOCK)
                pieces.append(block)
                size += len(block)
                if b"\n" in block or not block:
                    break
            self._block, self._place = b"".join(pieces), 0
            end = self._block.find(b"\n") + 1 or len(self._block)
        line = self._block[self._place : end]
        self._place = end
        return line


def find_dialect(file: FileBytes) -> CsvDialect:
    """Find delimiter, encoding and header; raises AmberboxError if there are none."""
    head = file.read(0, _BLOCK)
    if b"\0" in head:
        hint = "save it as CSV in UTF-8 and import that"
        raise AmberboxError("this is no text in UTF-8 or Latin-1", hint)
    encoding = _encoding(head)
    lines = CsvLines(file, len(_BOM) if head.startswith(_BOM) else 0, 1)
    lines.encoding = encoding
    header = next((line for line in lines if line.strip()), "")
    unquoted = header.split('"')[::2]
    delimiter = max(DELIMITERS, key=lambda mark: sum(part.count(mark) for part in unquoted))
    if not header:
        raise AmberboxError(
            "there is no header line", "the first line names the columns, separated by a comma"
        )
    padded = 0 < header.count(delimiter) == header.count(delimiter + " ")
    dialect = CsvDialect(delimiter, encoding, padded, (), lines.at, lines.number)
    try:
        names = next(_reader(iter([header]), dialect))
    except csv.Error as error:
        raise AmberboxError(f"the header line cannot be read ({error})", "mend it") from None
    return CsvDialect(delimiter, encoding, padded, _names(names), lines.at, lines.number)


def _encoding(head: bytes) -> str:
    cut = head[: head.rfind(b"\n") + 1] or head
    try:
        cut.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _names(cells: list[str]) -> tuple[str, ...]:
    """Return the names of the columns; a missing or repeated name gets a number."""
    names: list[str] = []
    for number, cell in enumerate(cells, 1):
        name = cell.strip().lstrip("#%").strip() or f"column_{number}"
        names.append(name if name not in names else f"{name}_{number}")
    return tuple(names)


def _reader(lines: Iterator[str], dialect: CsvDialect) -> Iterator[list[str]]:
    csv.field_size_limit(max(csv.field_size_limit(), LARGEST_CELL))
    return csv.reader(
        lines, delimiter=dialect.delimiter, skipinitialspace=dialect.padded, strict=True
    )


def read_rows(
    file: FileBytes, dialect: CsvDialect, start: int, stop: int, line: int
) -> Iterator[CsvRow]:
    """Yield the rows that begin in ``[start, stop)``, without blank lines.

    An invalid row ends with its first line, so that a lost quotation mark does not hide the rows
    after it.
    """
    at = start
    while at < stop:
        lines = CsvLines(file, at, line)
        lines.encoding = dialect.encoding
        for row in _rows_from(lines, dialect, stop):
            yield row
            at, line = row.end, lines.number
            if row.problem:
                line = row.line + 1
                break
        else:
            return


def _rows_from(lines: CsvLines, dialect: CsvDialect, stop: int) -> Iterator[CsvRow]:
    reader = _reader(lines, dialect)
    while lines.at < stop:
        start, first = lines.at, lines.number
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            yield CsvRow(first, [], start, _line_end(lines, start), str(error))
            return
        if len(cells) == len(dialect.names):
            yield CsvRow(first, cells, start, lines.at)
        elif any(cells):
            counts = f"{len(cells)} columns instead of {len(dialect.names)}"
            yield CsvRow(first, cells, start, _line_end(lines, start), counts)


def _line_end(lines: CsvLines, start: int) -> int:
    """Return where the first line of a row ends."""
    again = CsvLines(lines.file, start, 0)
    next(again, "")
    return again.at


_INT = r" *(?:0|[-+]?[1-9][0-9]{0,18}) *"
_SHORT_INT = r"[-+]?(?:0|[1-9][0-9]{0,14})"
_FRACTION = (
    r"[-+]?(?:(?:0|[1-9][0-9]*)\.[0-9]*|\.[0-9]+|(?:0|[1-9][0-9]*)(?=[eE]))(?:[eE][-+]?[0-9]+)?"
)
_WORD = r"[-+]?(?:[nN][aA][nN]|[iI][nN][fF](?:[iI][nN][iI][tT][yY])?)"
_FLOAT = rf" *(?:{_FRACTION}|{_SHORT_INT}|{_WORD}) *"
_COMMA = r" *[-+]?(?:0|[1-9][0-9]*)(?:,[0-9]+)? *"
_BOOL = r" *(?:[tT]rue|TRUE|[fF]alse|FALSE) *"
_PATTERNS = {
    kind: re.compile(rf"(?:(?:{cell})\n)*")
    for kind, cell in (("int", _INT), ("float", _FLOAT), ("bool", _BOOL), ("comma", _COMMA))
}
_INT64 = range(-(2**63), 2**63)
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
# how numbers that JSON does not have are written in a list
WORDS = ("NaN", "Infinity", "-Infinity")


@dataclass
class ColumnKind:
    """The kinds of the cells of a column so far; empty cells are ignored."""

    name: str
    decimal_comma: bool = False
    seen: set[str] = field(default_factory=set)
    elements: set[str] = field(default_factory=set)

    def observe(self, cells: Sequence[str]) -> None:
        """Add the kinds of more cells."""
        filled = [cell for cell in cells if cell]
        if filled and "text" not in self.seen:
            self.seen.add(self._kind(filled))

    def _kind(self, cells: list[str]) -> str:
        joined = "\n".join(cells) + "\n"
        if joined.count("\n") == len(cells):
            for kind in ("int", "float", "bool"):
                if _PATTERNS[kind].fullmatch(joined) and not (
                    kind == "int" and any(len(c) >= 19 and int(c) not in _INT64 for c in cells)
                ):
                    return self._checked(kind, cells)
            if self.decimal_comma and _PATTERNS["comma"].fullmatch(joined):
                return "comma"
        return "list" if all(map(self._is_list, cells)) else "text"

    def _checked(self, kind: str, cells: list[str]) -> str:
        """Return ``long`` for whole numbers that a float cannot hold, else ``kind``."""
        long = kind == "int" and max(map(len, cells)) > 15
        return "long" if long and any(abs(int(c)) > 2**53 for c in cells) else kind

    def _is_list(self, cell: str) -> bool:
        if not cell.startswith("["):
            return False
        try:
            value = json.loads(cell)
        except ValueError:
            return False
        self.elements.update(map(_element, value))
        return True

    @property
    def kind(self) -> str:
        """Return the kind of the column: one of ``_CONVERTERS``, empty if no cell is filled."""
        for kind, within in _DECISIONS:
            if self.seen <= within:
                return kind if kind != "list" else self._list_kind()
        return "text"

    def _list_kind(self) -> str:
        allowed: tuple[tuple[str, set[str]], ...] = (
            ("list<int>", {"int"}), ("list<float>", {"int", "float", "word"}),
            ("list<text>", {"text", "word"}), ("list<bool>", {"bool"}),
        )  # fmt: skip
        return next((kind for kind, within in allowed if self.elements <= within), "text")


_DECISIONS: tuple[tuple[str, set[str]], ...] = (
    ("", set()),
    ("int", {"int", "long"}),
    ("float", {"int", "float"}),
    ("comma", {"int", "comma"}),
    ("bool", {"bool"}),
    ("list", {"list"}),
)


def _element(value: Any) -> str:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "int" if value in _INT64 else "other"
    if isinstance(value, float):
        return "float"
    if isinstance(value, str):
        return "word" if value in WORDS else "text"
    return "other"


def convert(kind: str, cells: Sequence[str]) -> Sequence[Any]:
    """Convert the cells of a column to values; an empty cell is None."""
    one = _CONVERTERS[kind]
    return [one(cell) if cell else None for cell in cells]


def _text(cell: str) -> str:
    """Remove the mark that keeps a spreadsheet from taking the text for a formula."""
    return cell[1:] if cell[0] == "'" and cell[1:2] in _FORMULA else cell


_CONVERTERS: Mapping[str, Callable[[str], Any]] = {
    "": str,
    "int": int,
    "float": float,
    "comma": lambda cell: float(cell.replace(",", ".")),
    "bool": lambda cell: cell.strip().lower() == "true",
    "text": _text,
    "list<int>": json.loads,
    "list<float>": lambda cell: [float(value) for value in json.loads(cell)],
    "list<text>": json.loads,
    "list<bool>": json.loads,
}


ISO = "ISO 8601"
UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
RECEIVED, STAMP = "received", "timestamp"
_NAMES = (RECEIVED, STAMP, "time", "t", "stamp", "log_time", "datetime", "date_time", "date")
_UNIT = re.compile(
    r"(?<![ _\[(])[ _\[(]+(?:(ns|nsec|nanosec\w*)|(us|µs|usec|microsec\w*)|(ms|msec|millisec\w*)"
    r"|(s|secs?|seconds?))[\])]?",
    re.IGNORECASE,
)
# seconds, milliseconds, microseconds by size: each covers the years 1973 to 5138
_LIMITS = ((10**11, "s"), (10**14, "ms"), (10**17, "us"))
_ISO_TEXT = re.compile(r"\d{4}-\d{2}-\d{2}(?!\d).*")
_OURS = re.compile(r"(?:(?:19[789]\d|2[01]\d\d)-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d{1,9})?Z\n)*")
_LATEST_NS = 2**63 - 1
_LONG_AGO = 10**8


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """A column of times: its index, text or numbers, the unit if its name states one."""

    place: int
    name: str
    is_text: bool = False
    unit: str = ""


def choose(names: Sequence[str], wanted: str | None) -> tuple[TimeColumn, TimeColumn | None]:
    """Find the column of receipt, and that of own stamps if there are both.

    Raises UsageError when the wanted one is missing, or no column can be a time.
    """
    if wanted is not None:
        if wanted not in names:
            raise UsageError(f"there is no column {wanted!r}", _columns(names))
        return _column(names, wanted), None
    known = {_base(name): name for name in reversed(names)}
    found = [known[base] for base in _NAMES if base in known]
    if not found:
        raise UsageError(
            "no column looks like a time", f"--time COLUMN says which; {_columns(names)}"
        )
    both = [known[base] for base in (RECEIVED, STAMP) if base in known]
    stamp = _column(names, both[1]) if len(both) == 2 else None
    return _column(names, found[0]), stamp


def _columns(names: Sequence[str]) -> str:
    shown = ", ".join(names[:20])
    return f"the columns are {shown}" + (", ..." if len(names) > 20 else "")


def _column(names: Sequence[str], name: str) -> TimeColumn:
    return TimeColumn(names.index(name), name, unit=_unit_of(name))


def _base(name: str) -> str:
    lowered = name.casefold()
    match = _UNIT.search(lowered)
    return lowered[: match.start()] if match and match.end() == len(lowered) else lowered


def _unit_of(name: str) -> str:
    match = _UNIT.search(name)
    if match is None or match.end() != len(name):
        return ""
    return next(u for u, text in zip(("ns", "us", "ms", "s"), match.groups(), strict=True) if text)


def is_iso(cells: Sequence[str], name: str) -> bool:
    """Return whether the first cells are times as text; raises AmberboxError if no times."""
    for cell in cells:
        if _ISO_TEXT.fullmatch(cell.strip()):
            return True
        if _number(cell) is not None:
            return False
    raise AmberboxError(
        f"the column {name!r} holds no times",
        "times are ISO 8601, or numbers; --time COLUMN names another column",
    )


def read_cells(cells: Sequence[str], is_text: bool) -> list[Decimal | None]:
    """Parse times: texts to nanoseconds, numbers unchanged."""
    if not is_text:
        return [_number(cell) for cell in cells]
    quick = _quick_iso(cells)
    return quick if quick is not None else [_iso(cell) for cell in cells]


def _number(cell: str) -> Decimal | None:
    try:
        number = Decimal(cell.strip().replace(",", "."))
    except InvalidOperation:
        return None
    return number if number.is_finite() and abs(number) < 10**20 else None


def _quick_iso(cells: Sequence[str]) -> list[Decimal | None] | None:
    """Parse times of the form ``2026-11-21T14:00:00.5Z`` column-wise; None if one differs."""
    if not _OURS.fullmatch("\n".join([*cells, ""])):
        return None
    try:
        times = np.array([cell[:-1] for cell in cells], "datetime64[ns]")
    except ValueError:
        return None
    return [Decimal(time_ns) for time_ns in times.astype(np.int64).tolist()]


def _iso(cell: str) -> Decimal | None:
    text = cell.strip()
    if not _ISO_TEXT.fullmatch(text):
        return None
    try:
        return Decimal(parse_any_time(text, lambda: 0, lambda: None))
    except (UsageError, ValueError):
        return None


def unit_for(column: TimeColumn, largest: Decimal) -> str:
    """Return the unit of a column: by its name, else by the size of its numbers."""
    if column.is_text:
        return ISO
    return column.unit or next((unit for limit, unit in _LIMITS if largest < limit), "ns")


def in_ns(value: Decimal, unit: str) -> int:
    """Convert a time to nanoseconds, exactly."""
    return int(value if unit == ISO else value * UNITS_NS[unit])


def is_relative(largest_ns: int) -> bool:
    """Return whether times are relative: as dates they would be in the first years after 1970."""
    return largest_ns < _LONG_AGO * 10**9


def is_possible(time_ns: int) -> bool:
    """Return whether a journal can hold a time."""
    return 0 <= time_ns <= _LATEST_NS


NO_TIME = "no time"
_BATCH_ROWS = 2000
_BATCH_BYTES = 1 << 20
_SHOWN_LINES = 20


@dataclass(frozen=True, slots=True)
class CsvBatch:
    """Rows that are read at once: their place in the file, and first and last time."""

    start: int
    stop: int
    line: int
    first: Decimal
    last: Decimal
    count: int


@dataclass
class CsvTable:
    """Facts about a table from its first reading; columns by their index."""

    file: FileBytes
    dialect: CsvDialect
    received: TimeColumn
    stamp: TimeColumn | None
    account: PieceCounts
    columns: dict[int, ColumnKind]
    batches: list[CsvBatch] = field(default_factory=list)
    bad_lines: list[str] = field(default_factory=list)
    begin: Decimal | None = None
    largest: Decimal = Decimal(0)
    stamp_differs: bool = False
    stamp_largest: Decimal = Decimal(0)
    same_as_stamp: set[int] = field(default_factory=set)

    def refuse(self, line: int, reason: str) -> None:
        """Count a row that is left out, and keep the numbers of the first ones."""
        self.account.refused[reason] += 1
        if len(self.bad_lines) < _SHOWN_LINES:
            self.bad_lines.append(f"line {line} ({reason})")


def scan(file: FileBytes, dialect: CsvDialect, wanted: str | None) -> CsvTable:
    """Read a table once, to its end.

    Raises UsageError or AmberboxError when it has no column of times.
    """
    received, stamp = choose(dialect.names, wanted)
    first = next(batches(file, dialect, dialect.start, file.size, dialect.first_line), [])
    received = _with_kind(received, first)
    stamp = None if stamp is None else _with_kind(stamp, first)
    times = {column.place for column in (received, stamp) if column is not None}
    columns = {
        place: ColumnKind(name, dialect.delimiter != ",")
        for place, name in enumerate(dialect.names)
        if place not in times
    }
    account = PieceCounts(file.path.name, "rows", topics=(0,))
    table = CsvTable(file, dialect, received, stamp, account, columns, same_as_stamp=set(columns))
    for rows in batches(file, dialect, dialect.start, file.size, dialect.first_line):
        _scan_rows(table, rows)
    return table


def batches(
    file: FileBytes, dialect: CsvDialect, start: int, stop: int, line: int
) -> Iterator[list[CsvRow]]:
    """Yield the rows of a range of the file, some thousands at a time."""
    rows: list[CsvRow] = []
    for row in read_rows(file, dialect, start, stop, line):
        rows.append(row)
        if len(rows) >= _BATCH_ROWS or row.end - rows[0].start >= _BATCH_BYTES:
            yield rows
            rows = []
    if rows:
        yield rows


def _with_kind(column: TimeColumn, rows: Sequence[CsvRow]) -> TimeColumn:
    cells = [row.cells[column.place] for row in rows if not row.problem]
    return replace(column, is_text=is_iso(cells, column.name))


def read_times(rows: Sequence[CsvRow], column: TimeColumn) -> list[Decimal | None]:
    """Return the times of rows; None for invalid ones."""
    sound = [row for row in rows if not row.problem]
    found = read_cells([row.cells[column.place] for row in sound], column.is_text)
    if len(sound) == len(rows):
        return found
    times = iter(found)
    return [None if row.problem else next(times) for row in rows]


def _scan_rows(table: CsvTable, rows: list[CsvRow]) -> None:
    """Update the kinds of the columns and the time range from some rows."""
    table.account.total += len(rows)
    usable: list[CsvRow] = []
    times: list[Decimal] = []
    for row, time in zip(rows, read_times(rows, table.received), strict=True):
        if time is None:
            table.refuse(row.line, row.problem or NO_TIME)
        else:
            usable.append(row)
            times.append(time)
    if usable:
        _scan_usable_rows(table, usable, times)
        table.batches.append(
            CsvBatch(rows[0].start, rows[-1].end, rows[0].line, min(times), max(times), len(times))
        )


def _scan_usable_rows(table: CsvTable, rows: list[CsvRow], times: list[Decimal]) -> None:
    table.begin = times[0] if table.begin is None else table.begin
    table.largest = max(table.largest, abs(min(times)), abs(max(times)))
    columns = list(zip(*(row.cells for row in rows), strict=True))
    for place, column in table.columns.items():
        column.observe(columns[place])
    if table.stamp is not None:
        _compare_stamps(table, table.stamp, columns)


def _compare_stamps(table: CsvTable, stamp: TimeColumn, columns: Sequence[Sequence[str]]) -> None:
    """Update whether stamps differ from the times of receipt, and which columns repeat them."""
    cells = columns[stamp.place]
    table.stamp_differs |= cells != columns[table.received.place]
    table.same_as_stamp = {place for place in table.same_as_stamp if columns[place] == cells}
    found = [t for t in read_cells(cells, stamp.is_text) if t is not None]
    table.stamp_largest = max([table.stamp_largest, *map(abs, found)])


SUFFIXES = (".csv", ".tsv", ".txt")
_STAMP = "stamp"
_IMPOSSIBLE = "a time before 1970 or after 2262"


@dataclass(frozen=True, slots=True)
class _Plan:
    """How rows are converted to messages, decided over the whole file.

    ``stamp`` is the variable with the own stamp, empty without one; ``adds_stamp`` if no column
    of the table has it under that name.
    """

    unit: str
    shift_ns: int
    stamp: str
    adds_stamp: bool
    stamp_unit: str
    kinds: tuple[tuple[int, str, str], ...]  # place, name and kind of each variable


def is_csv(path: Path, head: bytes) -> bool:
    """Return whether a file is a text table, by its suffix."""
    return bool(head) and path.suffix.lower() in SUFFIXES


def open_csv(path: Path, options: ReadOptions) -> RecordingReader:
    """Open a table; it is read once to determine its columns."""
    file = FileBytes(path)
    try:
        return _open(path, file, options)
    except AmberboxError as error:
        file.close()
        raise type(error)(f"{path}: {error.what}", error.hint) from None
    except BaseException:
        file.close()
        raise


def _open(path: Path, file: FileBytes, options: ReadOptions) -> RecordingReader:
    dialect = find_dialect(file)
    table = scan(file, dialect, options.time)
    if not table.batches or table.begin is None:
        raise AmberboxError("there is a header, but no row with a time", "look at its lines")
    unit = unit_for(table.received, table.largest)
    shift_ns = 0 if options.start_ns is None else options.start_ns - in_ns(table.begin, unit)
    stamp, adds = _stamp(table)
    stamp_unit = "" if table.stamp is None else unit_for(table.stamp, table.stamp_largest)
    kinds = tuple((place, column.name, column.kind) for place, column in table.columns.items())
    plan = _Plan(unit, shift_ns, stamp, adds, stamp_unit, kinds)
    found = [batch for batch in (_possible(batch, table, plan) for batch in table.batches) if batch]
    report = RecordingReport("CSV file", accounts=[table.account])
    for note in _notes(table, plan, options):
        report.add_note(note)
    topic = Topic(f"/{path.stem}", "msgpack")
    origin = TopicOrigin("", stamp=plan.stamp, kind=_kind(plan))
    parts = [
        RecordingPart(
            _log_ns(plan, batch.first),
            _log_ns(plan, batch.last),
            batch.count,
            partial(_load, batch, table, plan),
        )
        for batch in found
    ]
    return RecordingReader(path, [topic], parts, report, file.close, [origin])


# -- decisions over the whole file


def _stamp(table: CsvTable) -> tuple[str, bool]:
    """Return the variable of the own stamp, and whether it has to be added to the columns."""
    if table.stamp is None or not table.stamp_differs:
        return "", False
    same = [table.columns[place].name for place in sorted(table.same_as_stamp)]
    known = next((name for name in same if name.isidentifier()), "")
    if known and table.stamp.is_text:
        return known, False
    taken = {column.name.casefold() for column in table.columns.values()}
    names = [_STAMP, *(f"{_STAMP}_{number}" for number in range(2, len(taken) + 3))]
    return next(name for name in names if name not in taken), True


def _possible(batch: CsvBatch, table: CsvTable, plan: _Plan) -> CsvBatch | None:
    """Return the rows whose time a journal can hold; None if there are none."""
    edges = [_log_ns(plan, time) for time in (batch.first, batch.last)]
    if all(map(is_possible, edges)):
        return batch
    times = []
    for row, time in _rows_with_times(batch, table):
        if is_possible(_log_ns(plan, time)):
            times.append(time)
        else:
            table.refuse(row.line, _IMPOSSIBLE)
    if not times:
        return None
    return CsvBatch(batch.start, batch.stop, batch.line, min(times), max(times), len(times))


def _rows_with_times(batch: CsvBatch, table: CsvTable) -> list[tuple[CsvRow, Decimal]]:
    rows_at = batches(table.file, table.dialect, batch.start, batch.stop, batch.line)
    return [
        (row, time)
        for rows in rows_at
        for row, time in zip(rows, read_times(rows, table.received), strict=True)
        if time is not None
    ]


def _log_ns(plan: _Plan, time: Decimal) -> int:
    return in_ns(time, plan.unit) + plan.shift_ns


# -- the report


def _kind(plan: _Plan) -> str:
    counts = Counter(kind or "empty" for _, _, kind in plan.kinds)
    return "from a table: " + ", ".join(f"{count} {kind}" for kind, count in counts.items())


def _notes(table: CsvTable, plan: _Plan, options: ReadOptions) -> list[str]:
    notes = [f"the time is the column {table.received.name!r}, in {_in(plan.unit)}"]
    if table.stamp is not None and plan.stamp:
        unit = f"in {_in(plan.stamp_unit)}"
        place = f"kept as the variable {plan.stamp!r}"
        notes.append(f"the own stamp is the column {table.stamp.name!r}, {unit}, {place}")
    if options.start_ns is not None:
        notes.append(f"the first row is at {format_time(options.start_ns)}, as given")
    elif plan.unit != ISO and is_relative(_log_ns(plan, table.largest)):
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
    return unit if unit == ISO else f"{unit} since 1970 or the start"


# -- the second reading


def _load(batch: CsvBatch, table: CsvTable, plan: _Plan) -> list[RecordedMessage]:
    timed = [(row, _log_ns(plan, time)) for row, time in _rows_with_times(batch, table)]
    timed = [(row, log_ns) for row, log_ns in timed if is_possible(log_ns)]
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


def _stamp_texts(cells: Sequence[str], stamp: TimeColumn, plan: _Plan) -> list[Any]:
    """Return own stamps as ISO 8601 texts; None where there is none."""
    times = read_cells(cells, stamp.is_text)
    stamps_ns = [None if t is None else in_ns(t, plan.stamp_unit) for t in times]
    return [None if s is None or s < 0 else format_time(s) for s in stamps_ns]
