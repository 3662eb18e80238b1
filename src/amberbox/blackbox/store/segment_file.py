"""A segment file: one table as Parquet, an encoding per column, read by time range."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.arrow import from_arrow, to_arrow
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.manifest_entries import (
    Segment,
    SegmentPart,
    part_clock,
    part_from_json,
)
from amberbox.core.files import below, sync_folder
from amberbox.core.types import ColumnData, IntArray, Ragged

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


def can_build() -> bool:
    """Return whether segments can be written and read (pyarrow is installed)."""
    return importlib.util.find_spec("pyarrow") is not None


DICTIONARY = "dictionary"
_SAMPLE_ROWS = 4096
_SAMPLE_BLOCKS = 4
_INT_DICTIONARY_SHARE = 1 / 64
_FLOAT_DICTIONARY_SHARE = 1 / 3


def choose_encoding(column: ColumnData, column_type: str) -> str:
    """Return ``dictionary`` or the name of a Parquet encoding.

    Dictionary: strings, constants, few-valued ints, floats that are quantised (a decimal sensor
    reading repeats its values). BYTE_STREAM_SPLIT: other floats. DELTA_BINARY_PACKED: other ints.
    """
    values = column.values if isinstance(column, Ragged) else column
    kind = col.element_type(column_type) or column_type
    if values.dtype == object or kind in ("string", "binary"):
        # Large binaries (images, maps) hardly repeat: a dictionary of them is wasted work.
        head = values[: _SAMPLE_ROWS // 16]
        large = any(isinstance(value, bytes) and len(value) > 256 for value in head)
        return "PLAIN" if large else DICTIONARY
    if kind == "bool":
        return "PLAIN"
    share = _distinct_share(np.ma.getdata(values))
    if kind in ("float32", "float64"):
        return DICTIONARY if share <= _FLOAT_DICTIONARY_SHARE else "BYTE_STREAM_SPLIT"
    return DICTIONARY if share <= _INT_DICTIONARY_SHARE else "DELTA_BINARY_PACKED"


def _distinct_share(values: NDArray[Any]) -> float:
    """Return an estimate of the share of distinct values, from blocks spread over the column."""
    count = len(values)
    if count == 0:
        return 0.0
    sample = _sample(values)
    bits = sample.view(f"u{sample.dtype.itemsize}")
    return len(np.unique(bits)) / len(bits)


def _sample(values: NDArray[Any]) -> NDArray[Any]:
    if len(values) <= _SAMPLE_ROWS:
        return np.ascontiguousarray(values)
    block = _SAMPLE_ROWS // _SAMPLE_BLOCKS
    starts = np.linspace(0, len(values) - block, _SAMPLE_BLOCKS).astype(int)
    return np.concatenate([values[start : start + block] for start in starts])


METADATA = b"amberbox"
_LEVEL = 3
_KEYS = ("log_time", "timestamp")


def seq_name(schema: TableSchema) -> str:
    """Return the name of the column of ``seq``: in a child table it is the parent's."""
    return "parent_seq" if schema.parent else "seq"


def key_names(schema: TableSchema) -> tuple[str, ...]:
    """Return the names of the columns before an item's own."""
    return (seq_name(schema), *_KEYS)


def stored_name(name: str) -> str:
    """Return a variable's column name in the file: one equal to ours is changed."""
    return f"{name}:" if name.casefold() == "log_time" else name


class SegmentWriter:
    """Writes one table's Parquet file beside its final name, then moves it there."""

    def __init__(self, store: Path, path: str, schema: TableSchema) -> None:
        self.path = path
        self.schema = schema
        self._store = store
        self._final = below(store, path)
        self._temporary = self._final.with_name(f".{self._final.name}.tmp")
        self._writer: pq.ParquetWriter | None = None
        self.rows = 0

    def write(self, flat: FlatTable) -> None:
        """Write rows as one row group; the first one decides the encodings."""
        import pyarrow as pa

        names, types, columns = self.layout(flat)
        arrays = [to_arrow(column, kind) for column, kind in zip(columns, types, strict=True)]
        table = pa.Table.from_arrays(arrays, names=names)
        if self._writer is None:
            choices = {
                name: choose_encoding(column, kind)
                for name, column, kind in zip(names, columns, types, strict=True)
            }
            self._writer = self._open(table.schema, choices)
        self._writer.write_table(table, row_group_size=len(flat))
        self.rows += len(flat)

    def layout(self, flat: FlatTable) -> tuple[list[str], list[str], list[Any]]:
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
            use_dictionary=[leaf for leaf, c in leaves.items() if c == DICTIONARY],
            column_encoding={leaf: c for leaf, c in leaves.items() if c != DICTIONARY},
            write_statistics=list(key_names(self.schema)),
            write_page_checksum=True,
            store_schema=False,
        )

    def finish(self, parts: Sequence[SegmentPart]) -> Segment:
        """Close the file, make it durable under its name and describe it."""
        assert self._writer is not None
        description = {
            "version": 1, "schema": self.schema.to_json(), "parts": [*map(asdict, parts)]
        }  # fmt: skip
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
        """Remove the unfinished file, after an error."""
        if self._writer is not None:
            self._writer.close()
        self._temporary.unlink(missing_ok=True)


def _leaf(field: pa.Field) -> str:
    import pyarrow as pa

    return f"{field.name}.list.element" if pa.types.is_list(field.type) else str(field.name)


def _sync_and_hash(path: Path) -> tuple[str, int]:
    with path.open("r+b") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
        return digest, file.tell()


def describe(store: Path, path: str) -> tuple[TableSchema, Segment]:
    """Read back a segment's manifest entry from its own metadata, and hash it."""
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
) -> list[FlatTable]:
    """Read the named columns of the row groups that may hold rows of ``[from, to)``.

    Row groups are chosen by their times: rows outside of the range may be included. Returns one
    ``FlatTable`` per part of the segment. ``stored`` maps a variable to its name in the file.
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
    """Return the row groups of a segment with the bounds of ``received`` or of the stamps."""
    return _row_groups(below(store, segment.path), schema, segment, by)


def read_row_group(
    store: Path, segment: Segment, schema: TableSchema, names: Collection[str], number: int
) -> list[FlatTable]:
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
) -> list[FlatTable]:
    wanted = [column for column in schema.columns if column.name in names]
    columns = [*key_names(schema), *(stored(column.name) for column in wanted)]
    table = file.read_row_groups(groups, columns=columns, use_threads=len(columns) > 8)
    counts = [file.metadata.row_group(g).num_rows for g in range(file.metadata.num_row_groups)]
    first_rows = np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))
    starts = np.concatenate(
        [np.arange(first_rows[g], first_rows[g + 1]) for g in groups] or [np.empty(0, np.int64)]
    )
    named = {column.name: stored(column.name) for column in wanted}
    whole = _to_flat(table, segment, schema, named)
    return _split_parts(whole, segment.parts, starts)


def _row_groups(path: Path, schema: TableSchema, segment: Segment, by: str) -> list[RowGroup]:
    by_clock = by == "received" or not schema.stamp
    least, most = segment.offsets_ns if by_clock else (0, 0)
    column = "log_time" if by_clock else "timestamp"
    status = path.stat()
    bounds = _bounds(path, (status.st_ino, status.st_mtime_ns, status.st_size), column)
    return [RowGroup(number, low + least, high + most) for number, low, high in bounds]


@lru_cache(maxsize=1024)
def _bounds(path: Path, _: tuple[int, int, int], column: str) -> Sequence[tuple[int, int, int]]:
    """Return number, least and greatest time of each row group; cached until the file changes.

    They are those of the column, whose pages have checksums. The statistics in the footer have
    none: a flipped bit in them would leave rows out without an error.
    """
    found = []
    with _opened(path) as file:
        for number in range(file.metadata.num_row_groups):
            times = _integers(file.read_row_group(number, columns=[column])[column])
            if len(times):
                found.append((number, int(times.min()), int(times.max())))
    return found


def overlaps(low: int, high: int, span: tuple[int | None, int | None]) -> bool:
    """Return whether ``[low, high]`` meets ``[from, to)``; None is open."""
    from_ns, to_ns = span
    return (from_ns is None or high >= from_ns) and (to_ns is None or low < to_ns)


def _to_flat(
    table: pa.Table, segment: Segment, schema: TableSchema, names: Mapping[str, str]
) -> FlatTable:
    types = {column.name: column.type for column in schema.columns}
    log_time = _integers(table[_KEYS[0]])
    stamps = _integers(table.column("timestamp")) if schema.stamp else log_time
    part = segment.parts[0]
    columns = {name: from_arrow(table[place], types[name]) for name, place in names.items()}
    seq = _integers(table[seq_name(schema)])
    return FlatTable(schema, part.writer, part.run, seq, log_time, log_time, stamps, columns)


def _integers(array: pa.ChunkedArray) -> IntArray:
    column = from_arrow(array, "time")
    assert isinstance(column, np.ndarray)
    return column


def _split_parts(whole: FlatTable, parts: Sequence[SegmentPart], rows: IntArray) -> list[FlatTable]:
    """Return the rows of each part, with the times of its own clock."""
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


def _received(piece: FlatTable, part: SegmentPart) -> FlatTable:
    """Return the corrected times of receipt, which are the stamps of rows without their own."""
    received = ClockTable(part_clock(part)).received(piece.log_time_ns)
    stamps = piece.timestamp_ns if piece.schema.stamp else received
    return replace(piece, received_ns=received, timestamp_ns=stamps)
