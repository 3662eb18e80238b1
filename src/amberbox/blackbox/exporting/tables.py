"""The rows of a table in order of time, stretch by stretch, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

from amberbox.blackbox.exporting.looking import Looking
from amberbox.blackbox.exporting.slices import Part, slices
from amberbox.blackbox.exporting.view import View, Window, chosen_tables, ordered_windows
from amberbox.blackbox.follow.read import JournalFile
from amberbox.blackbox.query.catalogue import Catalogue, item_of
from amberbox.blackbox.query.gather import (
    DamagedSegmentError,
    Merged,
    Request,
    journal_rows,
    may_hold,
    merge,
    noticing_damage,
    within,
)
from amberbox.blackbox.query.record import make_table, needed_columns, wanted_columns
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.query.variables import Wanted
from amberbox.blackbox.segments.flat import Flat, TableSchema
from amberbox.blackbox.segments.manifest import Segment
from amberbox.blackbox.segments.parquet import overlaps, read_row_group, row_groups
from amberbox.core.types import Gap, IntArray

TablePart = Part[list[Flat]]


@dataclass(frozen=True)
class Block:
    """Rows of a table, ready to be written, and how much of the table is done with them."""

    table: Table
    received_ns: IntArray
    timestamp_ns: IntArray
    done: float


@dataclass(frozen=True)
class TableStream:
    """One table of a view; ``blocks`` reads it."""

    schema: TableSchema
    wanted: Sequence[Wanted]
    windows: Sequence[Window]
    by: str

    @property
    def empty(self) -> Table:
        """The table without rows: its columns and their types."""
        nothing = merge([], self.schema, needed_columns(self.wanted), self.by)
        return make_table(self.schema, self.wanted, nothing)

    def blocks(self, looking: Looking) -> Iterator[Block]:
        """Read the rows in order of time."""
        needed = needed_columns(self.wanted)
        for number, window in enumerate(self.windows):
            request = Request(self.schema.item, needed, window, self.by)
            for rows, done in _window_rows(looking, self.schema, request):
                table = make_table(self.schema, self.wanted, rows)
                share = (number + done) / len(self.windows)
                yield Block(table, rows.received_ns, rows.timestamp_ns, share)


def table_streams(catalogue: Catalogue, view: View) -> list[TableStream]:
    """Choose the tables of a view and their columns."""
    return [table_stream(catalogue, schema, view) for schema in chosen_tables(catalogue, view)]


def table_stream(catalogue: Catalogue, schema: TableSchema, view: View) -> TableStream:
    """Choose the columns of a table; raises UsageError for a variable that is not there."""
    named = view.variables.get(schema.item)
    if named is None and view.all_variables:
        named = [*(["parent_seq"] if schema.parent else []), *(c.name for c in schema.columns)]
    wanted = wanted_columns(catalogue, schema, named)
    if view.received:
        keys = ["received"] if schema.parent else ["received", "seq"]
        known = {column.name for column in wanted}
        wanted += [w for w in wanted_columns(catalogue, schema, keys) if w.name not in known]
    return TableStream(schema, wanted, ordered_windows(view.windows), view.by)


def _window_rows(
    looking: Looking, schema: TableSchema, request: Request
) -> Iterator[tuple[Merged, float]]:
    """Read one window; files that move or break meanwhile cost a new look, no row twice."""
    rest = request
    while True:
        try:
            for rows, cut_ns, done in _read(looking, schema, rest):
                if len(rows.seq):
                    yield rows, done
                rest = replace(rest, span=(cut_ns, request.span[1]))
                looking.moved_on()
            return
        except DamagedSegmentError as damage:
            looking.without(damage)
        except FileNotFoundError:
            looking.again()


def _read(
    looking: Looking, schema: TableSchema, request: Request
) -> Iterator[tuple[Merged, int, float]]:
    """Merge the parts of a table; each time with the moment up to which all rows are given."""
    parts = sorted(_parts(looking, request), key=lambda part: part.start_ns)
    waiting: list[Flat] = []
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


def _nonempty(flats: Iterator[Flat]) -> list[Flat]:
    return [flat for flat in flats if len(flat)]


def _parts(looking: Looking, request: Request) -> Iterator[TablePart]:
    catalogue = looking.catalogue
    for segment in catalogue.segments(request.table):
        if may_hold(segment, request):
            yield from _segment_parts(catalogue, segment, request)
    if not catalogue.with_segments:
        _tell_without_pyarrow(looking, request)
    for journal in catalogue.journals(skip=catalogue.covered(request.table)):
        item = item_of(journal, request.table)
        if item is not None:
            looking.tell_damage(journal)
            yield from _journal_parts(looking, journal, item, request)


def _tell_without_pyarrow(looking: Looking, request: Request) -> None:
    catalogue = looking.catalogue
    for segment in catalogue.manifest.segments.get(request.table, ()):
        for part in segment.parts if may_hold(segment, request) else ():
            if part.journal not in catalogue.existing:
                looking.report.miss(f"{segment.path}: {part.rows} rows need pyarrow to be read")


def _segment_parts(catalogue: Catalogue, segment: Segment, request: Request) -> Iterator[TablePart]:
    schema = catalogue.manifest.schemas[segment.schema]
    with noticing_damage(catalogue, segment):
        groups = row_groups(catalogue.store, segment, schema, request.by)
    for group in groups:
        if overlaps(group.low_ns, group.high_ns, request.span):
            load = partial(_load_group, catalogue, segment, schema, request, group.number)
            yield Part(group.low_ns, load)


def _load_group(
    catalogue: Catalogue, segment: Segment, schema: TableSchema, request: Request, number: int
) -> list[Flat]:
    with noticing_damage(catalogue, segment):
        flats = read_row_group(catalogue.store, segment, schema, request.names, number)
    return [within(flat, request.span, request.by) for flat in flats]


def _journal_parts(
    looking: Looking, journal: JournalFile, item: str, request: Request
) -> Iterator[TablePart]:
    by_receipt = request.by == "received"
    for start_ns, stop_ns in slices(journal, request.span if by_receipt else (None, None)):
        load = partial(_load_slice, looking, journal, item, request, (start_ns, stop_ns))
        if by_receipt:
            yield Part(start_ns, load)
        else:  # a journal has no index of stamps: look at them once before
            stamps = [int(flat.timestamp_ns.min()) for flat in load() if len(flat)]
            if stamps:
                yield Part(min(stamps), load)


def _load_slice(
    looking: Looking, journal: JournalFile, item: str, request: Request, span: Window
) -> list[Flat]:
    gaps: list[Gap] = []
    flats = list(journal_rows(journal, item, request, span, gaps))
    for gap in gaps:
        looking.report.note(f"{item}: {gap.count or 'some'} rows, {gap.reason}")
    return [within(flat, request.span, request.by) for flat in flats]
