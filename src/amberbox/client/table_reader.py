"""Reading of rows from a server into a table: from Arrow if pyarrow is installed, else JSON."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.query.table import Table
from amberbox.client.models import time_ns
from amberbox.client.transport import ApiReply
from amberbox.core.types import Column, ColumnData, Ragged

_WORDS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


@dataclass(frozen=True, slots=True)
class RowPage:
    """Rows of one answer; ``next`` is the ``from`` of the next request, empty at the end."""

    table: Table
    next: str
    kind: str
    complete_to: str


class _Column(msgspec.Struct):
    name: str
    path: str = ""
    type: str = ""
    unit: str = ""
    labels: dict[str, str] = {}


class _Rows(msgspec.Struct):
    item: str
    columns: list[_Column]
    data: list[list[Any]]
    notes: list[str] = []


def row_format() -> str:
    """Return the format in which rows are requested: ``arrow`` or ``json``."""
    return "arrow" if find_spec("pyarrow") is not None else "json"


def page_of(reply: ApiReply) -> RowPage:
    """Return the page of rows in an answer."""
    table = _of_json(reply.body) if "json" in reply.headers["content-type"] else _of_arrow(reply)
    position = (
        reply.headers.get(f"x-amberbox-{name}", "") for name in ("next", "kind", "complete-to")
    )
    notes = msgspec.json.decode(reply.headers.get("x-amberbox-notes", "[]"), type=list[str])
    all_notes = tuple(dict.fromkeys((*table.notes, *notes)))
    return RowPage(replace(table, notes=all_notes), *position)


def concatenate(pages: Sequence[Table]) -> Table:
    """Return one table with the rows of all pages."""
    first = pages[0]
    if len(pages) == 1:
        return first
    columns = {
        name: col.concatenate([page.columns[name] for page in pages]) for name in first.names
    }
    notes = dict.fromkeys(note for page in pages for note in page.notes)
    return Table(first.item, first.fields, columns, tuple(notes))


def as_rows(envelope: Table, fields: Mapping[str, Column]) -> Table:
    """Return rows of a summary by steps of time: the minimum, then the maximum of each step."""
    names = list(dict.fromkeys(n.rpartition(":")[0] for n in envelope.names if ":" in n))
    times = np.repeat(np.asarray(envelope["timestamp"]), 2)
    columns: dict[str, ColumnData] = {"timestamp": times, "received": times}
    for name in names:
        pair = [_numbers(envelope[f"{name}:{end}"]) for end in ("min", "max")]
        columns[name] = np.stack(pair, axis=1).reshape(-1)
    keys = (Column("timestamp", "timestamp", "time"), Column("received", "received", "time"))
    shown = (fields.get(name) or Column(name, name, "float64") for name in names)
    found = (*keys, *(Column(c.name, c.path, "float64", c.unit) for c in shown))
    note = "more than a million rows: of each step the least and the greatest value are shown"
    return Table(envelope.item, found, columns, (*envelope.notes, note))


def _numbers(column: ColumnData) -> NDArray[np.float64]:
    """Return numbers as float64, NaN for missing ones."""
    assert not isinstance(column, Ragged), "only numbers are summed up"
    return np.ma.filled(np.ma.asarray(column, np.float64), np.nan)


def _of_arrow(reply: ApiReply) -> Table:
    import pyarrow as pa

    from amberbox.blackbox.columns.arrow import from_arrow

    found = pa.ipc.open_stream(pa.py_buffer(reply.body)).read_all()
    fields = [_field(field.name, field.metadata or {}) for field in found.schema]
    columns = {f.name: from_arrow(found.column(f.name), f.type) for f in fields}
    item = (found.schema.metadata or {}).get(b"item", b"").decode()
    return Table(item, tuple(fields), columns)


def _field(name: str, metadata: Mapping[bytes, bytes]) -> Column:
    values = {key.decode(): value.decode() for key, value in metadata.items()}
    labels = msgspec.json.decode(values.get("labels", "{}"), type=dict[str, str])
    return column_of(
        _Column(name, values.get("path", ""), values["type"], values.get("unit", ""), labels)
    )


def column_of(column: Any) -> Column:
    """Return the description of a column by the server as a ``Column``."""
    labels = {int(number): text for number, text in column.labels.items()}
    return Column(column.name, column.path, column.type, column.unit, labels)


def _of_json(body: bytes) -> Table:
    found = msgspec.json.decode(body, type=_Rows)
    fields = [column_of(column) for column in found.columns]
    values = list(zip(*found.data, strict=True)) or [()] * len(fields)
    columns = {f.name: _values(f.type, list(v)) for f, v in zip(fields, values, strict=True)}
    return Table(found.item, tuple(fields), columns, tuple(found.notes))


def _values(kind: str, values: list[Any]) -> ColumnData:
    """Return plain values as a column of a type."""
    inner = col.element_type(kind)
    if inner is not None:
        if any(value is None for value in values):
            return col.objects(
                None if value is None else np.asarray(_values(inner, value)) for value in values
            )
        flat = _values(inner, [one for value in values for one in value])
        assert not isinstance(flat, Ragged), "lists of lists are child tables"
        return Ragged(np.cumsum([0, *map(len, values)]).astype(np.int64), flat)
    if kind not in col.NUMPY_TYPES:
        return col.objects(_plain(kind, value) for value in values)
    missing = np.array([value is None for value in values], bool)
    zero = False if kind == "bool" else 0
    plain = [zero if value is None else _plain(kind, value) for value in values]
    numbers = np.array(plain, col.numpy_type(kind))
    return np.ma.masked_array(numbers, mask=missing) if missing.any() else numbers


def _plain(kind: str, value: Any) -> Any:
    if value is None:
        return None
    if kind == "time":
        return time_ns(value)
    if kind == "binary":
        return base64.b64decode(value)
    return _WORDS.get(value, value) if "float" in kind and isinstance(value, str) else value
