"""Rollups for long plots: least, greatest and mean value per second, minute and hour."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema
from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.types import Column, ColumnData, IntArray, Ragged

# Widths of the buckets, finest first; they are cut by log time
LEVELS = {"1s": NS, "1min": 60 * NS, "1h": 3600 * NS}

_STATES = ("min", "max", "mean", "count")
Floats = NDArray[np.float64]


def is_plotted(column: Column) -> bool:
    """Return whether a column is numeric."""
    return column.type in col.NUMPY_TYPES and column.type != "time"


def has_levels(schema: TableSchema) -> bool:
    """Return whether a table has rollup levels: numeric columns, and not the recorder's own."""
    return schema.source != channels.SOURCE and any(map(is_plotted, schema.columns))


def level_schema(schema: TableSchema, level: str) -> TableSchema:
    """Return the schema of a level: four columns for each numeric one."""
    columns = [
        replace(c, name=f"{c.name}:{state}", type="int64" if state == "count" else "float64")
        for c in schema.columns
        if is_plotted(c)
        for state in _STATES
    ]
    kind = f"pyramid {level} {schema.id}"
    return replace(schema, type=kind, columns=tuple(columns))


@dataclass(frozen=True, slots=True, eq=False)
class RollupBuckets:
    """Rows of equal length: bucket number, keys of its first row, and values per column.

    ``low``, ``high``, ``total`` and ``count`` have the shape (columns, rows); a bucket without a
    value has +inf, -inf, 0 and 0.
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


def rollup_rows(flat: FlatTable, names: Sequence[str], width_ns: int) -> RollupBuckets:
    """Aggregate rows into buckets of log time."""
    values = np.array([_floats(flat.columns[name]) for name in names]).reshape(
        len(names), len(flat)
    )
    known = ~np.isnan(values)
    return _summed(
        RollupBuckets(
            flat.log_time_ns // width_ns, flat.seq, flat.log_time_ns, flat.received_ns,
            flat.timestamp_ns, np.where(known, values, np.inf), np.where(known, values, -np.inf),
            np.where(known, values, 0.0), known.astype(np.int64),
        )
    )  # fmt: skip


def coarser_rollup(parts: Sequence[RollupBuckets], width_ns: int) -> RollupBuckets:
    """Join buckets and aggregate them into wider ones."""
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=-1)
        for name in RollupBuckets.__slots__
    }
    return _summed(replace(RollupBuckets(**joined), number=joined["log_ns"] // width_ns))


def _floats(column: ColumnData) -> Floats:
    assert not isinstance(column, Ragged)  # see is_plotted
    values = np.ma.getdata(column).astype(np.float64)
    values[col.null_mask(column)] = np.nan
    return values


def _summed(parts: RollupBuckets) -> RollupBuckets:
    """Merge all rows of the same bucket number."""
    order = np.lexsort((parts.log_ns, parts.number))
    number = parts.number[order]
    firsts = np.flatnonzero(np.concatenate(([True], number[1:] != number[:-1])))
    return RollupBuckets(
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


class RollupBuilder:
    """Aggregates the rows of one table of one journal as they are added."""

    def __init__(self, schema: TableSchema) -> None:
        plotted = schema.columns if has_levels(schema) else ()
        self._names = [column.name for column in plotted if is_plotted(column)]
        self._found: list[RollupBuckets] = []
        self._like: FlatTable | None = None

    def add(self, flat: FlatTable) -> None:
        """Add rows."""
        if self._names:
            self._like = flat.with_columns({})
            self._found.append(rollup_rows(flat, self._names, LEVELS["1s"]))

    def levels(self) -> Iterator[tuple[str, FlatTable]]:
        """Yield the rows of each level; none for a table without numbers."""
        found = self._found
        for level, width_ns in LEVELS.items():
            if self._like is not None:
                found = [coarser_rollup(found, width_ns)]
                yield level, _flat(self._like, level_schema(self._like.schema, level), found[0])


def _flat(like: FlatTable, schema: TableSchema, buckets: RollupBuckets) -> FlatTable:
    mean = np.full(buckets.total.shape, np.nan)
    np.divide(buckets.total, buckets.count, out=mean, where=buckets.count > 0)
    none = buckets.count == 0
    low, high = (np.where(none, np.nan, edge) for edge in (buckets.low, buckets.high))
    lines = [line for four in zip(low, high, mean, buckets.count, strict=True) for line in four]
    columns: dict[str, ColumnData] = {
        column.name: line for column, line in zip(schema.columns, lines, strict=True)
    }
    return FlatTable(
        schema, like.writer, like.run, buckets.seq, buckets.log_ns, buckets.received_ns,
        buckets.stamp_ns, columns,
    )  # fmt: skip
