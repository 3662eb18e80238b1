"""The rows of a text table: its delimiter, its header, and where each row stands in the file."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass

from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.core.errors import AmberboxError

DELIMITERS = ",;\t|"
LARGEST_CELL = 4 << 20
_BLOCK = 1 << 20
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a table is written, and what its first line says."""

    delimiter: str
    encoding: str
    padded: bool
    names: tuple[str, ...]
    start: int
    """Byte at which the rows begin."""
    first_line: int
    """Number of the line at which the rows begin."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row: its line, its cells, its bytes; ``problem`` says why it cannot be used."""

    line: int
    cells: list[str]
    start: int
    end: int
    problem: str = ""


class Lines:
    """Lines of a file from a byte on; ``at`` and ``number`` say where it stands."""

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
            self._fill()
            end = self._block.find(b"\n") + 1 or len(self._block)
        line = self._block[self._place : end]
        self._place = end
        return line

    def _fill(self) -> None:
        """Read on until there is a whole line, or the end, or more than any row has."""
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


def find_dialect(file: FileBytes) -> Dialect:
    """Find delimiter, encoding and header; raises AmberboxError if there are none."""
    head = file.read(0, _BLOCK)
    if b"\0" in head:
        hint = "save it as CSV in UTF-8 and import that"
        raise AmberboxError("this is no text in UTF-8 or Latin-1", hint)
    encoding = _encoding(head)
    lines = Lines(file, len(_BOM) if head.startswith(_BOM) else 0, 1)
    lines.encoding = encoding
    header = next((line for line in lines if line.strip()), "")
    delimiter = max(DELIMITERS, key=lambda mark: _outside_quotes(header, mark))
    if not header:
        raise AmberboxError(
            "there is no header line", "the first line names the columns, separated by a comma"
        )
    padded = 0 < header.count(delimiter) == header.count(delimiter + " ")
    dialect = Dialect(delimiter, encoding, padded, (), lines.at, lines.number)
    try:
        names = next(_reader(iter([header]), dialect))
    except csv.Error as error:
        raise AmberboxError(f"the header line cannot be read ({error})", "mend it") from None
    return Dialect(delimiter, encoding, padded, _names(names), lines.at, lines.number)


def _encoding(head: bytes) -> str:
    cut = head[: head.rfind(b"\n") + 1] or head
    try:
        cut.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _outside_quotes(line: str, mark: str) -> int:
    return sum(part.count(mark) for part in line.split('"')[::2])


def _names(cells: list[str]) -> tuple[str, ...]:
    """Name the columns; a name that is missing or there already gets a number."""
    names: list[str] = []
    for number, cell in enumerate(cells, 1):
        name = cell.strip().lstrip("#%").strip() or f"column_{number}"
        names.append(name if name not in names else f"{name}_{number}")
    return tuple(names)


def _reader(lines: Iterator[str], dialect: Dialect) -> Iterator[list[str]]:
    csv.field_size_limit(max(csv.field_size_limit(), LARGEST_CELL))
    return csv.reader(
        lines, delimiter=dialect.delimiter, skipinitialspace=dialect.padded, strict=True
    )


def read_rows(file: FileBytes, dialect: Dialect, start: int, stop: int, line: int) -> Iterator[Row]:
    """Give the rows that begin in ``[start, stop)``; blank lines are none.

    A row that cannot be used takes one line only, lest a lost quotation mark swallow what follows.
    """
    at = start
    while at < stop:
        lines = Lines(file, at, line)
        lines.encoding = dialect.encoding
        for row in _rows_from(lines, dialect, stop):
            yield row
            at, line = row.end, lines.number
            if row.problem:
                line = row.line + 1
                break
        else:
            return


def _rows_from(lines: Lines, dialect: Dialect, stop: int) -> Iterator[Row]:
    reader = _reader(lines, dialect)
    while lines.at < stop:
        start, first = lines.at, lines.number
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            yield Row(first, [], start, _line_end(lines, start), str(error))
            return
        if len(cells) == len(dialect.names):
            yield Row(first, cells, start, lines.at)
        elif any(cells):
            counts = f"{len(cells)} columns instead of {len(dialect.names)}"
            yield Row(first, cells, start, _line_end(lines, start), counts)


def _line_end(lines: Lines, start: int) -> int:
    """Return where the first line of a row ends."""
    again = Lines(lines.file, start, 0)
    next(again, "")
    return again.at
