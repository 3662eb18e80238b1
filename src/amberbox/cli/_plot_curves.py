"""What a plot shows: curves that break where rows are missing, and the gaps' reasons."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.query.downsample import downsample
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments.columns import null_mask
from amberbox.cli._window import window_of
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Column, ColumnData, Gap, IntArray, Ragged

_HOLE_FACTOR = 10
_HOLE_NS = NS


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One variable: NaN where it is missing or where the line has to break."""

    name: str
    unit: str
    times_ns: IntArray
    values: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A plot before it is drawn; ``clock`` says whose times the axis shows."""

    title: str
    clock: str
    local: bool
    curves: tuple[Curve, ...]
    gaps: tuple[tuple[int, int, str], ...]
    rows: int
    notes: tuple[str, ...]

    def units(self) -> list[str]:
        """Return the units in use: each has a panel of its own."""
        return list(dict.fromkeys(curve.unit for curve in self.curves))


def drawing(record: Record, args: argparse.Namespace) -> Drawing:
    """Query what a plot shows.

    Raises UsageError for variables that are not numbers, AmberboxError for an empty range.
    """
    if args.points < 1:
        raise UsageError("--points must be 1 or more")
    span = window_of(args, record)
    named = [*args.variables, "received"]
    table, is_whole = record.drawn(args.item, named, span, args.by, args.points)
    if not len(table):
        raise AmberboxError(
            f"{table.item} has no rows in this range", "amberbox items shows its times"
        )
    fields = [f for f in table.fields if f.name not in ("timestamp", "received")]
    times = np.asarray(table["received" if args.by == "received" else "timestamp"])
    gaps = _gaps(record, table.item, times)
    holes = _holes(times) if is_whole else np.empty(0, np.int64)  # thinned rows are uneven
    shown, breaks = _shown_rows(table, fields, (times, holes), gaps, args.points)
    curves = tuple(_curve(table, field, times, shown, breaks) for field in fields)
    clock = "time of receipt" if args.by == "received" else "own time stamps"
    return Drawing(table.item, clock, args.local, curves, gaps, len(table), table.notes)


def _gaps(record: Record, item: str, times: IntArray) -> tuple[tuple[int, int, str], ...]:
    first, last = int(times.min()), int(times.max())
    known = [gap for gap in record.gaps(item, first, last + 1) if not _is_of_one(gap, times)]
    found = [_clipped(gap, first, last) for gap in known]
    return tuple(gap for gap in found if gap[1] > gap[0])


def _is_of_one(gap: Gap, times: IntArray) -> bool:
    """Tell whether only one publisher was missing, while others were recorded."""
    return bool(gap.peer and ((times >= gap.from_ns) & (times < gap.to_ns)).any())


def _clipped(gap: Gap, first_ns: int, last_ns: int) -> tuple[int, int, str]:
    return max(gap.from_ns, first_ns), min(gap.to_ns, last_ns), gap.reason


def _shown_rows(
    table: Table,
    fields: list[Column],
    rows: tuple[IntArray, IntArray],
    gaps: tuple[tuple[int, int, str], ...],
    points: int,
) -> tuple[IntArray, IntArray]:
    """Return the rows to draw, and those of them after which the line breaks."""
    times, breaks = rows
    for from_ns, to_ns, _ in gaps:
        before = int(np.searchsorted(times, (from_ns + to_ns) // 2)) - 1
        breaks = np.append(breaks, before)
    breaks = np.unique(breaks[(breaks >= 0) & (breaks < len(times) - 1)])
    thinned = downsample([table[field.name] for field in fields], len(times), points)
    return np.unique(np.concatenate((thinned, breaks, breaks + 1))), breaks


def _holes(times: IntArray) -> IntArray:
    """Return the rows after which nothing came for much longer than usual."""
    steps = np.diff(times)
    if not len(steps):
        return np.empty(0, np.int64)
    usual = max(float(np.median(steps)) * _HOLE_FACTOR, _HOLE_NS)
    return np.flatnonzero(steps > usual)


def _curve(
    table: Table, field: Column, times: IntArray, shown: IntArray, breaks: IntArray
) -> Curve:
    values = _numbers(table[field.name], field)
    places = np.searchsorted(shown, breaks) + 1
    return Curve(
        field.name,
        field.unit,
        np.insert(times[shown], places, times[breaks] + 1),
        np.insert(values[shown], places, np.nan),
    )


def _numbers(column: ColumnData, field: Column) -> NDArray[np.float64]:
    if isinstance(column, Ragged) or column.dtype == object:
        element = f"; name an element: {field.name}[0]" if field.type.startswith("list<") else ""
        raise UsageError(f"{field.name} is {field.type}, not a number", f"plot numbers{element}")
    numbers = np.ma.getdata(column).astype(np.float64)
    numbers[null_mask(column)] = np.nan
    return numbers
