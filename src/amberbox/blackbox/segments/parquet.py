"""One Parquet file of one table: written with an encoding per column, read by time range."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.segments import encoding
from amberbox.blackbox.segments.columns_io import from_arrow, to_arrow
from amberbox.blackbox.segments.flat import Flat, TableSchema
from amberbox.blackbox.segments.manifest import (
    Part,
    Segment,
    part_clock,
    part_from_json,
)
from amberbox.core.files import below, sync_folder
from amberbox.core.types import IntArray

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

METADATA = b"amberbox"
_LEVEL = 3
_KEYS = ("log_time", "timestamp")


def seq_name(schema: TableSchema) -> str:
    """Name the column that holds ``seq``: in a child table it is the parent's."""
    return "parent_seq" if schema.parent else "seq"


def key_names(schema: TableSchema) -> tuple[str, ...]:
    """Name the columns that stand before an item's own."""
    return (seq_name(schema), *_KEYS)


def stored_name(name: str) -> str:
    """Name a variable's column in the file: one that is called like ours steps aside."""
    return f"{name}:" if name.casefold() == "log_time" else name


class TableFile:
    """Writes one table's Parquet file beside its final name, then moves it there."""

    def __init__(self, store: Path, path: str, schema: TableSchema) -> None:
        self.path = path
        self.schema = schema
        self._store = store
        self._final = below(store, path)
        self._temporary = self._final.with_name(f".{self._final.name}.tmp")
        self._writer: pq.ParquetWriter | None = None
        self.rows = 0

    def write(self, flat: Flat) -> None:
        """Write rows as one row group; the first one decides the encodings."""
        import pyarrow as pa

        names, types, columns = self.layout(flat)
        arrays = [to_arrow(column, kind) for column, kind in zip(columns, types, strict=True)]
        table = pa.Table.from_arrays(arrays, names=names)
        if self._writer is None:
            choices = {
                name: encoding.choose(column, kind)
                for name, column, kind in zip(names, columns, types, strict=True)
            }
            self._writer = self._open(table.schema, choices)
        self._writer.write_table(table, row_group_size=len(flat))
        self.rows += len(flat)

    def layout(self, flat: Flat) -> tuple[list[str], list[str], list[Any]]:
        """Return names, types and contents of the columns of the file, the keys first."""
        names = [*key_names(self.schema), *(stored_name(c.name) for c in self.schema.columns)]
        types = ["int64", "int64", "time", *(column.type for column in self.schema.columns)]
        own = [flat.columns[column.name] for column in self.schema.columns]
        return names, types, [flat.seq, flat.log_time_ns, flat.timestamp_ns, *own]

    def _open(self, schema: pa.Schema, choices: Mapping[str, str]) -> pq.ParquetWriter:
        import pyarrow.parquet as pq

        self._final.parent.mkdir(parents=True, exist_ok=True)
        leaves = {_leaf(schema.field(name)): choice for name, choice in choices.items()}
        return pq.ParquetWriter(
            self._temporary,
            schema,
            compression="zstd",
            compression_level=_LEVEL,
            use_dictionary=[leaf for leaf, c in leaves.items() if c == encoding.DICTIONARY],
            column_encoding={leaf: c for leaf, c in leaves.items() if c != encoding.DICTIONARY},
            write_statistics=list(key_names(self.schema)),
            write_page_checksum=True,
            store_schema=False,
        )

    def finish(self, parts: Sequence[Part]) -> Segment:
        """Close the file, make it durable under its name and describe it."""
        assert self._writer is not None
        description = {"version": 1, "schema": self.schema.to_json(), "parts": parts_json(parts)}
        text = json.dumps(description, separators=(",", ":"))
        self._writer.add_key_value_metadata({METADATA.decode(): text})
        self._writer.close()
        sha256, size = _sync_and_hash(self._temporary)
        self._temporary.rename(self._final)
        sync_folder(self._final.parent)
        return Segment(
            self.path, self.schema.item, self.schema.id, self.rows, size, sha256, tuple(parts)
        )

    def discard(self) -> None:
        """Leave nothing behind, after an error."""
        if self._writer is not None:
            self._writer.close()
        self._temporary.unlink(missing_ok=True)


def parts_json(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return parts as plain data."""
    return [asdict(part) for part in parts]


def _leaf(field: pa.Field) -> str:
    import pyarrow as pa

    return f"{field.name}.list.element" if pa.types.is_list(field.type) else str(field.name)


def _sync_and_hash(path: Path) -> tuple[str, int]:
    with path.open("r+b") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
        return digest, file.tell()


def describe(store: Path, path: str) -> tuple[TableSchema, Segment]:
    """Read back from a segment's own metadata what the manifest says about it, and hash it."""
    schema, segment = outline(store, path)
    sha256, size = _sync_and_hash(store / path)
    return schema, replace(segment, sha256=sha256, bytes=size)


def outline(store: Path, path: str) -> tuple[TableSchema, Segment]:
    """Do the same without hashing the file."""
    import pyarrow.parquet as pq

    metadata = pq.read_metadata(store / path)
    data = json.loads(metadata.metadata[METADATA])
    schema = TableSchema.from_json(data["schema"])
    parts = tuple(part_from_json(part) for part in data["parts"])
    rows, size = int(metadata.num_rows), (store / path).stat().st_size
    return schema, Segment(path, schema.item, schema.id, rows, size, "", parts)


def read_segment(
    store: Path,
    segment: Segment,
    schema: TableSchema,
    names: Collection[str],
    span: tuple[int | None, int | None] = (None, None),
    by: str = "received",
    stored: Callable[[str], str] = stored_name,
) -> list[Flat]:
    """Read the named columns of the row groups that may hold rows of ``[from, to)``.

    Row groups are chosen by their times: rows outside of the range may come along. Gives one
    ``Flat`` per part of the segment. ``stored`` says how a variable is called in the file.
    """
    path = below(store, segment.path)
    with _opened(path) as file:
        if span == (None, None):
            chosen = list(range(file.metadata.num_row_groups))
        else:
            found = _row_groups(path, schema, segment, by)
            chosen = [g.number for g in found if overlaps(g.low_ns, g.high_ns, span)]
        return _read(file, segment, schema, names, chosen, stored)


@dataclass(frozen=True, slots=True)
class RowGroup:
    """One row group of a segment and bounds of its times, both inclusive."""

    number: int
    low_ns: int
    high_ns: int


def row_groups(store: Path, segment: Segment, schema: TableSchema, by: str) -> list[RowGroup]:
    """List the row groups of a segment with the bounds of ``received`` or of the stamps."""
    return _row_groups(below(store, segment.path), schema, segment, by)


def read_row_group(
    store: Path, segment: Segment, schema: TableSchema, names: Collection[str], number: int
) -> list[Flat]:
    """Read the named columns of one row group; one ``Flat`` per part of the segment."""
    with _opened(below(store, segment.path)) as file:
        return _read(file, segment, schema, names, [number])


def _opened(path: Path) -> pq.ParquetFile:
    import pyarrow.parquet as pq

    return pq.ParquetFile(path, memory_map=True, page_checksum_verification=True)


def _read(
    file: pq.ParquetFile,
    segment: Segment,
    schema: TableSchema,
    names: Collection[str],
    groups: Sequence[int],
    stored: Callable[[str], str] = stored_name,
) -> list[Flat]:
    wanted = [column for column in schema.columns if column.name in names]
    columns = [*key_names(schema), *(stored(column.name) for column in wanted)]
    table = file.read_row_groups(groups, columns=columns, use_threads=len(columns) > 8)
    first_rows = _first_rows(file.metadata)
    starts = np.concatenate(
        [np.arange(first_rows[g], first_rows[g + 1]) for g in groups] or [np.empty(0, np.int64)]
    )
    named = {column.name: stored(column.name) for column in wanted}
    whole = _to_flat(table, segment, schema, named)
    return _split_parts(whole, segment.parts, starts)


def _first_rows(metadata: pq.FileMetaData) -> IntArray:
    counts = [metadata.row_group(g).num_rows for g in range(metadata.num_row_groups)]
    return np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))


def _row_groups(path: Path, schema: TableSchema, segment: Segment, by: str) -> list[RowGroup]:
    by_clock = by == "received" or not schema.stamp
    least, most = segment.offsets_ns if by_clock else (0, 0)
    column = "log_time" if by_clock else "timestamp"
    status = path.stat()
    bounds = _bounds(path, (status.st_ino, status.st_mtime_ns, status.st_size), column)
    return [RowGroup(number, low + least, high + most) for number, low, high in bounds]


@lru_cache(maxsize=1024)
def _bounds(path: Path, _: tuple[int, int, int], column: str) -> Sequence[tuple[int, int, int]]:
    """Return number, least and greatest time of each row group; remembered until the file changes.

    They are those of the column, whose pages have checksums. The statistics in the footer have
    none: a flipped bit in them would leave rows out without a word.
    """
    found = []
    with _opened(path) as file:
        for number in range(file.metadata.num_row_groups):
            times = _integers(file.read_row_group(number, columns=[column])[column])
            if len(times):
                found.append((number, int(times.min()), int(times.max())))
    return found


def overlaps(low: int, high: int, span: tuple[int | None, int | None]) -> bool:
    """Tell whether ``[low, high]`` meets ``[from, to)``; None is open."""
    from_ns, to_ns = span
    return (from_ns is None or high >= from_ns) and (to_ns is None or low < to_ns)


def _to_flat(
    table: pa.Table, segment: Segment, schema: TableSchema, names: Mapping[str, str]
) -> Flat:
    types = {column.name: column.type for column in schema.columns}
    log_time = _integers(table[_KEYS[0]])
    stamps = _integers(table.column("timestamp")) if schema.stamp else log_time
    part = segment.parts[0]
    columns = {name: from_arrow(table[place], types[name]) for name, place in names.items()}
    seq = _integers(table[seq_name(schema)])
    return Flat(schema, part.writer, part.run, seq, log_time, log_time, stamps, columns)


def _integers(array: pa.ChunkedArray) -> IntArray:
    column = from_arrow(array, "time")
    assert isinstance(column, np.ndarray)
    return column


def _split_parts(whole: Flat, parts: Sequence[Part], rows: IntArray) -> list[Flat]:
    """Give the rows of each part, with the times of its own clock."""
    if len(parts) == 1:
        return [_received(whole, parts[0])] if len(whole) else []
    ends = np.cumsum([part.rows for part in parts])
    cuts = np.searchsorted(rows, np.concatenate(([0], ends)))
    flats = []
    for part, start, stop in zip(parts, cuts[:-1], cuts[1:], strict=True):
        if stop > start:
            piece = whole.take(slice(int(start), int(stop)))
            flats.append(_received(replace(piece, writer=part.writer, run=part.run), part))
    return flats


def _received(piece: Flat, part: Part) -> Flat:
    """Correct the time of receipt, which is the stamp of rows that have none of their own."""
    received = ClockTable(part_clock(part)).received(piece.log_time_ns)
    stamps = piece.timestamp_ns if piece.schema.stamp else received
    return replace(piece, received_ns=received, timestamp_ns=stamps)
