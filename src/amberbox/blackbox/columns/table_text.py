"""Write columns as CSV, as JSON, and as tables that fit the width of a terminal."""

from __future__ import annotations

import base64
import csv
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import IO, Any, TypeVar

import msgspec
import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.core.safe_text import spreadsheet_safe
from amberbox.core.timestamps import format_times
from amberbox.core.types import Column, ColumnData, Ragged

T = TypeVar("T")

GAP = "  "
DOTS = "..."
_NARROWEST = 12  # texts are not cut to less: columns are left out instead


@dataclass(frozen=True, slots=True)
class LineWidth:
    """Characters in a line, and a hint how to see the columns that are left out."""

    width: int
    more: str = ""

    def note(self, shown: int, count: int) -> str:
        """Return a line that states how many columns are shown."""
        return f"{shown} of {count} columns" + (f"; {self.more}" if self.more else "")


@dataclass(frozen=True, slots=True)
class _FittedColumns:
    """Widths of all columns, and numbers of those that are shown; the hole is after ``left``."""

    widths: Sequence[int]
    columns: Sequence[int]
    left: int

    @property
    def hides(self) -> bool:
        """Return whether columns are left out."""
        return len(self.columns) < len(self.widths)

    def pick(self, cells: Sequence[T], hole: T) -> list[T]:
        """Return the cells of the columns that are shown, with ``hole`` for the others."""
        shown = [cells[number] for number in self.columns]
        return [*shown[: self.left], hole, *shown[self.left :]] if self.hides else shown


def shorten(text: str, width: int) -> str:
    """Shorten a text to a width in characters."""
    return text if len(text) <= width else text[: max(width - len(DOTS), 0)] + DOTS


def fit_columns(widths: Sequence[int], may_cut: Sequence[bool], room: int) -> _FittedColumns:
    """Choose the columns that fit into a line, and their widths; the first is never cut.

    Numbers and times are shown whole or not at all.
    """
    shown, left = _outer(_narrowed(widths, may_cut, room), room)
    if len(shown) < len(widths):
        room -= len(GAP) + len(DOTS)
    kept = _narrowed([widths[n] for n in shown], [may_cut[n] for n in shown], room)
    narrower = dict(zip(shown, kept, strict=True))
    return _FittedColumns([narrower.get(n, width) for n, width in enumerate(widths)], shown, left)


def _narrowed(widths: Sequence[int], may_cut: Sequence[bool], room: int) -> list[int]:
    """Narrow the widest text columns until a line fits or they have the least width."""
    narrower = list(widths)
    texts = [number for number, text in enumerate(may_cut) if text and number > 0]
    while line_length(narrower) > room:
        widest = max(texts, key=lambda number: narrower[number], default=0)
        if not texts or narrower[widest] <= _NARROWEST:
            break
        narrower[widest] -= 1
    return narrower


def line_length(widths: Sequence[int]) -> int:
    """Return the length of a line of columns of these widths."""
    return sum(widths) + len(GAP) * (len(widths) - 1)


def _outer(widths: Sequence[int], room: int) -> tuple[Sequence[int], int]:
    """Return the columns from both ends that fit, and how many of them are on the left."""
    if line_length(widths) <= room:
        return range(len(widths)), len(widths)
    low, high = 1, len(widths)  # what lies between is left out
    used = len(DOTS) + len(GAP) + widths[0]
    sides = ["right", "left"]
    while sides and low < high:
        number = high - 1 if sides[0] == "right" else low
        wanted = len(GAP) + widths[number]
        if used + wanted > room:
            sides.pop(0)  # the other side may have one that is narrower
            continue
        used += wanted
        low, high = (low, number) if sides[0] == "right" else (number + 1, high)
        sides.reverse()
    return [*range(low), *range(high, len(widths))], low


_CHUNK = 10_000
_VALUES = 500_000
_NUMBERS = {*col.NUMPY_TYPES} - {"bool", "time"}
_EDGE_ROWS = 5
_CELL_WIDTH = 40
_STEADY_WIDTH = 14
_STEADY_WIDTHS = {"time": 30, "bool": 5, "string": 20}

Fields = Sequence[Column]
Columns = Mapping[str, ColumnData]


def plain(column: ColumnData) -> list[Any]:
    """Return a column as Python values; nulls are None, lists are lists."""
    if isinstance(column, Ragged):
        return [column[row].tolist() for row in range(len(column))]
    listed: list[Any] = column.tolist()
    if column.dtype == object:
        return [v.tolist() if isinstance(v, np.ndarray) else v for v in listed]
    return listed


def json_values(column: ColumnData, column_type: str) -> list[Any]:
    """Return a column as JSON has it: times RFC 3339, binary base64, NaN and inf as text."""
    if column_type in ("time", "list<time>"):
        column = _times(column)
    values = plain(column)
    if "float" in column_type:
        return values if _all_finite(column) else [_finite(value) for value in values]
    return [_base64(value) for value in values] if "binary" in column_type else values


def _times(column: ColumnData) -> ColumnData:
    if isinstance(column, Ragged):
        return Ragged(column.offsets, format_times(column.values).astype(object))
    if column.dtype == object:
        return col.objects(None if v is None else format_times(v).tolist() for v in column)
    texts = format_times(np.ma.getdata(column)).astype(object)
    texts[col.null_mask(column)] = None
    return texts


def _all_finite(column: ColumnData) -> bool:
    values = column.values if isinstance(column, Ragged) else column
    return values.dtype != object and bool(np.isfinite(values).all())


def _finite(value: Any) -> Any:
    """Replace NaN and infinities, which JSON does not have, by words that ``float`` parses."""
    if isinstance(value, list):
        return [_finite(element) for element in value]
    if value is None or math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _base64(value: Any) -> Any:
    if isinstance(value, list):
        return [_base64(element) for element in value]
    return base64.b64encode(value).decode() if isinstance(value, bytes) else value


def write_csv(
    file: IO[str], fields: Fields, columns: Columns, *, header: bool = True, raw_text: bool = False
) -> None:
    """Write CSV with a header line; a list is written as JSON in its cell.

    Text that a spreadsheet would run as a formula gets a ``'`` before it, unless ``raw_text``.
    """
    writer = csv.writer(file, lineterminator="\n")
    quoting = csv.writer(file, lineterminator="\n", quoting=csv.QUOTE_ALL)
    if header:
        writer.writerow([column.name for column in fields])
    for part in _slices(fields, columns):
        cells = [_cells(f, col.take(columns[f.name], part), raw_text) for f in fields]
        rows = zip(*cells, strict=True)
        texts = (c for f, c in zip(fields, cells, strict=True) if f.type == "string")
        if any(map(_has_carriage_return, texts)):
            for special, some in groupby(rows, _has_carriage_return):
                (quoting if special else writer).writerows(some)
        else:
            writer.writerows(rows)


def _cells(field: Column, column: ColumnData, raw_text: bool) -> list[Any]:
    """Return the cells of a column, as text or as numbers that ``csv`` writes unchanged."""
    if field.type in _NUMBERS and not np.ma.isMaskedArray(column) and _all_finite(column):
        return msgspec.json.encode(plain(column))[1:-1].decode().split(",") if len(column) else []
    values = json_values(column, field.type)
    if field.type == "string":
        return values if raw_text else [value and spreadsheet_safe(value) for value in values]
    return [_cell(value) for value in values] if field.type not in _NUMBERS else values


def _has_carriage_return(cells: Sequence[Any]) -> bool:
    """Return whether a cell has a CR, which csv (up to Python 3.12) fails to quote."""
    return any(type(cell) is str and "\r" in cell for cell in cells)


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        return msgspec.json.encode(value).decode()
    if isinstance(value, bool):
        return "true" if value else "false"
    return value


def _slices(fields: Fields, columns: Columns) -> Iterator[slice]:
    count = len(columns[fields[0].name]) if fields else 0
    step = rows_at_once([columns[field.name] for field in fields], _CHUNK)
    for start in range(0, count, step):
        yield slice(start, start + step)


def rows_at_once(columns: Sequence[ColumnData], most: int) -> int:
    """Return how many rows to convert to Python values at once: fewer where lists are long."""
    lists = [column for column in columns if isinstance(column, Ragged)]
    values = sum(len(column.values) // max(len(column), 1) for column in lists)
    return max(min(most, _VALUES // (values + 1)), 1)


def _chunks(fields: Fields, columns: Columns) -> Iterator[list[list[Any]]]:
    for rows in _slices(fields, columns):
        yield [json_values(col.take(columns[f.name], rows), f.type) for f in fields]


def write_json(file: IO[str], fields: Fields, columns: Columns, *, lines: bool = False) -> None:
    """Write one object per row, in an array or one per line."""
    names = [column.name for column in fields]
    separator, first = ("", "") if lines else (",\n", "[")
    for chunk in _chunks(fields, columns):
        for row in zip(*chunk, strict=True):
            file.write(first + json.dumps(dict(zip(names, row, strict=True))))
            file.write("\n" if lines else "")
            first = separator
    if not lines:
        file.write("[]\n" if first == "[" else "]\n")


def format_grid(
    header: Sequence[str],
    rows: Iterable[Sequence[Any]],
    *,
    with_header: bool = True,
    least_widths: Sequence[int] = (),
    room: LineWidth | None = None,
) -> str:
    """Format cells in columns; numbers aligned to the right, other values to the left.

    Without ``room`` the length of lines is not limited. ``least_widths``, if given, decide which
    columns are shown, so that every call shows the same ones.
    """
    table = [[_shown(value) for value in row] for row in rows]
    numeric = [_is_number(cells) for cells in zip(*table, strict=True)] or [False] * len(header)
    widths = [max(map(len, cells)) for cells in zip(header, *table, strict=True)]
    if room is not None:
        texts = [not number and not least_widths for number in numeric]
        fitted = fit_columns(least_widths or widths, texts, room.width)
        text = _fitted(header, table, numeric, fitted, with_header=with_header)
        is_noted = with_header and fitted.hides
        return f"{text}\n{room.note(len(fitted.columns), len(header))}" if is_noted else text
    if least_widths:
        widths = [max(pair) for pair in zip(widths, least_widths, strict=True)]
    return _laid_out(header, table, numeric, widths, with_header=with_header)


def _fitted(
    header: Sequence[str],
    table: Sequence[Sequence[str]],
    numeric: Sequence[bool],
    fitted: _FittedColumns,
    *,
    with_header: bool,
) -> str:
    """Format the columns that fit."""
    top, *rows = (
        [
            cell if number else shorten(cell, width)
            for cell, number, width in zip(row, numeric, fitted.widths, strict=True)
        ]
        for row in (header, *table)
    )
    return _laid_out(
        fitted.pick(top, DOTS),
        [fitted.pick(row, DOTS) for row in rows],
        fitted.pick(numeric, False),
        fitted.pick(fitted.widths, len(DOTS)),
        with_header=with_header,
    )


def _laid_out(
    header: Sequence[str],
    table: Sequence[Sequence[str]],
    numeric: Sequence[bool],
    widths: Sequence[int],
    *,
    with_header: bool,
) -> str:
    lines = [_line(row, widths, numeric) for row in table]
    if with_header:
        lines = [_line(header, widths, numeric), GAP.join("-" * w for w in widths), *lines]
    return "\n".join(lines)


def _line(cells: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    aligned = [
        cell.rjust(width) if number else cell.ljust(width)
        for cell, width, number in zip(cells, widths, right, strict=True)
    ]
    return GAP.join(aligned).rstrip()


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    listed = json.dumps(value) if isinstance(value, list) else str(_cell(value))
    text = f"{value:.9g}" if isinstance(value, float) else listed
    return shorten(text.replace("\n", "\\n"), _CELL_WIDTH)


def _is_number(cells: Sequence[str]) -> bool:
    return all(cell in ("-", "nan", "NaN") or cell.lstrip("-+")[:1].isdigit() for cell in cells)


def write_grid(
    file: IO[str],
    fields: Fields,
    columns: Columns,
    *,
    header: bool = True,
    steady: bool = False,
    room: LineWidth | None = None,
) -> None:
    """Write all rows as a readable table; ``steady`` keeps the widths the same in every call."""
    titles = [f"{c.name} [{c.unit}]" if c.unit else c.name for c in fields]
    rows = (row for chunk in _chunks(fields, columns) for row in zip(*chunk, strict=True))
    widths = []
    if steady:
        least = (_STEADY_WIDTHS.get(field.type, _STEADY_WIDTH) for field in fields)
        widths = list(map(max, least, map(len, titles)))
    text = format_grid(titles, rows, with_header=header, least_widths=widths, room=room)
    file.write(text + "\n")


def preview(item: str, fields: Fields, columns: Columns, count: int) -> str:
    """Return the first and last rows of a table as text."""
    if count <= 2 * _EDGE_ROWS:
        shown = np.arange(count)
    else:
        shown = np.r_[0:_EDGE_ROWS, count - _EDGE_ROWS : count]
    cells = [json_values(col.take(columns[f.name], shown), f.type) for f in fields]
    text = format_grid([column.name for column in fields], zip(*cells, strict=True))
    if len(shown) < count:
        lines = text.splitlines()
        lines.insert(2 + _EDGE_ROWS, "...")
        text = "\n".join(lines)
    return f"{item}: {count} rows\n{text}"
