"""Rows as bytes: JSON, CSV, an Arrow stream, and plain numbers for plots."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.query import tabletext
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments import columns as col
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.core.types import Column, ColumnData, Ragged
from amberbox.fleet.data.asked import About, Form
from amberbox.fleet.data.rows import Answer

if TYPE_CHECKING:
    import pyarrow as pa

MAGIC = b"ABP1"
"""How a plot's numbers begin; a length of the header (uint32) follows."""

_STEP = 50_000


def encoded(answer: Answer, form: Form) -> Iterator[bytes]:
    """Write an answer in a form."""
    if form == "csv":
        return _csv(answer.table)
    if form == "arrow":
        return _arrow(answer.table)
    return _plot(answer) if form == "plot" else _json(answer)


def column_json(column: Column) -> dict[str, Any]:
    """Describe a column."""
    labels = {str(number): text for number, text in column.labels.items()}
    return {
        "name": column.name, "path": column.path, "type": column.type, "unit": column.unit,
        "labels": labels,
    }  # fmt: skip


def about_json(about: About) -> dict[str, Any]:
    """Say of an answer what it says beside its rows."""
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


def _json(answer: Answer) -> Iterator[bytes]:
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
        columns = [tabletext.speakable(some.columns[f.name], f.type) for f in some.fields]
        rows = msgspec.json.encode(list(zip(*columns, strict=True)))[1:-1]
        yield rows if first else b"," + rows
        first = False
    yield b"]}"


def arrow_table(table: Table) -> pa.Table:
    """Return a pyarrow Table; unit, path and labels stand in the metadata of the fields."""
    import pyarrow as pa

    found = table.to_arrow()
    fields = [
        field.with_metadata(_metadata(column))
        for field, column in zip(found.schema, table.fields, strict=True)
    ]
    return found.cast(pa.schema(fields, metadata={"item": table.item}))


def _arrow(table: Table) -> Iterator[bytes]:
    """Write an Arrow IPC stream."""
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


def _metadata(column: Column) -> dict[str, str]:
    known = {"path": column.path, "type": column.type, "unit": column.unit}
    if column.labels:
        known["labels"] = msgspec.json.encode(column_json(column)["labels"]).decode()
    return {key: value for key, value in known.items() if value}


def _plot(answer: Answer) -> Iterator[bytes]:
    """Write numbers as float64 (little-endian), column by column: seconds after t0 come first.

    Before them: ``ABP1``, the header's length as uint32, and the header as JSON, padded with
    spaces so that the numbers begin at a multiple of 8.
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
    """Return a column as float64, NaN where there is no value; None for what is no number."""
    if isinstance(column, Ragged) or col.element_type(field.type) is not None:
        return None
    plain = np.ma.getdata(column)
    if plain.dtype.kind not in "biuf":
        return None
    values = plain.astype(np.float64)
    values[col.null_mask(column)] = np.nan
    return values
