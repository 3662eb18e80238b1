"""Gather the rows of a table from segments and journals, each row exactly once, in order."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, flatten
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.catalogue import StoreCatalogue, item_of
from amberbox.blackbox.store.journal_reader import JournalFile, batches_of, inside
from amberbox.blackbox.store.manifest_entries import Segment, SegmentPart
from amberbox.blackbox.store.segment_file import overlaps, read_segment
from amberbox.blackbox.store.store import KEPT
from amberbox.core.types import ColumnData, Gap, IntArray

TimeSpan: TypeAlias = tuple[int | None, int | None]


@dataclass(frozen=True, slots=True)
class RowRequest:
    """Which rows and columns of a table are wanted; ``[from, to)`` by ``received`` or stamp."""

    table: str
    names: Collection[str]
    span: TimeSpan = (None, None)
    by: str = "received"


@dataclass(slots=True)
class GatheredRows:
    """Rows in the order of the files, piece by piece, and the parts that could not be read."""

    pieces: list[FlatTable] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class DamagedSegmentError(Exception):
    """A segment that cannot be read: its journal is read instead, if it exists."""

    def __init__(self, segment: Segment, reason: str) -> None:
        super().__init__(reason)
        self.segment = segment


def gather(catalogue: StoreCatalogue, request: RowRequest) -> GatheredRows:
    """Read the rows of a request; a segment that is damaged is replaced by its journal."""
    found = GatheredRows()
    while True:
        try:
            found.pieces = list(_segment_rows(catalogue, request))
            break
        except DamagedSegmentError as damage:
            note_damaged(found, catalogue, damage.segment, str(damage))
            catalogue = catalogue.without(damage.segment)
    _add_journals(found, catalogue, request)
    for segment in catalogue.manifest.lost:
        if segment.item == request.table and may_hold(segment, request):
            note_damaged(found, catalogue, segment, "it or its line of the manifest is gone")
    if not catalogue.with_segments:
        note_unreadable(found, catalogue, request)
    pieces = (within(piece, request.span, request.by) for piece in without_copies(found.pieces))
    found.pieces = [piece for piece in pieces if len(piece)]
    return found


def without_copies(pieces: Sequence[FlatTable]) -> list[FlatTable]:
    """Leave out rows of the kept journal whose originals are there, too.

    They are copied before a journal is deleted; both are there until it is, which may be later when
    the power fails meanwhile.
    """
    originals: dict[int, Counter[tuple[str, ...]]] = {}
    copied = {int(at) for p in pieces if p.writer == KEPT for at in p.received_ns}
    for piece in pieces if copied else ():
        if piece.writer != KEPT:
            for row in np.flatnonzero(np.isin(piece.received_ns, [*copied])).tolist():
                at_ns = int(piece.received_ns[row])
                originals.setdefault(at_ns, Counter())[_values(piece, row)] += 1
    if not originals:
        return list(pieces)
    return [_new_rows(p, originals) if p.writer == KEPT else p for p in pieces]


def _new_rows(piece: FlatTable, originals: Mapping[int, Counter[tuple[str, ...]]]) -> FlatTable:
    rows = []
    for row, at_ns in enumerate(piece.received_ns.tolist()):
        known, values = originals.get(at_ns, Counter()), _values(piece, row)
        if known[values]:
            known[values] -= 1
        else:
            rows.append(row)
    return piece.take(np.array(rows, np.int64))


def _values(piece: FlatTable, row: int) -> tuple[str, ...]:
    one = piece.take(np.array([row]))
    return tuple(f"{name}={one.columns[name]!r}" for name in sorted(one.columns))


def _segment_rows(catalogue: StoreCatalogue, request: RowRequest) -> Iterator[FlatTable]:
    for segment in catalogue.segments(request.table):
        if not may_hold(segment, request):
            continue
        schema = catalogue.manifest.schemas[segment.schema]
        with damage_raised(catalogue, segment):
            flats = read_segment(
                catalogue.store, segment, schema, request.names, request.span, request.by,
                catalogue.stored,
            )  # fmt: skip
        yield from flats


@contextmanager
def damage_raised(catalogue: StoreCatalogue, segment: Segment) -> Iterator[None]:
    """Convert errors of reading a segment to ``DamagedSegmentError``."""
    try:
        yield
    except FileNotFoundError as error:
        if not mf.is_listed(catalogue.store, segment):
            raise  # joined or deleted meanwhile: the caller reads again
        raise DamagedSegmentError(segment, "it is gone") from error
    except mf.UNREADABLE as error:
        raise DamagedSegmentError(segment, mf.why(error)) from error


def may_hold(segment: Segment, request: RowRequest) -> bool:
    """Return whether a segment may hold rows of a request's range."""
    bounds = segment.received_range_ns if request.by == "received" else segment.stamp_range_ns
    return overlaps(*bounds, request.span)


def without_damage(catalogue: StoreCatalogue, table: str) -> tuple[StoreCatalogue, list[str]]:
    """Return the catalogue without damaged segments of a table, and notes on the lost rows.

    For readers that do not check the checksums of pages. A file is hashed once.
    """
    found = GatheredRows()
    for segment in catalogue.segments(table):
        path = catalogue.store / segment.path
        try:
            with damage_raised(catalogue, segment):
                status = path.stat()
                if not _is_as_written(path, segment.sha256, status.st_mtime_ns, status.st_size):
                    raise DamagedSegmentError(segment, "it is not as it was written")
        except DamagedSegmentError as damage:
            note_damaged(found, catalogue, segment, str(damage))
            catalogue = catalogue.without(segment)
    return catalogue, found.notes


@lru_cache(maxsize=65536)
def _is_as_written(path: Path, sha256: str, _mtime_ns: int, _size: int) -> bool:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == sha256


def note_damaged(
    found: GatheredRows, catalogue: StoreCatalogue, segment: Segment, reason: str
) -> None:
    """Report the rows lost by a damaged segment: none where its journals still exist."""
    lost = [part for part in segment.parts if part.journal not in catalogue.existing]
    if not lost:
        found.notes.append(f"{segment.path} is damaged, its journal was read instead ({reason})")
    for part in lost:
        found.notes.append(f"{segment.path} is damaged, {part.rows} rows are lost ({reason})")
        found.gaps.append(gap_of_part(segment, part, f"{segment.path} is damaged"))


def note_unreadable(found: GatheredRows, catalogue: StoreCatalogue, request: RowRequest) -> None:
    """Report the rows that cannot be read without pyarrow: their journal is deleted."""
    for segment in catalogue.manifest.segments.get(request.table, ()):
        for part in segment.parts if may_hold(segment, request) else ():
            if part.journal not in catalogue.existing:
                found.notes.append(f"{segment.path}: {part.rows} rows need pyarrow to be read")
                found.gaps.append(gap_of_part(segment, part, "needs pyarrow to be read"))


def gap_of_part(segment: Segment, part: SegmentPart, reason: str) -> Gap:
    """Return the rows of a part of a segment as a gap."""
    return Gap(part.writer, part.run, part.from_ns, part.to_ns + 1, reason, segment.item, part.rows)


def from_journals(catalogue: StoreCatalogue, request: RowRequest) -> GatheredRows:
    """Read only the rows that are in no segment."""
    found = GatheredRows()
    _add_journals(found, catalogue, request)
    found.pieces = [piece for piece in without_copies(found.pieces) if len(piece)]
    return found


def _add_journals(found: GatheredRows, catalogue: StoreCatalogue, request: RowRequest) -> None:
    covered = catalogue.covered(request.table)
    span = request.span if request.by == "received" else (None, None)
    for journal in catalogue.journals(skip=covered):
        item = item_of(journal, request.table)
        if item is not None:
            found.pieces += journal_rows(journal, item, request, span, found.gaps)


def journal_rows(
    journal: JournalFile, item: str, request: RowRequest, span: TimeSpan, gaps: list[Gap]
) -> Iterator[FlatTable]:
    """Yield a table's rows of one journal, with the wanted columns only."""
    for batch in batches_of(journal, {item}, *span, on_gap=gaps.append):
        for flat in flatten(batch):
            if flat.schema.item == request.table and len(flat):
                kept = {n: c for n, c in flat.columns.items() if n in request.names}
                yield flat.with_columns(kept)


def within(piece: FlatTable, span: TimeSpan, by: str) -> FlatTable:
    """Keep the rows of a range."""
    times = piece.received_ns if by == "received" else piece.timestamp_ns
    rows = inside(times, *span)
    return piece if rows.all() else piece.take(rows)


@dataclass(frozen=True, slots=True, eq=False)
class MergedRows:
    """The rows of all pieces in order, each column in the union's type."""

    seq: IntArray
    received_ns: IntArray
    timestamp_ns: IntArray
    columns: dict[str, ColumnData]

    def __len__(self) -> int:
        return len(self.seq)


def merge(
    pieces: Sequence[FlatTable], schema: TableSchema, names: Sequence[str], by: str
) -> MergedRows:
    """Return rows by (time, writer, run, seq), with nulls for columns of other versions."""
    ordered = sorted(pieces, key=lambda p: (int(p.received_ns[0]), p.writer, p.run, int(p.seq[0])))
    kinds = {column.name: column.type for column in schema.columns}
    merged = MergedRows(
        _joined([piece.seq for piece in ordered]),
        _joined([piece.received_ns for piece in ordered]),
        _joined([piece.timestamp_ns for piece in ordered]),
        {name: _column(ordered, name, kinds[name]) for name in names},
    )
    order = _order(ordered, merged.received_ns if by == "received" else merged.timestamp_ns, merged)
    return merged if order is None else _take(merged, order)


def _joined(arrays: Sequence[IntArray]) -> IntArray:
    return np.concatenate(arrays) if arrays else np.empty(0, np.int64)


def _column(pieces: Sequence[FlatTable], name: str, kind: str) -> ColumnData:
    parts = []
    for piece in pieces:
        known = piece.schema.column(name)
        if known is None:
            parts.append(col.nulls(kind, len(piece)))
        else:
            parts.append(col.cast(piece.columns[name], known.type, kind))
    return col.concatenate(parts) if parts else col.empty(kind)


def _order(pieces: Sequence[FlatTable], times: IntArray, merged: MergedRows) -> IntArray | None:
    """Return the order of rows; None when they are in order already."""
    steps, places = np.diff(times), np.diff(merged.seq)
    in_order = bool(((steps > 0) | ((steps == 0) & (places >= 0))).all())
    if in_order and len({piece.writer for piece in pieces}) <= 1:
        return None
    lengths = [len(piece) for piece in pieces]
    writers = sorted({piece.writer for piece in pieces})
    writer = np.repeat([writers.index(piece.writer) for piece in pieces], lengths)
    run = np.repeat([piece.run for piece in pieces], lengths)
    order: IntArray = np.lexsort((merged.seq, run, writer, times))
    return order


def _take(merged: MergedRows, rows: col.RowIndex) -> MergedRows:
    return MergedRows(
        merged.seq[rows],
        merged.received_ns[rows],
        merged.timestamp_ns[rows],
        {name: col.take(column, rows) for name, column in merged.columns.items()},
    )
