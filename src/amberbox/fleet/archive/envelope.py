"""Long plots: least, greatest and mean value per step, from the level that is fine enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.query.gather import Request, gather
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.query.variables import resolve
from amberbox.blackbox.segments.flat import Flat
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, ColumnData, IntArray, Ragged
from amberbox.fleet.archive.pyramid import LEVELS, is_plotted
from amberbox.fleet.archive.reading import Reader

Span = tuple[int | None, int | None]
_STATES = ("min", "max", "mean", "count")


def envelope(reader: Reader, item: str, variables: Sequence[str], span: Span, points: int) -> Table:
    """Sum up numbers in about ``points`` steps; see ``ArchiveRecord.envelope``.

    Raises UsageError for variables that are no numbers.
    """
    schema = reader.schema(item)
    columns = [wanted.column for wanted in resolve(schema.columns, list(variables), item)]
    texts = [column.name for column in columns if not is_plotted(column)]
    if texts or points < 1:
        what = f"{texts[0]} is no number" if texts else "points must be 1 or more"
        raise UsageError(what, "an envelope has numbers only; query gives every row")
    from_ns, to_ns = _bounds(reader, schema.item, span)
    width_ns = max(-(-(to_ns - from_ns) // points), 1)
    level = next((n for n, w in reversed(LEVELS.items()) if w <= width_ns), "1s")
    names = [f"{column.name}:{state}" for column in columns for state in _STATES]
    # a bucket has the time of its first row: one that the range begins in begins before it
    request = Request(schema.item, names, (from_ns - LEVELS[level], to_ns))
    found = [
        (source.robot, _reaching(piece, from_ns, LEVELS[level]))
        for source in reader.sources
        for piece in gather(
            reader.of(source, schema.item, request=request, level=level), request
        ).pieces
    ]
    width_ns = max(width_ns, LEVELS[level])
    return _table(schema.item, columns, found, from_ns, width_ns)


def _reaching(piece: Flat, from_ns: int, level_ns: int) -> Flat:
    """Leave out buckets that end before a time of receipt; they are cut by log time."""
    ends_ns = piece.received_ns + level_ns - piece.log_time_ns % level_ns
    return piece.take(np.flatnonzero(ends_ns > from_ns))


def _bounds(reader: Reader, item: str, span: Span) -> tuple[int, int]:
    """Fill in where the record begins and ends."""
    from_ns, to_ns = span
    if from_ns is not None and to_ns is not None:
        return from_ns, to_ns
    files = [
        file
        for source in reader.sources
        for schema in reader.schemas[item]
        for file in reader.files(source, schema, None)
    ]
    low = min((file.low["received"] for file in files), default=0)
    high = max((file.high["received"] for file in files), default=0) + 1
    return low if from_ns is None else from_ns, high if to_ns is None else to_ns


def _table(
    item: str,
    columns: Sequence[Column],
    found: Sequence[tuple[str, Flat]],
    from_ns: int,
    width_ns: int,
) -> Table:
    """Sum up rows of a level into steps, robot by robot."""
    robots = sorted({robot for robot, _ in found})
    keys, lines = _joined(found, robots, columns, from_ns, width_ns)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    firsts = np.flatnonzero(np.concatenate(([True], keys[1:] != keys[:-1]))) if len(keys) else keys
    steps = keys[firsts] // max(len(robots), 1)
    out: dict[str, ColumnData] = {"timestamp": from_ns + steps * width_ns}
    fields = [Column("timestamp", "timestamp", "time")]
    if len(robots) > 1:
        fields.append(Column("robot", "robot", "string"))
        out["robot"] = np.array(robots, object)[keys[firsts] % len(robots)]
    for column in columns:
        four = [line[order] for line in lines[column.name]]
        for state, line in zip(_STATES, _states(four, firsts), strict=True):
            kind = "int64" if state == "count" else "float64"
            fields.append(replace(column, name=f"{column.name}:{state}", type=kind))
            out[f"{column.name}:{state}"] = line
    return Table(item, tuple(fields), out)


def _joined(
    found: Sequence[tuple[str, Flat]],
    robots: Sequence[str],
    columns: Sequence[Column],
    from_ns: int,
    width_ns: int,
) -> tuple[IntArray, dict[str, list[NDArray[Any]]]]:
    parts = [
        np.maximum(p.received_ns - from_ns, 0) // width_ns * len(robots) + robots.index(robot)
        for robot, p in found
    ]
    keys = np.concatenate(parts) if parts else np.empty(0, np.int64)
    return keys, {
        column.name: [
            np.concatenate([_values(p, f"{column.name}:{state}") for _, p in found] or [keys])
            for state in _STATES
        ]
        for column in columns
    }


def _values(piece: Flat, name: str) -> NDArray[Any]:
    """Return a column of a level; nothing where this version of the schema had none."""
    known = piece.columns.get(name)
    if known is None:
        return np.zeros(len(piece)) if name.endswith(":count") else np.full(len(piece), np.nan)
    assert not isinstance(known, Ragged)  # levels have numbers only
    return known


def _states(four: Sequence[NDArray[Any]], firsts: IntArray) -> list[ColumnData]:
    low, high, mean, count = (np.asarray(line, np.float64) for line in four)
    if not len(firsts):
        return [low, high, mean, count.astype(np.int64)]
    total = np.add.reduceat(np.where(count > 0, mean * count, 0.0), firsts)
    number = np.add.reduceat(count, firsts)
    middle = np.full(len(firsts), np.nan)
    np.divide(total, number, out=middle, where=number > 0)
    return [
        np.fmin.reduceat(low, firsts), np.fmax.reduceat(high, firsts), middle,
        number.astype(np.int64),
    ]  # fmt: skip
