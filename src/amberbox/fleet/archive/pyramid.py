"""Least, greatest and mean value per second, minute and hour: what makes long plots fast."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.segments import columns as col
from amberbox.blackbox.segments.flat import Flat, TableSchema
from amberbox.core.clock import NS
from amberbox.core.types import Column, ColumnData, IntArray, Ragged

LEVELS = {"1s": NS, "1min": 60 * NS, "1h": 3600 * NS}
"""Widths of the buckets, finest first; they are cut by log time."""

_STATES = ("min", "max", "mean", "count")
Floats = NDArray[np.float64]


def is_plotted(column: Column) -> bool:
    """Tell whether a column has values between which there is a least and a greatest."""
    return column.type in col.NUMPY_TYPES and column.type != "time"


def has_levels(schema: TableSchema) -> bool:
    """Tell whether a table has levels: one with numbers, that is not the box's own."""
    return schema.source != reserved.SOURCE and any(map(is_plotted, schema.columns))


def level_schema(schema: TableSchema, level: str) -> TableSchema:
    """Return what the columns of a level are: four for each numeric one."""
    columns = [
        replace(c, name=f"{c.name}:{state}", type="int64" if state == "count" else "float64")
        for c in schema.columns
        if is_plotted(c)
        for state in _STATES
    ]
    kind = f"pyramid {level} {schema.id}"
    return replace(schema, type=kind, columns=tuple(columns))


@dataclass(frozen=True, slots=True, eq=False)
class Buckets:
    """Rows of equal length: bucket number, keys of its first row, and values per column.

    ``low``, ``high``, ``total`` and ``count`` have one line per column; a bucket without a value
    has +inf, -inf, 0 and 0.
    """

    number: IntArray
    seq: IntArray
    log_ns: IntArray
    received_ns: IntArray
    stamp_ns: IntArray
    low: Floats
    high: Floats
    total: Floats
    count: IntArray


def of_rows(flat: Flat, names: Sequence[str], width_ns: int) -> Buckets:
    """Sum up rows into buckets of log time."""
    values = np.array([_floats(flat.columns[name]) for name in names]).reshape(
        len(names), len(flat)
    )
    known = ~np.isnan(values)
    return _summed(
        Buckets(
            flat.log_time_ns // width_ns, flat.seq, flat.log_time_ns, flat.received_ns,
            flat.timestamp_ns, np.where(known, values, np.inf), np.where(known, values, -np.inf),
            np.where(known, values, 0.0), known.astype(np.int64),
        )
    )  # fmt: skip


def coarser(parts: Sequence[Buckets], width_ns: int) -> Buckets:
    """Join buckets and sum them up into wider ones."""
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=-1)
        for name in Buckets.__slots__
    }
    return _summed(replace(Buckets(**joined), number=joined["log_ns"] // width_ns))


def _floats(column: ColumnData) -> Floats:
    assert not isinstance(column, Ragged)  # see is_plotted
    values = np.ma.getdata(column).astype(np.float64)
    values[col.null_mask(column)] = np.nan
    return values


def _summed(parts: Buckets) -> Buckets:
    """Make one row of all that have the same number."""
    order = np.lexsort((parts.log_ns, parts.number))
    number = parts.number[order]
    firsts = np.flatnonzero(np.concatenate(([True], number[1:] != number[:-1])))
    return Buckets(
        number[firsts],
        parts.seq[order][firsts],
        parts.log_ns[order][firsts],
        parts.received_ns[order][firsts],
        parts.stamp_ns[order][firsts],
        np.minimum.reduceat(parts.low[:, order], firsts, axis=1),
        np.maximum.reduceat(parts.high[:, order], firsts, axis=1),
        np.add.reduceat(parts.total[:, order], firsts, axis=1),
        np.add.reduceat(parts.count[:, order], firsts, axis=1),
    )


class Climb:
    """Sums up the rows of one table of one journal as they come."""

    def __init__(self, schema: TableSchema) -> None:
        plotted = schema.columns if has_levels(schema) else ()
        self._names = [column.name for column in plotted if is_plotted(column)]
        self._found: list[Buckets] = []
        self._like: Flat | None = None

    def add(self, flat: Flat) -> None:
        """Take rows."""
        if self._names:
            self._like = flat.with_columns({})
            self._found.append(of_rows(flat, self._names, LEVELS["1s"]))

    def levels(self) -> Iterator[tuple[str, Flat]]:
        """Give the rows of each level; none for a table without numbers."""
        found = self._found
        for level, width_ns in LEVELS.items():
            if self._like is not None:
                found = [coarser(found, width_ns)]
                yield level, _flat(self._like, level_schema(self._like.schema, level), found[0])


def _flat(like: Flat, schema: TableSchema, buckets: Buckets) -> Flat:
    mean = np.full(buckets.total.shape, np.nan)
    np.divide(buckets.total, buckets.count, out=mean, where=buckets.count > 0)
    none = buckets.count == 0
    low, high = (np.where(none, np.nan, edge) for edge in (buckets.low, buckets.high))
    lines = [line for four in zip(low, high, mean, buckets.count, strict=True) for line in four]
    columns: dict[str, ColumnData] = {
        column.name: line for column, line in zip(schema.columns, lines, strict=True)
    }
    return Flat(
        schema, like.writer, like.run, buckets.seq, buckets.log_ns, buckets.received_ns,
        buckets.stamp_ns, columns,
    )  # fmt: skip
