"""Rows of an item: all of a range up to a limit, thinned out for a plot, or summed up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from amberbox.blackbox.query.downsample import downsample
from amberbox.blackbox.query.gather import Merged, Request, merge
from amberbox.blackbox.query.record import make_table, needed_columns, wanted_columns
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.query.variables import Wanted
from amberbox.blackbox.segments import columns as col
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.core.types import IntArray
from amberbox.fleet.archive.envelope import envelope
from amberbox.fleet.archive.pyramid import has_levels, is_plotted
from amberbox.fleet.asking.errors import LimitError
from amberbox.fleet.data.asked import MOST_ROWS, About, Asked
from amberbox.fleet.data.look import Look, Span
from amberbox.fleet.linkend.presence import said_until

THINNED_ROWS = 1_000_000
"""Of more rows than this a thinned answer is made from the pyramid."""
_LEAST_POINTS = 5
"""Of each variable least, greatest, first, last and a missing value; fewer would drop extremes."""
_BEHIND_NS = 5 * NS
"""So much less on the server than on the robot is worth a word."""
_KEYS = frozenset({"timestamp", "received", "seq", "parent_seq"})


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A table, the time of each row by which they are in order, and what is to be said of it."""

    table: Table
    times_ns: IntArray
    about: About


def rows(look: Look, asked: Asked) -> Answer:
    """Answer; raises UsageError for what is not there, LimitError for too much."""
    span = asked.from_ns, asked.to_ns
    if None not in span and (asked.from_ns or 0) >= (asked.to_ns or 0):
        raise UsageError("the range ends before it begins", "exchange from and to")
    schema = look.schema(asked.item)
    wanted = wanted_columns(look, schema, asked.variables)
    answer = _answer(look, schema, wanted, asked)
    about = answer.about
    notes = [] if about.next_ns is not None else not_copied(look, asked)
    return replace(answer, about=msgspec.structs.replace(about, notes=[*about.notes, *notes]))


def not_copied(look: Look, asked: Asked) -> list[str]:
    """Say that the newest data of a range are still on the robot, and how to get them."""
    complete_ns = look.complete_ns()
    with look.catalogue.database.reading() as connection:
        newest_ns = said_until(connection, asked.robot)
    if complete_ns is None or newest_ns is None or newest_ns - complete_ns < _BEHIND_NS:
        return []
    if asked.to_ns is not None and asked.to_ns <= complete_ns:
        return []
    to_ns = newest_ns if asked.to_ns is None else min(newest_ns, asked.to_ns)
    complete, newest, to = (f"{format_time(t)[:19]}Z" for t in (complete_ns, newest_ns, to_ns))
    return [f"complete until {complete}; the robot has data until {newest}: "
            f"amberbox fetch URL {asked.item} {complete} {to} --wait"]  # fmt: skip


def _answer(look: Look, schema: TableSchema, wanted: Sequence[Wanted], asked: Asked) -> Answer:
    span = asked.from_ns, asked.to_ns
    if asked.points is not None:
        if estimate(look, schema, span) > THINNED_ROWS and asked.by == "received":
            return _summed(look, schema, wanted, asked)
        return _thinned(_read(look, schema, wanted, asked, MOST_ROWS), asked.points)
    return _read(look, schema, wanted, asked, asked.limit)


def _read(
    look: Look, schema: TableSchema, wanted: Sequence[Wanted], asked: Asked, limit: int
) -> Answer:
    span, to_come = _narrowed(look, schema, asked, limit)
    needed = needed_columns(wanted)
    found = look.rows(Request(schema.item, needed, span, asked.by))
    notes = [*found.notes, *(f"{gap.item or gap.writer}: {gap.reason}" for gap in found.gaps)]
    merged = merge(found.pieces, schema, needed, asked.by)
    times = merged.received_ns if asked.by == "received" else merged.timestamp_ns
    count, next_ns = _cut(times, limit)
    if count < len(times):
        merged, times = _first(merged, count), times[:count]
    table = make_table(schema, wanted, merged, notes)
    about = About(
        len(table), "rows", to_come if next_ns is None else next_ns, look.complete_ns(),
        list(table.notes),
    )  # fmt: skip
    return Answer(table, times, about)


def _cut(times_ns: IntArray, limit: int) -> tuple[int, int | None]:
    """Return how many rows are given, and when the next ones are; equal times stay together."""
    if len(times_ns) <= limit:
        return len(times_ns), None
    next_ns = int(times_ns[limit])
    count = int(np.searchsorted(times_ns, next_ns, "left"))
    if not count:  # all of them at one instant
        count = int(np.searchsorted(times_ns, next_ns, "right"))
        return count, int(times_ns[count]) if count < len(times_ns) else None
    return count, next_ns


def _first(merged: Merged, count: int) -> Merged:
    part = slice(count)
    columns = {name: col.take(column, part) for name, column in merged.columns.items()}
    return Merged(merged.seq[part], merged.received_ns[part], merged.timestamp_ns[part], columns)


def _narrowed(look: Look, schema: TableSchema, asked: Asked, limit: int) -> tuple[Span, int | None]:
    """Leave out files that come after enough rows for certain; return where these begin.

    Raises LimitError where there is more than may be held in memory.
    """
    span = asked.from_ns, asked.to_ns
    files = files_of(look, schema, Request(schema.item, (), span, asked.by))
    if asked.by == "received":
        count, last = 0, span[1]
        for low, high, number in sorted(files, key=lambda file: file[1]):
            if (span[0] is None or low >= span[0]) and (last is None or high < last):
                count += number
                if count > limit:
                    return (span[0], high + 1), high + 1
    if sum(number for *_, number in files) > 4 * MOST_ROWS:
        raise LimitError("this is more than one answer can hold", "name a shorter range")
    return span, None


def files_of(
    look: Look, schema: TableSchema, request: Request | None
) -> list[tuple[int, int, int]]:
    """List least and greatest time of receipt, and rows, of the files that a request is about."""
    reader = look.reader
    return [
        (int(file.low["received"]), int(file.high["received"]), file.rows)
        for source in reader.sources
        for version in reader.schemas.get(schema.item, ())
        for file in reader.files(source, version, request)
    ]


def estimate(look: Look, schema: TableSchema, span: Span) -> float:
    """Guess how many rows of the tables lie in a range."""
    total = 0.0
    for low, high, number in files_of(look, schema, Request(schema.item, (), span)):
        start = low if span[0] is None else max(low, span[0])
        stop = high if span[1] is None else min(high, span[1])
        total += number * min(max(stop - start, 0) / max(high - low, 1), 1.0)
    return total


def _thinned(answer: Answer, points: int) -> Answer:
    table = answer.table
    if answer.about.next_ns is not None:
        raise LimitError(f"this is more than {MOST_ROWS} rows", "name a shorter range")
    variables = [table.columns[name] for name in table.names if name not in _KEYS]
    chosen = downsample(variables, len(table), max(points, _LEAST_POINTS * len(variables)))
    about = msgspec.structs.replace(answer.about, rows=len(chosen), of=len(table))
    return Answer(table.take(chosen), answer.times_ns[chosen], about)


def _summed(look: Look, schema: TableSchema, wanted: Sequence[Wanted], asked: Asked) -> Answer:
    """Sum up more rows than can be read, from the levels above them."""
    named = [w.column for w in wanted if w.element is None and schema.column(w.name) is not None]
    numbers = [column.name for column in named if is_plotted(column)]
    if not numbers or not has_levels(schema):
        raise LimitError(
            f"this is more than {THINNED_ROWS} rows, and only numbers can be summed up",
            "name a shorter range",
        )
    assert asked.points is not None
    span = asked.from_ns, asked.to_ns
    table = envelope(look.reader, schema.item, numbers, span, asked.points)
    times = table.columns["timestamp"]
    assert isinstance(times, np.ndarray)
    notes = list(table.notes)
    left = [w.name for w in wanted[1:] if w.name not in numbers]
    notes += [f"left out, only numbers can be summed up: {', '.join(left)}"] if left else []
    of = max((int(np.asarray(table.columns[f"{name}:count"]).sum()) for name in numbers), default=0)
    about = About(len(table), "envelope", None, look.committed_ns(), notes, of)
    return Answer(table, times, about)
