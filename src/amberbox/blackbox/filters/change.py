"""Keep a message only when something in it has changed enough, or the heartbeat is due.

A row is kept when a watched variable differs from the last kept row by more than its dead band,
when the number of rows in a child table differs, or when the heartbeat is due. The answer does not
depend on how the stream is cut into batches.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns.arrays import offsets_of
from amberbox.blackbox.columns.variables import select_columns
from amberbox.core.errors import UsageError
from amberbox.core.source import ChangeOptions
from amberbox.core.types import Column, ColumnData, IntArray, ItemSchema, Ragged, Rows

NUMBERS = ("int", "uint", "float")
# dead bands of these are given in seconds, their values are nanoseconds
TIMES = {"time": 1e9, "duration": 1e9}

# fields that a header counts up by itself, anywhere in the message
HEADER_FIELDS = ("header/stamp", "header/seq")


@dataclass(frozen=True, slots=True)
class DeadBand:
    """The dead band of one variable: zero when any difference is a change."""

    absolute: float = 0.0
    relative: float = 0.0

    def __bool__(self) -> bool:
        return self.absolute > 0 or self.relative > 0


@dataclass(frozen=True, slots=True, eq=False)
class DeadBands:
    """The dead bands of some variables, side by side."""

    absolute: NDArray[np.float64]
    relative: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ColumnGroup:
    """Columns that can be compared at once: of one type, all with a dead band or all without."""

    names: tuple[str, ...]
    bands: DeadBands | None
    is_list: bool = False


@dataclass(frozen=True, slots=True)
class WatchedColumns:
    """The columns of one table to compare, and its child tables; a list column is a group."""

    groups: tuple[ColumnGroup, ...]
    children: Mapping[str, WatchedColumns]


@dataclass(frozen=True, slots=True)
class _ColumnCell:
    """A column of a table; ``table`` is the path of child tables down to it."""

    table: tuple[str, ...]
    column: Column
    is_stamp: bool

    @property
    def path(self) -> str:
        return "/".join([*self.table, self.column.path])

    @property
    def element(self) -> str:
        return self.column.type.removeprefix("list<").removesuffix(">")

    @property
    def has_band(self) -> bool:
        return self.element in TIMES or self.element.startswith(NUMBERS)

    def band(self, absolute: float, relative: float = 0.0) -> DeadBand:
        return DeadBand(absolute * TIMES.get(self.element, 1.0), relative)


def watched(schema: ItemSchema, options: ChangeOptions) -> tuple[WatchedColumns, tuple[str, ...]]:
    """Return the columns to compare, and the names in ``options`` that fit no variable.

    Without ``options.variables`` everything is compared except the message's own time stamp and the
    fields that headers count up (``header/stamp``, ``header/seq``); the same holds when none of its
    names fits, since a misspelt name must not drop every message. A name, or a band, includes these
    fields, too.
    """
    places = {place.path: place for place in _column_cells(schema)}
    named, unknown = _select(places, options.variables) if options.variables else ((), ())
    watch = named or [path for path, place in places.items() if not place.is_stamp]
    bands = {
        path: places[path].band(options.absolute, options.relative)
        if places[path].has_band
        else DeadBand()
        for path in watch
    }
    unfit = []
    for pattern, width in options.bands.items():
        paths = [path for path in _select(places, [pattern])[0] if places[path].has_band]
        bands |= {path: places[path].band(width) for path in paths}
        unfit += [] if paths else [pattern]
    return _tree(places, bands, ()), (*unknown, *unfit)


def _column_cells(schema: ItemSchema, table: tuple[str, ...] = ()) -> Iterator[_ColumnCell]:
    for column in schema.columns:
        yield _ColumnCell(table, column, _is_stamp(column.path, schema.stamp))
    for path, child in schema.children.items():
        yield from _column_cells(child, (*table, path))


def _is_stamp(path: str, stamp: str) -> bool:
    own = bool(stamp) and (path == stamp or path.startswith(f"{stamp}/"))
    return own or any(f"/{path}/".find(f"/{field}/") >= 0 for field in HEADER_FIELDS)


def _select(
    places: Mapping[str, _ColumnCell], patterns: Sequence[str]
) -> tuple[Sequence[str], Sequence[str]]:
    """Find paths by the rule for ``variable_names``, across child tables too."""
    columns = tuple(
        # Names are unique within one table only; paths are unique altogether.
        replace(place.column, name=path if place.table else place.column.name, path=path)
        for path, place in places.items()
    )
    by_name = {column.name: column.path for column in columns}
    names, unmatched = select_columns(ItemSchema("", columns), tuple(patterns))
    return [by_name[name] for name in names], unmatched


def _tree(
    places: Mapping[str, _ColumnCell], bands: Mapping[str, DeadBand], table: tuple[str, ...]
) -> WatchedColumns:
    here = [path for path in bands if places[path].table == table]
    depth = len(table)
    others = [places[path].table for path in bands]
    below = dict.fromkeys(o[depth] for o in others if len(o) > depth and o[:depth] == table)
    return WatchedColumns(
        tuple(_groups([places[path].column for path in here], [bands[path] for path in here])),
        {path: _tree(places, bands, (*table, path)) for path in below},
    )


def _groups(columns: Sequence[Column], bands: Sequence[DeadBand]) -> Iterator[ColumnGroup]:
    groups: dict[tuple[str, bool, str], list[tuple[str, DeadBand]]] = {}
    for column, band in zip(columns, bands, strict=True):
        is_list = column.type.startswith("list<")
        key = (column.type, bool(band), column.name if is_list else "")
        groups.setdefault(key, []).append((column.name, band))
    for (_, has_band, list_name), members in groups.items():
        side_by_side = DeadBands(
            np.array([band.absolute for _, band in members]),
            np.array([band.relative for _, band in members]),
        )
        names = tuple(name for name, _ in members)
        yield ColumnGroup(names, side_by_side if has_band else None, bool(list_name))


@dataclass(frozen=True, slots=True, eq=False)
class ValueSeries:
    """Lines of values, one column each; row ``i`` has ``values[offsets[i]:offsets[i + 1]]``.

    Without ``offsets`` each row has one line. Values that are null are 0, or None in objects.
    Without ``bands`` any difference is a change.
    """

    values: NDArray[Any]
    nulls: NDArray[np.bool_] | None
    offsets: IntArray | None
    bands: DeadBands | None = None

    def of_rows(self, first: int, last: int) -> NDArray[Any]:
        """Return the lines of rows ``first`` to ``last - 1``, one after the other."""
        return self.values[self._column_cells(first, last)]

    def row(self, row: int) -> ValueSeries:
        """Return one row as a series of its own that holds nothing else in memory."""
        part = self._column_cells(row, row + 1)
        nulls = None if self.nulls is None else self.nulls[part].copy()
        offsets = None if self.offsets is None else np.array([0, part.stop - part.start])
        return ValueSeries(self.values[part].copy(), nulls, offsets, self.bands)

    def lines(self) -> slice:
        """Return where the lines of all rows are."""
        return slice(None) if self.offsets is None else self._column_cells(0, -1)

    def _column_cells(self, first: int, last: int) -> slice:
        if self.offsets is None:
            return slice(first, last)
        return slice(int(self.offsets[first]), int(self.offsets[last]))


def flatten_rows(
    rows: Rows, watched: WatchedColumns, offsets: IntArray | None = None
) -> Iterator[ValueSeries]:
    """Lay the watched columns of a table and of its child tables out as series.

    ``offsets`` are the first rows of each message in this table, None if each row is one message.
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
        parent_row = rows.children[path].parent_row
        assert parent_row is not None, "a child table says which row each of its rows belongs to"
        starts = np.searchsorted(parent_row, np.arange(rows.count + 1))
        yield ValueSeries(np.diff(starts)[:, None], None, offsets)
        inner = starts if offsets is None else starts[offsets]
        yield from flatten_rows(rows.children[path], child, inner)


def join_series(first: Sequence[ValueSeries], then: Sequence[ValueSeries]) -> list[ValueSeries]:
    """Append rows to rows, series by series."""
    return [_join(one, other) for one, other in zip(first, then, strict=True)]


def _series(
    columns: Sequence[ColumnData], group: ColumnGroup, offsets: IntArray | None
) -> ValueSeries:
    plain = [column for column in columns if not isinstance(column, Ragged)]
    values = np.stack([np.ma.filled(column, 0) for column in plain], axis=1)
    if not any(isinstance(column, np.ma.MaskedArray) for column in plain):
        return ValueSeries(values, None, offsets, group.bands)
    nulls = np.stack([np.ma.getmaskarray(column) for column in plain], axis=1)
    return ValueSeries(values, nulls, offsets, group.bands)


def _lists(
    column: ColumnData, group: ColumnGroup, offsets: IntArray | None
) -> Iterator[ValueSeries]:
    """Yield the lengths (-1 for a null) and then the elements of a list column."""
    lists, lengths = _as_ragged(column)
    yield ValueSeries(lengths[:, None], None, offsets)
    inner = lists.offsets if offsets is None else lists.offsets[offsets]
    yield _series([lists.values], group, inner)


def _as_ragged(column: ColumnData) -> tuple[Ragged, IntArray]:
    if isinstance(column, Ragged):
        return column, np.diff(column.offsets)
    lengths = np.array([-1 if row is None else len(row) for row in column], dtype=np.int64)
    offsets = offsets_of(np.maximum(lengths, 0))
    present = [row for row in column if row is not None]
    return Ragged(offsets, np.concatenate(present) if present else np.empty(0)), lengths


def _join(first: ValueSeries, then: ValueSeries) -> ValueSeries:
    both, nulls, offsets = (first, then), None, None
    if first.nulls is not None or then.nulls is not None:
        nulls = np.concatenate(
            [
                np.zeros(one.values.shape, bool)[one.lines()]
                if one.nulls is None
                else one.nulls[one.lines()]
                for one in both
            ]
        )
    if first.offsets is not None and then.offsets is not None:
        offsets = offsets_of(np.concatenate([np.diff(first.offsets), np.diff(then.offsets)]))
    values = np.concatenate([one.values[one.lines()] for one in both])
    return ValueSeries(values, nulls, offsets, then.bands)


FIRST_WINDOW = 16

BoolArray = NDArray[np.bool_]


class ChangeFilter:
    """The change filter of one item, for as long as its schema stays the same.

    ``unused`` holds the names in the options that fit no variable (or, with a band, no number).
    A widened schema needs a filter of its own; its first row is kept, as a change of schema is
    a change.
    """

    def __init__(self, options: ChangeOptions, schema: ItemSchema) -> None:
        numbers = {"absolute": options.absolute, "relative": options.relative}
        numbers |= {"heartbeat_s": options.heartbeat_s}
        numbers |= {f"bands.{name}": width for name, width in options.bands.items()}
        for key, value in numbers.items():
            if not value >= 0:
                raise UsageError(f"change.{key} is {value:g}", "give a number that is 0 or more")
        self.schema = schema
        self._watched, self.unused = watched(schema, options)
        self._heartbeat_ns = options.heartbeat_s * 1e9 if options.heartbeat_s else math.inf
        self._last: list[ValueSeries] = []
        self._last_ns = 0

    def mask(self, rows: Rows, received_ns: IntArray) -> BoolArray:
        """Return which rows to keep; ``received_ns`` is their time of receipt, in order."""
        if not rows.count:
            return np.zeros(0, bool)
        series = list(flatten_rows(rows, self._watched))
        if self._last:
            series = join_series(self._last, series)
            received_ns = np.concatenate([[self._last_ns], received_ns])
        kept = _keep(series, received_ns, self._heartbeat_ns)
        last = int(np.flatnonzero(kept)[-1])
        keeps_none_of_these = bool(self._last) and last == 0
        answer = kept[1:] if self._last else kept
        if not keeps_none_of_these:
            self._last = [one.row(last) for one in series]
            self._last_ns = int(received_ns[last])
        return answer


def _keep(series: Sequence[ValueSeries], received_ns: IntArray, heartbeat_ns: float) -> BoolArray:
    """Return which rows to keep of rows whose first one is kept (or was, in the batch before).

    Where any difference counts, comparing with the row before is enough: that row was either
    kept, or equal to the last kept one. Only dead bands and the heartbeat need the last kept row.
    """
    count = len(received_ns)
    # rows that differ in a variable without dead band; the first row never does
    kept = np.zeros(count, bool)
    for one in series:
        kept[1:] |= _single_differs(one) if one.offsets is None else _list_differs(one)
    kept[0] = True
    forced = [*np.flatnonzero(kept).tolist(), count]
    banded = _Banded(series, received_ns, heartbeat_ns)
    for start, stop in itertools.pairwise(forced):
        row = start
        while (row := banded.next_kept(row, stop)) < stop:
            kept[row] = True
    return kept


class _Banded:
    """The series that have dead bands, ready to be compared with any row."""

    def __init__(
        self, series: Sequence[ValueSeries], received_ns: IntArray, heartbeat_ns: float
    ) -> None:
        self._received_ns = received_ns
        self._heartbeat_ns = heartbeat_ns
        self._series = [one for one in series if one.bands is not None]

    def next_kept(self, last: int, stop: int) -> int:
        """Return the first row after ``last`` and before ``stop`` to keep, else ``stop``.

        All lists between ``last`` and ``stop`` must have the length that they have at ``last``.
        """
        start, width = last + 1, FIRST_WINDOW
        while start < stop:
            end = min(start + width, stop)
            silent_ns = np.abs(self._received_ns[start:end] - self._received_ns[last])
            hits: BoolArray = silent_ns >= self._heartbeat_ns
            for one in self._series:
                hits |= _beyond_band(one, last, start, end)
            if hits.any():
                return start + int(hits.argmax())
            start, width = end, 2 * width
        return stop


def _beyond_band(one: ValueSeries, last: int, start: int, end: int) -> BoolArray:
    """Return which rows differ from row ``last`` by more than the wider of the two bands."""
    assert one.bands is not None
    reference = one.of_rows(last, last + 1).astype(np.float64)
    window = one.of_rows(start, end).reshape(end - start, *reference.shape)
    with np.errstate(invalid="ignore", over="ignore"):  # inf - inf: see _special
        width = np.maximum(one.bands.absolute, one.bands.relative * np.abs(reference))
        beyond = np.abs(window - reference) > width
    return np.asarray(beyond.any(axis=(1, 2)), bool)


def _single_differs(one: ValueSeries) -> BoolArray:
    differs = np.zeros(len(one.values) - 1, bool)
    for values in _exact_parts(one):
        differs |= _unequal(values[1:], values[:-1])
    return differs


def _list_differs(one: ValueSeries) -> BoolArray:
    assert one.offsets is not None
    lengths = np.diff(one.offsets)
    differs: BoolArray = lengths[1:] != lengths[:-1]
    begin, end = int(one.offsets[1]), int(one.offsets[-1])
    here = np.arange(begin, end)
    # An element's partner stands one list before it; where lengths differ that no longer matters.
    before = here - np.repeat(lengths[:-1], lengths[1:])
    for values in _exact_parts(one):
        unequal = _unequal(values[here], values[np.maximum(before, 0)])
        count = np.concatenate([[0], np.cumsum(unequal)])
        places = one.offsets[1:] - begin
        differs = differs | (count[places[1:]] > count[places[:-1]])
    return differs


def _exact_parts(one: ValueSeries) -> list[NDArray[Any]]:
    """Return the values of a series in which any difference is a change."""
    nulls = [] if one.nulls is None else [one.nulls]
    if one.bands is None:
        return [one.values, *nulls]
    return [_special(one.values), *nulls] if one.values.dtype.kind == "f" else nulls


def _special(values: NDArray[Any]) -> NDArray[np.int8]:
    """Mark values that dead bands do not apply to: NaN and the two infinities."""
    marks = np.zeros(values.shape, np.int8)
    marks[np.isposinf(values)] = 1
    marks[np.isneginf(values)] = 2
    marks[np.isnan(values)] = 3
    return marks


def _unequal(first: NDArray[Any], second: NDArray[Any]) -> BoolArray:
    """Return which lines differ in any value; NaN equals NaN."""
    unequal = np.asarray(first != second, bool)
    if first.dtype.kind == "f":
        unequal &= ~(np.isnan(first) & np.isnan(second))
    return np.asarray(unequal.any(axis=1), bool)
