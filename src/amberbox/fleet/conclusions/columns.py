"""Records put together again from the archive's columns: the inverse of unrolling them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import msgspec
import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.catalogue import Catalogue
from amberbox.blackbox.query.gather import Request, gather
from amberbox.blackbox.query.tabletext import plain
from amberbox.blackbox.segments.flat import Flat
from amberbox.core.names import child_name, identifier
from amberbox.fleet.archive.catalogue import Source
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.conclusions.entry import Entry

Span: TypeAlias = tuple[int | None, int | None]
Values: TypeAlias = dict[str, Any]
Key: TypeAlias = tuple[str, int, int]
"""Writer, run and number of a message within a store."""
Shape: TypeAlias = Mapping[str, Mapping[str, Any]]


def from_columns(
    reader: Reader, source: Source, channel: str, span: Span, limit: int, *, newest: bool
) -> list[Entry]:
    """Return the first (or newest) records of a channel in ``[from, to)``, in order of time.

    May return more than ``limit``, where several were received at the same instant.
    """
    table = identifier(channel)
    if table not in reader.schemas:
        return []
    catalogue = reader.of(source, table, request=Request(table, (), span))
    span = _by_files(catalogue, table, span, limit, newest=newest)
    span = _by_rows(catalogue, table, span, limit, newest=newest)
    parts = _Parts(reader, source, span)
    shape = _shape(channel)
    found = [
        (flat, row, key, values)
        for flat in parts.flats(table)
        for row, key, values in _rows(flat, shape)
    ]
    parts.fill(table, shape, {key: values for _, _, key, values in found})
    entries = [
        Entry(channel, int(flat.received_ns[row]), int(flat.log_time_ns[row]), source.store_id,
              *key, values)
        for flat, row, key, values in found
    ]  # fmt: skip
    return sorted(entries, key=lambda entry: entry.order)


def _by_files(catalogue: Catalogue, table: str, span: Span, limit: int, *, newest: bool) -> Span:
    """Narrow a range to files that hold enough rows for certain."""
    from_ns, to_ns = span
    inside = [
        (low, high, segment.rows)
        for segment in catalogue.segments(table)
        for low, high in [segment.received_range_ns]
        if (from_ns is None or low >= from_ns) and (to_ns is None or high < to_ns)
    ]
    count = 0
    for low, high, rows in sorted(inside, key=lambda s: -s[0] if newest else s[1]):
        count += rows
        if count >= limit:
            return (low, to_ns) if newest else (from_ns, high + 1)
    return span


def _by_rows(catalogue: Catalogue, table: str, span: Span, limit: int, *, newest: bool) -> Span:
    """Narrow a range to ``limit`` rows, reading nothing but their times."""
    pieces = gather(catalogue, Request(table, (), span)).pieces
    if sum(map(len, pieces)) <= limit:
        return span
    times = np.sort(np.concatenate([piece.received_ns for piece in pieces]))
    if newest:
        return int(times[-limit]), span[1]
    return span[0], int(times[limit - 1]) + 1


class _Parts:
    """The tables of one channel: messages, and what was listed in them."""

    def __init__(self, reader: Reader, source: Source, span: Span) -> None:
        self._reader = reader
        self._source = source
        self._span = span

    def flats(self, table: str) -> list[Flat]:
        """Read all columns of a table within the range."""
        if table not in self._reader.schemas:
            return []
        names = [column.name for column in self._reader.schema(table).columns]
        request = Request(table, names, self._span)
        catalogue = self._reader.of(self._source, table, request=request)
        return gather(catalogue, request).pieces

    def fill(self, table: str, shape: Shape, messages: Mapping[Key, Values]) -> None:
        """Put what is listed in messages where it belongs, and what is listed in that."""
        self._fill(table, shape, {(*key, 0): values for key, values in messages.items()}, "")

    def _fill(
        self, table: str, shape: Shape, parents: Mapping[tuple[Any, ...], Values], key: str
    ) -> None:
        for name, inner in _lists(shape):
            below, children = child_name(table, name), {}
            for number, index, parent, values in self._listed(below, inner, key):
                if (*number, parent) in parents:
                    parents[*number, parent][name].append(values)
                    children[*number, index] = values
            self._fill(below, inner, children, "parent_index")

    def _listed(self, table: str, shape: Shape, key: str) -> Iterator[tuple[Key, int, int, Values]]:
        """Give the entries of lists in order: message, index, index of the parent."""
        found = []
        for flat in self.flats(table):
            index = plain(flat.columns["index"])
            parents = plain(flat.columns[key]) if key else [0] * len(flat)
            found += [(k, index[n], parents[n], values) for n, k, values in _rows(flat, shape)]
        yield from sorted(found, key=lambda entry: entry[:3])


def _rows(flat: Flat, shape: Shape) -> Iterator[tuple[int, Key, Values]]:
    """Give number, key and values of each row; lists of objects are empty at first."""
    by_path = {column.path: column.name for column in flat.schema.columns}
    columns = {n: plain(flat.columns[by_path[n]]) for n in shape if n in by_path}
    lists = {name for name, _ in _lists(shape)}
    for row, seq in enumerate(flat.seq.tolist()):
        values: Values = {
            name: [] if name in lists else columns[name][row]
            for name in shape
            if name in lists or name in columns
        }
        yield row, (flat.writer, flat.run, seq), values


@lru_cache(maxsize=32)
def _shape(channel: str) -> Shape:
    """Return the properties of a channel's messages, as docs/format.md has them."""
    document = msgspec.json.decode(reserved.schema_of(channel).data)
    found: Shape = document["properties"]
    return found


def _lists(shape: Shape) -> Sequence[tuple[str, Shape]]:
    """Return the properties that are lists of objects, and the properties of these."""
    return [
        (name, what["items"]["properties"])
        for name, what in shape.items()
        if what["type"] == "array" and what["items"]["type"] == "object"
    ]
