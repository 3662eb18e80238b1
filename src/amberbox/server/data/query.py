"""Queries of rows: the query, reading up to a limit, thinning or aggregation, and encoding.

Answers are JSON, CSV, an Arrow stream, or binary numbers for plots.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns import table_text
from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.columns.variables import SelectedColumn
from amberbox.blackbox.query.rows import make_table, needed_columns, wanted_columns
from amberbox.blackbox.query.table import Table, downsample
from amberbox.blackbox.store.table_reader import MergedRows, RowRequest, merge
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time, format_to_second
from amberbox.core.types import Column, ColumnData, IntArray, Ragged
from amberbox.server.archive.reader import Span, envelope
from amberbox.server.archive.rollups import has_levels, is_plotted
from amberbox.server.data.snapshot import RecordSnapshot
from amberbox.server.ingest.link_state import newest_report_ns
from amberbox.server.workers.protocol import LimitError

if TYPE_CHECKING:
    import pyarrow as pa


WORKER = "amberbox.server.data.worker"
"""Where the operations are that ``Asking`` calls."""


Form = Literal["json", "csv", "arrow", "plot"]
By = Literal["received", "timestamp"]

ROWS = 100_000
"""Default maximum number of rows of an answer."""
MOST_ROWS = 5_000_000
MOST_POINTS = 100_000
MOST_BINS = 500


class RowQuery(msgspec.Struct, frozen=True):
    """Rows of an item: of ``[from_ns, to_ns)``, at most ``limit``, or thinned to ``points``.

    ``bins`` is the number of histogram bins in statistics, None for no histogram.
    """

    robot: str
    item: str
    variables: list[str] | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    by: By = "received"
    limit: int = ROWS
    points: int | None = None
    form: Form = "json"
    bins: int | None = None


class AnswerInfo(msgspec.Struct, frozen=True):
    """The metadata of an answer.

    ``next_ns`` is where the next page begins, None at the end. ``kind`` is ``rows``, or
    ``envelope`` where rows were aggregated: least, greatest and mean value of each step.
    ``complete_ns`` is the time up to which all data on the server were considered; ``of`` is how
    many rows a thinned answer or an envelope was made of.
    """

    rows: int
    kind: Literal["rows", "envelope"] = "rows"
    next_ns: int | None = None
    complete_ns: int | None = None
    notes: list[str] = []
    of: int | None = None


def arguments(asked: RowQuery) -> dict[str, Any]:
    """Return a query as arguments for a worker."""
    found: dict[str, Any] = msgspec.to_builtins(asked)
    return found


THINNED_ROWS = 1_000_000
"""Of more rows than this a thinned answer is made from the pyramid."""
_LEAST_POINTS = 5
"""Of each variable least, greatest, first, last and a missing value; fewer would drop extremes."""
_BEHIND_NS = 5 * NS
"""So much less on the server than on the robot is worth a word."""
_KEYS = frozenset({"timestamp", "received", "seq", "parent_seq"})


@dataclass(frozen=True, slots=True, eq=False)
class RowAnswer:
    """A table, the times of its rows by which they are ordered, and the metadata."""

    table: Table
    times_ns: IntArray
    about: AnswerInfo


def rows(look: RecordSnapshot, asked: RowQuery) -> RowAnswer:
    """Return the rows of a query; raises UsageError for unknown names, LimitError for too many
    rows.
    """
    span = asked.from_ns, asked.to_ns
    if None not in span and (asked.from_ns or 0) >= (asked.to_ns or 0):
        raise UsageError("the range ends before it begins", "exchange from and to")
    schema = look.schema(asked.item)
    wanted = wanted_columns(look, schema, asked.variables)
    if asked.points is None:
        answer = _read(look, schema, wanted, asked, asked.limit)
    elif estimate(look, schema, span) > THINNED_ROWS and asked.by == "received":
        answer = _summed(look, schema, wanted, asked, asked.points)
    else:
        answer = _thinned(_read(look, schema, wanted, asked, MOST_ROWS), asked.points)
    about = answer.about
    notes = [] if about.next_ns is not None else not_copied(look, asked)
    return replace(answer, about=msgspec.structs.replace(about, notes=[*about.notes, *notes]))


def not_copied(look: RecordSnapshot, asked: RowQuery) -> list[str]:
    """Return notes that the newest data of a range are still on the robot, and how to get them."""
    complete_ns = look.complete_ns()
    with look.catalogue.database.reading() as connection:
        newest_ns = newest_report_ns(connection, asked.robot)
    if complete_ns is None or newest_ns is None or newest_ns - complete_ns < _BEHIND_NS:
        return []
    if asked.to_ns is not None and asked.to_ns <= complete_ns:
        return []
    to_ns = newest_ns if asked.to_ns is None else min(newest_ns, asked.to_ns)
    complete, newest, to = (format_to_second(t) for t in (complete_ns, newest_ns, to_ns))
    return [f"complete until {complete}; the robot has data until {newest}: "
            f"amberbox fetch URL {asked.item} {complete} {to} --wait"]  # fmt: skip


def _read(
    look: RecordSnapshot,
    schema: TableSchema,
    wanted: Sequence[SelectedColumn],
    asked: RowQuery,
    limit: int,
) -> RowAnswer:
    span, to_come = _narrowed(look, schema, asked, limit)
    needed = needed_columns(wanted)
    found = look.rows(RowRequest(schema.item, needed, span, asked.by))
    notes = [*found.notes, *(f"{gap.item or gap.writer}: {gap.reason}" for gap in found.gaps)]
    merged = merge(found.pieces, schema, needed, asked.by)
    times = merged.received_ns if asked.by == "received" else merged.timestamp_ns
    count, next_ns = _cut(times, limit)
    if count < len(times):
        part = slice(count)
        columns = {name: col.take(column, part) for name, column in merged.columns.items()}
        merged = MergedRows(
            merged.seq[part], merged.received_ns[part], merged.timestamp_ns[part], columns
        )
        times = times[part]
    table = make_table(schema, wanted, merged, notes)
    about = AnswerInfo(
        len(table), "rows", to_come if next_ns is None else next_ns, look.complete_ns(),
        list(table.notes),
    )  # fmt: skip
    return RowAnswer(table, times, about)


def _cut(times_ns: IntArray, limit: int) -> tuple[int, int | None]:
    """Return how many rows to give, and the time of the next; equal times stay together."""
    if len(times_ns) <= limit:
        return len(times_ns), None
    next_ns = int(times_ns[limit])
    count = int(np.searchsorted(times_ns, next_ns, "left"))
    if not count:  # all of them at one instant
        count = int(np.searchsorted(times_ns, next_ns, "right"))
        return count, int(times_ns[count]) if count < len(times_ns) else None
    return count, next_ns


def _narrowed(
    look: RecordSnapshot, schema: TableSchema, asked: RowQuery, limit: int
) -> tuple[Span, int | None]:
    """Return the range without files that follow enough rows, and where those begin.

    Raises LimitError for more rows than may be held in memory.
    """
    span = asked.from_ns, asked.to_ns
    files = files_of(look, schema, RowRequest(schema.item, (), span, asked.by))
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
    look: RecordSnapshot, schema: TableSchema, request: RowRequest | None
) -> list[tuple[int, int, int]]:
    """Return least and greatest receive time, and rows, of the files for a request."""
    reader = look.reader
    return [
        (int(file.low["received"]), int(file.high["received"]), file.rows)
        for source in reader.sources
        for version in reader.schemas.get(schema.item, ())
        for file in reader.files(source, version, request)
    ]


def estimate(look: RecordSnapshot, schema: TableSchema, span: Span) -> float:
    """Return an estimate of the number of rows of a table in a range."""
    total = 0.0
    for low, high, number in files_of(look, schema, RowRequest(schema.item, (), span)):
        start = low if span[0] is None else max(low, span[0])
        stop = high if span[1] is None else min(high, span[1])
        total += number * min(max(stop - start, 0) / max(high - low, 1), 1.0)
    return total


def _thinned(answer: RowAnswer, points: int) -> RowAnswer:
    table = answer.table
    if answer.about.next_ns is not None:
        raise LimitError(f"this is more than {MOST_ROWS} rows", "name a shorter range")
    variables = [table.columns[name] for name in table.names if name not in _KEYS]
    chosen = downsample(variables, len(table), max(points, _LEAST_POINTS * len(variables)))
    about = msgspec.structs.replace(answer.about, rows=len(chosen), of=len(table))
    return RowAnswer(table.take(chosen), answer.times_ns[chosen], about)


def _summed(
    look: RecordSnapshot,
    schema: TableSchema,
    wanted: Sequence[SelectedColumn],
    asked: RowQuery,
    points: int,
) -> RowAnswer:
    """Return an envelope, from the rollup levels, of rows too many to be read."""
    named = [w.column for w in wanted if w.element is None and schema.column(w.name) is not None]
    numbers = [column.name for column in named if is_plotted(column)]
    if not numbers or not has_levels(schema):
        raise LimitError(
            f"this is more than {THINNED_ROWS} rows, and only numbers can be summed up",
            "name a shorter range",
        )
    span = asked.from_ns, asked.to_ns
    table = envelope(look.reader, schema.item, numbers, span, points)
    times = table.columns["timestamp"]
    assert isinstance(times, np.ndarray)
    notes = list(table.notes)
    left = [w.name for w in wanted[1:] if w.name not in numbers]
    notes += [f"left out, only numbers can be summed up: {', '.join(left)}"] if left else []
    of = max((int(np.asarray(table.columns[f"{name}:count"]).sum()) for name in numbers), default=0)
    about = AnswerInfo(len(table), "envelope", None, look.committed_ns(), notes, of)
    return RowAnswer(table, times, about)


MAGIC = b"ABP1"
"""How a plot's numbers begin; a length of the header (uint32) follows."""

_STEP = 50_000


def encoded(answer: RowAnswer, form: Form) -> Iterator[bytes]:
    """Yield an answer encoded in a form."""
    if form == "csv":
        return _csv(answer.table)
    if form == "arrow":
        return _arrow(answer.table)
    return _plot(answer) if form == "plot" else _json(answer)


def column_json(column: Column) -> dict[str, Any]:
    """Return the JSON description of a column."""
    labels = {str(number): text for number, text in column.labels.items()}
    return {
        "name": column.name, "path": column.path, "type": column.type, "unit": column.unit,
        "labels": labels,
    }  # fmt: skip


def about_json(about: AnswerInfo) -> dict[str, Any]:
    """Return the metadata of an answer for JSON."""
    shown = [None if ns is None else format_time(ns) for ns in (about.next_ns, about.complete_ns)]
    return {
        "rows": about.rows, "of": about.of, "kind": about.kind, "next": shown[0],
        "complete_to": shown[1], "notes": about.notes,
    }  # fmt: skip


def _slices(table: Table) -> Iterator[slice]:
    for start in range(0, len(table), _STEP):
        yield slice(start, start + _STEP)


def _csv(table: Table) -> Iterator[bytes]:
    text = io.StringIO()
    table.take(slice(0)).to_csv(text)
    yield text.getvalue().encode()
    for part in _slices(table):
        text = io.StringIO()
        table.take(part).to_csv(text, header=False)
        yield text.getvalue().encode()


def _json(answer: RowAnswer) -> Iterator[bytes]:
    table = answer.table
    head = {
        "item": table.item,
        "columns": [column_json(column) for column in table.fields],
        **about_json(answer.about),
    }
    yield msgspec.json.encode(head)[:-1] + b',"data":['
    first = True
    for part in _slices(table):
        some = table.take(part)
        columns = [table_text.json_values(some.columns[f.name], f.type) for f in some.fields]
        rows = msgspec.json.encode(list(zip(*columns, strict=True)))[1:-1]
        yield rows if first else b"," + rows
        first = False
    yield b"]}"


def arrow_table(table: Table) -> pa.Table:
    """Return a pyarrow Table; unit, path and labels are in the metadata of the fields."""
    import pyarrow as pa

    found = table.to_arrow()
    fields = []
    for field, column in zip(found.schema, table.fields, strict=True):
        known = {"path": column.path, "type": column.type, "unit": column.unit}
        if column.labels:
            known["labels"] = msgspec.json.encode(column_json(column)["labels"]).decode()
        fields.append(field.with_metadata({key: value for key, value in known.items() if value}))
    return found.cast(pa.schema(fields, metadata={"item": table.item}))


def _arrow(table: Table) -> Iterator[bytes]:
    """Yield an Arrow IPC stream."""
    import pyarrow as pa

    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, arrow_table(table.take(slice(0))).schema) as writer:
        for part in _slices(table):
            writer.write_table(arrow_table(table.take(part)))
            yield _taken(sink)
    yield _taken(sink)


def _taken(sink: io.BytesIO) -> bytes:
    found = sink.getvalue()
    sink.seek(0)
    sink.truncate()
    return found


def _plot(answer: RowAnswer) -> Iterator[bytes]:
    """Yield numbers as float64 (little-endian), column by column, first the seconds since t0.

    Before them: ``ABP1``, the header's length as uint32, and the header as JSON, padded with spaces
    so that the numbers begin at a multiple of 8.
    """
    table, times = answer.table, answer.times_ns
    lines = [(f, _numbers(table.columns[f.name], f)) for f in table.fields if f.type != "time"]
    kept = [(field, line) for field, line in lines if line is not None]
    t0_ns = int(times[0]) if len(times) else 0
    notes = [*answer.about.notes]
    left = [field.name for field, line in lines if line is None]
    notes += [f"left out, these are no numbers: {', '.join(left)}"] if left else []
    if lines and not kept:
        raise UsageError(f"{left[0]} is no number", "a plot has numbers only; ask for json or csv")
    head = {
        "item": table.item, "t0": format_time(t0_ns), **about_json(answer.about), "notes": notes,
        "columns": [column_json(field) for field, _ in kept],
    }  # fmt: skip
    text = msgspec.json.encode(head)
    text += b" " * (-len(text) % 8)
    yield MAGIC + len(text).to_bytes(4, "little") + text
    for line in [(times - t0_ns) / 1e9, *(line for _, line in kept)]:
        yield np.asarray(line, "<f8").tobytes()


def _numbers(column: ColumnData, field: Column) -> NDArray[Any] | None:
    """Return a column as float64, NaN where there is no value; None for non-numeric ones."""
    if isinstance(column, Ragged) or col.element_type(field.type) is not None:
        return None
    plain = np.ma.getdata(column)
    if plain.dtype.kind not in "biuf":
        return None
    values = plain.astype(np.float64)
    values[col.null_mask(column)] = np.nan
    return values
