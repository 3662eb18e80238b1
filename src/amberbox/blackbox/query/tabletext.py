"""Columns as text: CSV, JSON, and tables for the eye."""

from __future__ import annotations

import base64
import csv
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import IO, Any

import msgspec
import numpy as np

from amberbox.blackbox.query.fitting import DOTS, GAP, Fit, Room, cut, fit
from amberbox.blackbox.segments import columns as col
from amberbox.core.spreadsheets import harmless
from amberbox.core.timetext import format_times
from amberbox.core.types import Column, ColumnData, Ragged

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


def speakable(column: ColumnData, column_type: str) -> list[Any]:
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
    """JSON has no NaN and no infinity: they become the words that ``float`` reads."""
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
    """Write CSV with a header line; a list stands as JSON in its cell.

    Text that a spreadsheet would take for a formula gets a ``'`` before it, but with ``raw_text``.
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
    """Return the cells of a column, as text or as numbers that ``csv`` writes the same way."""
    if field.type in _NUMBERS and not np.ma.isMaskedArray(column) and _all_finite(column):
        return msgspec.json.encode(plain(column))[1:-1].decode().split(",") if len(column) else []
    values = speakable(column, field.type)
    if field.type == "string":
        return values if raw_text else [value and harmless(value) for value in values]
    return [_cell(value) for value in values] if field.type not in _NUMBERS else values


def _has_carriage_return(cells: Sequence[Any]) -> bool:
    """Tell cells that the csv module (up to Python 3.12) leaves unquoted, cutting a row in two."""
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
    """Return how many rows to turn into Python values together: fewer where lists are long."""
    lists = [column for column in columns if isinstance(column, Ragged)]
    values = sum(len(column.values) // max(len(column), 1) for column in lists)
    return max(min(most, _VALUES // (values + 1)), 1)


def _chunks(fields: Fields, columns: Columns) -> Iterator[list[list[Any]]]:
    for rows in _slices(fields, columns):
        yield [speakable(col.take(columns[f.name], rows), f.type) for f in fields]


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


def grid(
    header: Sequence[str],
    rows: Iterable[Sequence[Any]],
    *,
    with_header: bool = True,
    least_widths: Sequence[int] = (),
    room: Room | None = None,
) -> str:
    """Lay out cells in columns; numbers to the right, the rest to the left.

    Without ``room`` lines are as long as they are. ``least_widths`` decide which columns there is
    room for, if given: the same ones for every call.
    """
    table = [[_shown(value) for value in row] for row in rows]
    numeric = [_is_number(cells) for cells in zip(*table, strict=True)] or [False] * len(header)
    widths = [max(map(len, cells)) for cells in zip(header, *table, strict=True)]
    if room is not None:
        texts = [not number and not least_widths for number in numeric]
        fitted = fit(least_widths or widths, texts, room.width)
        text = _fitted(header, table, numeric, fitted, with_header=with_header)
        is_told = with_header and fitted.hides
        return f"{text}\n{room.note(len(fitted.columns), len(header))}" if is_told else text
    if least_widths:
        widths = [max(pair) for pair in zip(widths, least_widths, strict=True)]
    return _laid_out(header, table, numeric, widths, with_header=with_header)


def _fitted(
    header: Sequence[str],
    table: Sequence[Sequence[str]],
    numeric: Sequence[bool],
    fitted: Fit,
    *,
    with_header: bool,
) -> str:
    """Lay out the columns that there is room for."""
    top, *rows = (
        [
            cell if number else cut(cell, width)
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
    return cut(text.replace("\n", "\\n"), _CELL_WIDTH)


def _is_number(cells: Sequence[str]) -> bool:
    return all(cell in ("-", "nan", "NaN") or cell.lstrip("-+")[:1].isdigit() for cell in cells)


def write_grid(
    file: IO[str],
    fields: Fields,
    columns: Columns,
    *,
    header: bool = True,
    steady: bool = False,
    room: Room | None = None,
) -> None:
    """Write all rows as a table for the eye; ``steady`` keeps widths alike from call to call."""
    titles = [f"{c.name} [{c.unit}]" if c.unit else c.name for c in fields]
    rows = (row for chunk in _chunks(fields, columns) for row in zip(*chunk, strict=True))
    widths = list(map(_steady_width, fields, titles)) if steady else ()
    text = grid(titles, rows, with_header=header, least_widths=widths, room=room)
    file.write(text + "\n")


def _steady_width(field: Column, title: str) -> int:
    return max(_STEADY_WIDTHS.get(field.type, _STEADY_WIDTH), len(title))


def preview(item: str, fields: Fields, columns: Columns, count: int) -> str:
    """Show the first and last rows of a table."""
    if count <= 2 * _EDGE_ROWS:
        shown = np.arange(count)
    else:
        shown = np.r_[0:_EDGE_ROWS, count - _EDGE_ROWS : count]
    cells = [speakable(col.take(columns[f.name], shown), f.type) for f in fields]
    text = grid([column.name for column in fields], zip(*cells, strict=True))
    if len(shown) < count:
        lines = text.splitlines()
        lines.insert(2 + _EDGE_ROWS, "...")
        text = "\n".join(lines)
    return f"{item}: {count} rows\n{text}"
