"""Export tables in order of time and in bounded memory: CSV, Parquet, rows as JSON messages."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol

import msgspec
import numpy as np

from amberbox.blackbox.columns.arrays import element_type, null_mask
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema
from amberbox.blackbox.columns.table_text import plain, rows_at_once
from amberbox.blackbox.columns.variables import SelectedColumn
from amberbox.blackbox.query.export_job import (
    ExportJob,
    LazySlice,
    RefreshingCatalogue,
    View,
    Window,
    chosen_tables,
    journal_slices,
    new_file,
    new_folder,
    ordered_windows,
    size_of,
)
from amberbox.blackbox.query.rows import make_table, needed_columns, wanted_columns
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.catalogue import StoreCatalogue, item_of
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.manifest_entries import Segment
from amberbox.blackbox.store.segment_file import overlaps, read_row_group, row_groups
from amberbox.blackbox.store.table_reader import (
    MergedRows,
    RowRequest,
    damage_raised,
    journal_rows,
    may_hold,
    merge,
    within,
)
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.files import below
from amberbox.core.names import shortened
from amberbox.core.types import Column, ColumnData, Gap, IntArray, Schema, Topic

if TYPE_CHECKING:
    import pyarrow as pa


TableSlice = LazySlice[list[FlatTable]]


@dataclass(frozen=True)
class TableBlock:
    """Rows of a table, ready to be written, and the share of the table that is then finished."""

    table: Table
    received_ns: IntArray
    timestamp_ns: IntArray
    done: float


@dataclass(frozen=True)
class TableStream:
    """One table of a view; ``blocks`` reads it."""

    schema: TableSchema
    wanted: Sequence[SelectedColumn]
    windows: Sequence[Window]
    by: str

    @property
    def empty(self) -> Table:
        """Return the table without rows: its columns and their types."""
        nothing = merge([], self.schema, needed_columns(self.wanted), self.by)
        return make_table(self.schema, self.wanted, nothing)

    def blocks(self, current: RefreshingCatalogue) -> Iterator[TableBlock]:
        """Read the rows in order of time."""
        needed = needed_columns(self.wanted)
        for number, window in enumerate(self.windows):
            request = RowRequest(self.schema.item, needed, window, self.by)
            read = partial(_read, current, self.schema, request)
            for rows, done in current.read_window(window, read):
                table = make_table(self.schema, self.wanted, rows)
                share = (number + done) / len(self.windows)
                yield TableBlock(table, rows.received_ns, rows.timestamp_ns, share)


def table_streams(catalogue: StoreCatalogue, view: View) -> list[TableStream]:
    """Choose the tables of a view and their columns."""
    return [_table_stream(catalogue, schema, view) for schema in chosen_tables(catalogue, view)]


def _table_stream(catalogue: StoreCatalogue, schema: TableSchema, view: View) -> TableStream:
    """Choose the columns of a table; raises UsageError for an unknown variable."""
    named = view.variables.get(schema.item)
    if named is None and view.all_variables:
        named = [*(["parent_seq"] if schema.parent else []), *(c.name for c in schema.columns)]
    wanted = wanted_columns(catalogue, schema, named)
    if view.received:
        keys = ["received"] if schema.parent else ["received", "seq"]
        known = {column.name for column in wanted}
        wanted += [w for w in wanted_columns(catalogue, schema, keys) if w.name not in known]
    return TableStream(schema, wanted, ordered_windows(view.windows), view.by)


def _read(
    current: RefreshingCatalogue, schema: TableSchema, request: RowRequest, window: Window
) -> Iterator[tuple[MergedRows, int, float]]:
    """Merge the parts of a table; each time with the moment up to which all rows are given."""
    request = replace(request, span=window)
    parts = sorted(_parts(current, request), key=lambda part: part.start_ns)
    waiting: list[FlatTable] = []
    for number, part in enumerate(parts):
        waiting += (flat for flat in part.load() if len(flat))
        if number + 1 == len(parts):
            yield merge(waiting, schema, list(request.names), request.by), part.start_ns, 1.0
            return
        cut_ns = parts[number + 1].start_ns
        ready = _nonempty(within(flat, (None, cut_ns), request.by) for flat in waiting)
        waiting = _nonempty(within(flat, (cut_ns, None), request.by) for flat in waiting)
        rows = merge(ready, schema, list(request.names), request.by)
        yield rows, cut_ns, (number + 1) / len(parts)


def _nonempty(flats: Iterator[FlatTable]) -> list[FlatTable]:
    return [flat for flat in flats if len(flat)]


def _parts(current: RefreshingCatalogue, request: RowRequest) -> Iterator[TableSlice]:
    catalogue = current.catalogue
    for segment in catalogue.segments(request.table):
        if may_hold(segment, request):
            schema = catalogue.manifest.schemas[segment.schema]
            with damage_raised(catalogue, segment):
                groups = row_groups(catalogue.store, segment, schema, request.by)
            for group in groups:
                if overlaps(group.low_ns, group.high_ns, request.span):
                    load = partial(_load_group, catalogue, segment, schema, request, group.number)
                    yield LazySlice(group.low_ns, load)
    if not catalogue.with_segments:
        _note_without_pyarrow(current, request)
    for journal in catalogue.journals(skip=catalogue.covered(request.table)):
        item = item_of(journal, request.table)
        if item is not None:
            current.note_damage(journal)
            yield from _journal_parts(current, journal, item, request)


def _note_without_pyarrow(current: RefreshingCatalogue, request: RowRequest) -> None:
    catalogue = current.catalogue
    for segment in catalogue.manifest.segments.get(request.table, ()):
        for part in segment.parts if may_hold(segment, request) else ():
            if part.journal not in catalogue.existing:
                current.report.miss(f"{segment.path}: {part.rows} rows need pyarrow to be read")


def _load_group(
    catalogue: StoreCatalogue,
    segment: Segment,
    schema: TableSchema,
    request: RowRequest,
    number: int,
) -> list[FlatTable]:
    with damage_raised(catalogue, segment):
        flats = read_row_group(catalogue.store, segment, schema, request.names, number)
    return [within(flat, request.span, request.by) for flat in flats]


def _journal_parts(
    current: RefreshingCatalogue, journal: JournalFile, item: str, request: RowRequest
) -> Iterator[TableSlice]:
    by_receipt = request.by == "received"
    for start_ns, stop_ns in journal_slices(journal, request.span if by_receipt else (None, None)):
        load = partial(_load_slice, current, journal, item, request, (start_ns, stop_ns))
        if by_receipt:
            yield LazySlice(start_ns, load)
        else:  # a journal has no index of stamps: read them once before
            stamps = [int(flat.timestamp_ns.min()) for flat in load() if len(flat)]
            if stamps:
                yield LazySlice(min(stamps), load)


def _load_slice(
    current: RefreshingCatalogue, journal: JournalFile, item: str, request: RowRequest, span: Window
) -> list[FlatTable]:
    gaps: list[Gap] = []
    flats = list(journal_rows(journal, item, request, span, gaps))
    for gap in gaps:
        current.report.note(f"{item}: {gap.count or 'some'} rows, {gap.reason}")
    return [within(flat, request.span, request.by) for flat in flats]


class TableWriter(Protocol):
    """An open file for the rows of one table."""

    def write(self, block: TableBlock) -> None:
        """Append rows."""


OpenTable = Callable[[TableStream, Path], AbstractContextManager[TableWriter]]


def write_tables(job: ExportJob, ending: str, open_table: OpenTable) -> None:
    """Write each table of the view to a file of its own."""
    streams = streams_of(job)
    if job.path.suffix == ending:
        stream = only_table(job, streams)
        with new_file(job.path) as part, open_table(stream, part) as writer:
            write_rows(job, stream, writer)
    else:
        with new_folder(job.path) as folder:
            for number, stream in enumerate(streams):
                path = below(folder, f"{shortened(stream.schema.item)}{ending}")
                with open_table(stream, path) as writer:
                    write_rows(job, stream, writer, number, len(streams))
    job.report.bytes = size_of(job.path)
    job.progress(1.0)


def streams_of(job: ExportJob) -> list[TableStream]:
    """Choose tables and columns."""
    return job.current.ask(lambda catalogue: table_streams(catalogue, job.view))


def only_table(job: ExportJob, streams: list[TableStream]) -> TableStream:
    """Return the table that a single file is for; its child tables are named in the report."""
    tops = [stream for stream in streams if not stream.schema.parent] or streams
    if len(tops) > 1:
        names = ", ".join(stream.schema.item for stream in tops[:5])
        raise UsageError(
            f"one file cannot hold {len(tops)} tables: {names}{', ...' if tops[5:] else ''}",
            f"choose one with --item, or name a folder and --format {job.report.form}",
        )
    for stream in streams:
        if stream is not tops[0]:
            name = stream.schema.item
            job.report.note(f"{name} is a table of its own: --item {name}, or export to a folder")
    return tops[0]


def write_rows(
    job: ExportJob, stream: TableStream, writer: TableWriter, number: int = 0, count: int = 1
) -> None:
    """Write one table, ``number`` of ``count``."""
    name = stream.schema.item
    job.report.add(name, 0)
    for block in stream.blocks(job.current):
        writer.write(block)
        job.report.add(name, len(block.table))
        job.progress((number + block.done) / count)


ROWS = 2000  # at most so many rows are turned into text together

_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_TYPES = {"bool": "boolean", "string": "string", "float32": "number", "float64": "number"}


def json_topic(stream: TableStream) -> Topic:
    """Return the topic of a table: its item's name, JSON with a schema."""
    columns = {column.name: _property(column) for column in stream.empty.fields}
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": stream.schema.item,
        "type": "object",
        "properties": columns | {"timestamp": _TIME},
    }
    schema = Schema(stream.schema.item, "jsonschema", msgspec.json.encode(document))
    return Topic(stream.schema.item, "json", schema)


def _property(column: Column) -> dict[str, Any]:
    inner = element_type(column.type)
    if inner == "binary":  # viewers refuse a content encoding in a list
        return {"type": "array", "items": {"type": "string"}}
    if inner is not None:
        return {"type": "array", "items": {"type": _TYPES.get(inner, "integer")}}
    if column.type == "binary":
        return {"type": "string", "contentEncoding": "base64"}
    unit = {"description": column.unit} if column.unit else {}
    return {"type": _TYPES.get(column.type, "integer"), **unit}


def json_rows(table: Table) -> Iterator[list[bytes]]:
    """Encode rows, some at a time.

    Times are integer nanoseconds, the first one ``timestamp: {sec, nsec}``; binary is base64. A
    value that is missing is left out of its row. NaN and infinities, which JSON does not have,
    are null.
    """
    step = rows_at_once(list(table.columns.values()), ROWS)
    for start in range(0, len(table), step):
        part = table.take(slice(start, start + step))
        names = part.names
        columns = [_values(name, part.columns[name]) for name in names]
        rows = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
        for name in names:
            for row in np.flatnonzero(null_mask(part.columns[name])).tolist():
                del rows[row][name]
        yield [msgspec.json.encode(row) for row in rows]


def _values(name: str, column: ColumnData) -> Sequence[Any]:
    if name != "timestamp" or not isinstance(column, np.ndarray):
        return plain(column)
    seconds, rest = np.divmod(column, NS)
    pairs = zip(seconds.tolist(), rest.tolist(), strict=True)
    return [{"sec": sec, "nsec": nsec} for sec, nsec in pairs]


@dataclass(frozen=True)
class _CsvFile:
    file: IO[str]
    raw_text: bool

    def write(self, block: TableBlock) -> None:
        block.table.to_csv(self.file, header=False, raw_text=self.raw_text)


def write_csv(job: ExportJob) -> None:
    """Write CSV files, or one table to stdout where no target is given."""
    if job.target is not None:
        write_tables(job, ".csv", partial(_opened, raw_text=job.options.raw_text))
        return
    stream = only_table(job, streams_of(job))
    stream.empty.to_csv(sys.stdout)
    write_rows(job, stream, _CsvFile(sys.stdout, job.options.raw_text))


@contextmanager
def _opened(stream: TableStream, path: Path, raw_text: bool) -> Iterator[_CsvFile]:
    with path.open("w", encoding="utf-8", newline="") as file:
        stream.empty.to_csv(file)
        yield _CsvFile(file, raw_text)


METADATA = "amberbox.table"  # key of the file's metadata that describes the table, as JSON


@dataclass(frozen=True)
class _ParquetFile:
    writer: Any
    schema: pa.Schema

    def write(self, block: TableBlock) -> None:
        table = block.table.to_arrow().cast(self.schema)
        self.writer.write_table(table, row_group_size=len(block.table))


def write_parquet(job: ExportJob) -> None:
    """Write Parquet files; raises UsageError where pyarrow is not installed."""
    try:
        import pyarrow.parquet  # noqa: F401 # only checked for presence
    except ImportError:
        raise UsageError("Parquet needs pyarrow", "pip install amberbox[query]") from None
    write_tables(job, ".parquet", _parquet_opened)


@contextmanager
def _parquet_opened(stream: TableStream, path: Path) -> Iterator[_ParquetFile]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    empty = stream.empty
    plain = empty.to_arrow().schema
    described = [
        field.with_metadata(_column_metadata(column))
        for field, column in zip(plain, empty.fields, strict=True)
    ]
    schema = pa.schema(described, metadata={METADATA: json.dumps(_table_metadata(stream.schema))})
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        yield _ParquetFile(writer, schema)


def _column_metadata(column: Column) -> dict[str, str]:
    known = {"path": column.path, "type": column.type, "unit": column.unit}
    if column.labels:
        known["labels"] = json.dumps({str(number): text for number, text in column.labels.items()})
    return {key: value for key, value in known.items() if value}


def _table_metadata(schema: TableSchema) -> dict[str, str]:
    names = ("item", "type", "topic", "source", "stamp", "parent")
    return {name: getattr(schema, name) for name in names}
