"""Gaps of a record and their reasons: recorded gaps, damage, deletions, undecodable messages."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from amberbox.blackbox.columns.flat_tables import FlatTable
from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.catalogue import StoreCatalogue
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.journal_reader import KEPT_RAW, batches_of, journal_file, with_columns
from amberbox.blackbox.store.manifest import ManifestJournal, has_size
from amberbox.blackbox.store.manifest_entries import Segment
from amberbox.blackbox.store.segment_file import overlaps, row_groups
from amberbox.blackbox.store.store import Store, open_store
from amberbox.blackbox.store.table_reader import (
    DamagedSegmentError,
    RowRequest,
    TimeSpan,
    damage_raised,
    gap_of_part,
    gather,
    may_hold,
)
from amberbox.blackbox.store.tail import RECORDED, Delivery, WriterTail
from amberbox.core.types import Gap, WriterCursor

_SAME = ("writer", "run", "item", "reason", "peer")
_FIELDS = ("item", "peer", "from_ns", "to_ns", "reason", "count")


def gaps(catalogue: StoreCatalogue, item: str | None, span: TimeSpan) -> list[Gap]:
    """Return the gaps that overlap ``[from, to)``, in order of time, of one item or of all."""
    found = [
        *_holes(catalogue), *_deleted(catalogue), *_undecodable(catalogue),
        *_lost_columns(catalogue, span),
    ]  # fmt: skip
    return joined_gaps_in(recorded_and_known(catalogue, found), item, span)


def recorded_and_known(catalogue: StoreCatalogue, then: Iterable[Gap]) -> list[Gap]:
    """Return the recorded gaps and others whose times are as they were known ``then``."""
    return [*_recorded(catalogue), *(corrected_gap(gap, catalogue) for gap in then)]


def joined_gaps_in(found: Sequence[Gap], item: str | None, span: TimeSpan) -> list[Gap]:
    """Join gaps that go on from each other; keep those of a range, in order of time."""
    kept = [gap for gap in _joined(found) if _concerns(gap, item, span)]
    return sorted(kept, key=lambda gap: (gap.from_ns, gap.to_ns, gap.item))


def corrected_gap(gap: Gap, catalogue: StoreCatalogue) -> Gap:
    """Return a gap with times corrected by the present knowledge of the clocks."""
    from_ns, to_ns = (
        catalogue.book.known_now_ns(gap.run, time_ns) for time_ns in (gap.from_ns, gap.to_ns)
    )
    return replace(gap, from_ns=from_ns, to_ns=max(from_ns, to_ns))


def _joined(known: Sequence[Gap]) -> Iterator[Gap]:
    """Join gaps of one reason where one ends at the row that the next begins with."""
    last: Gap | None = None
    for gap in known:
        if last is not None and _goes_on(last, gap):
            count = None if last.count is None or gap.count is None else last.count + gap.count
            last = replace(last, to_ns=gap.to_ns, to_seq=gap.to_seq, count=count)
            continue
        if last is not None:
            yield last
        last = gap
    if last is not None:
        yield last


def _goes_on(first: Gap, second: Gap) -> bool:
    same = all(getattr(first, name) == getattr(second, name) for name in _SAME)
    return same and first.to_seq is not None and first.to_seq == second.from_seq


def _concerns(gap: Gap, item: str | None, span: TimeSpan) -> bool:
    last_ns = max(gap.to_ns - 1, gap.from_ns)
    return (item is None or gap.item in ("", item)) and overlaps(gap.from_ns, last_ns, span)


def _recorded(catalogue: StoreCatalogue) -> Iterator[Gap]:
    """Read the gap channel; a gap that was never closed lasts to the end of its run."""
    table = next((n for n, v in catalogue.schemas.items() if v[-1].topic == channels.GAP), None)
    if table is None:
        return
    still_open: dict[tuple[object, ...], Gap] = {}
    pieces = gather(catalogue, RowRequest(table, _FIELDS)).pieces
    for piece in sorted(pieces, key=lambda piece: (piece.run, int(piece.seq[0]))):
        for gap, is_open in _gap_rows(piece):
            key = (gap.run, gap.item, gap.peer, gap.reason)
            if is_open:  # of a publisher one gap is open at a time
                still_open[key] = gap
            else:
                still_open.pop(key, None)
                yield gap
    ends = _run_ends(catalogue) if still_open else {}
    for gap in still_open.values():
        yield replace(gap, to_ns=max(ends.get(gap.run, gap.from_ns), gap.from_ns + 1))


def _gap_rows(piece: FlatTable) -> Iterator[tuple[Gap, bool]]:
    columns = [plain(piece.columns[name]) for name in _FIELDS]
    offsets = (piece.received_ns - piece.log_time_ns).tolist()
    for offset, row in zip(offsets, zip(*columns, strict=True), strict=True):
        item, peer, from_ns, to_ns, reason, count = row
        end = (from_ns if to_ns is None else to_ns) + offset
        gap = Gap(
            piece.writer, piece.run, from_ns + offset, end, reason, item, count, peer=peer or ""
        )
        yield gap, to_ns is None


def _run_ends(catalogue: StoreCatalogue) -> dict[int, int]:
    """Return when the last row of each run was received."""
    ends: dict[int, int] = {}
    for run, end_ns in _ends(catalogue):
        ends[run] = max(ends.get(run, end_ns), end_ns)
    return ends


def _ends(catalogue: StoreCatalogue) -> Iterator[tuple[int, int]]:
    for segments in catalogue.manifest.segments.values():
        for segment in segments:
            yield segment.parts[-1].run, segment.received_range_ns[1]
    for journal in catalogue.journals(skip=catalogue.done):
        if journal.rows:
            yield journal.run, ClockTable(journal.clock).at(journal.end_ns)


def last_received_ns(catalogue: StoreCatalogue) -> int | None:
    """Return when the newest record was received."""
    return max((end_ns for _, end_ns in _ends(catalogue)), default=None)


def _holes(catalogue: StoreCatalogue) -> Iterator[Gap]:
    """Yield the missing rows of the journals; rows that are in segments are not missing.

    For deleted rows the tombstones give the reason.
    """
    store = open_store(catalogue.store)
    for writer in (writer for writer in store.writers() if writer in RECORDED):
        for delivery in _HoleTail(store, writer, catalogue.done).step():
            if isinstance(delivery, Gap) and delivery.from_seq is not None:
                yield from _outside_segments(delivery, catalogue)


class _HoleTail(WriterTail):
    """Finds missing rows; journals whose rows are in segments are not read again."""

    def __init__(self, store: Store, writer: str, condensed: Collection[str]) -> None:
        super().__init__(store, writer, (), WriterCursor())
        self._condensed = condensed

    def _static(self, path: Path) -> Iterator[Delivery]:
        journal = journal_file(path, f"{path.parent.name}/{path.name}")
        if journal.name in self._condensed and journal.places:
            yield from self._enter(journal.run, journal.first_seq, journal)
            self.seq, self.last_ns = max(self.seq, journal.end_seq), journal.end_ns
        yield from super()._static(path)


def _outside_segments(gap: Gap, catalogue: StoreCatalogue) -> Iterator[Gap]:
    """Yield the parts of a gap that are outside of journals whose rows are in segments."""
    assert gap.from_seq is not None
    reached, since_ns = gap.from_seq, gap.from_ns
    end = gap.from_seq if gap.to_seq is None else gap.to_seq
    for journal in _covered(catalogue, gap):
        if journal.first_seq > reached:
            yield _piece(gap, reached, min(journal.first_seq, end), since_ns, journal.start_ns)
        if journal.end_seq > reached:
            reached, since_ns = journal.end_seq, journal.end_ns
    if reached < end or gap.to_seq is None:
        yield _piece(gap, reached, end, since_ns, gap.to_ns)


def _covered(catalogue: StoreCatalogue, gap: Gap) -> list[ManifestJournal]:
    if not catalogue.with_segments:
        return []
    found = [
        journal
        for journal in catalogue.manifest.journals.values()
        if (journal.writer, journal.run) == (gap.writer, gap.run)
        and journal.end_seq > (gap.from_seq or 0)
        and journal.first_seq < (gap.to_seq or 0)
    ]
    return sorted(found, key=lambda journal: journal.first_seq)


def _piece(gap: Gap, from_seq: int, to_seq: int, from_ns: int, to_ns: int) -> Gap:
    count = to_seq - from_seq if gap.count is not None else None
    return replace(gap, from_seq=from_seq, to_seq=to_seq, count=count, from_ns=from_ns, to_ns=to_ns)


def _deleted(catalogue: StoreCatalogue) -> Iterator[Gap]:
    existing, sealed = set(catalogue.existing), catalogue.manifest.sealed
    for journal in catalogue.manifest.journals.values():
        if journal.name not in existing or journal.name in catalogue.done:
            yield from sealed[journal.name].gaps() if journal.name in sealed else ()


def _undecodable(catalogue: StoreCatalogue) -> Iterator[Gap]:
    """Yield messages without columns: by the manifest, else by unrolling the journal once."""
    raw = {(journal.name, item) for item, found in catalogue.raw.items() for journal, _ in found}
    for done in catalogue.manifest.journals.values():
        for gap in done.gaps:
            has_columns_now = gap.reason.startswith(KEPT_RAW) and (done.name, gap.item) not in raw
            if not (has_columns_now and done.name in catalogue.existing):
                yield gap
    store = open_store(catalogue.store)
    for name in catalogue.existing:
        if name not in catalogue.manifest.journals:
            path = store.journal_path(name)
            status = path.stat()
            yield from _misfits(path, name, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=256)
def _misfits(path: Path, name: str, _mtime_ns: int, _size: int) -> tuple[Gap, ...]:
    """Return the undecodable messages of a journal as gaps; cached until the file changes."""
    journal, found = journal_file(path, name), list[Gap]()
    for _ in batches_of(journal, with_columns(journal, found.append), on_gap=found.append):
        pass
    return tuple(found)


def _lost_columns(catalogue: StoreCatalogue, span: TimeSpan) -> Iterator[Gap]:
    """Yield the rows lost in damaged segments whose journals are gone; pages are not read."""
    wanted = RowRequest("", (), span)
    listed = (s for found in catalogue.manifest.segments.values() for s in found)
    lost = {segment.path for segment in catalogue.manifest.lost}
    for segment in (*catalogue.manifest.lost, *(listed if catalogue.with_segments else ())):
        gone = [part for part in segment.parts if part.journal not in catalogue.existing]
        if not gone or not may_hold(segment, wanted):
            continue
        if segment.path in lost or not _can_be_opened(catalogue, segment):
            there = (catalogue.store / segment.path).exists()
            reason = f"{segment.path} is {'damaged' if there else 'gone'}"
            yield from (gap_of_part(segment, part, reason) for part in gone)


def _can_be_opened(catalogue: StoreCatalogue, segment: Segment) -> bool:
    schema = catalogue.manifest.schemas[segment.schema]
    try:
        with damage_raised(catalogue, segment):
            row_groups(catalogue.store, segment, schema, "received")
    except DamagedSegmentError:
        return False
    return has_size(catalogue.store, segment)
