"""Rows of journals whose file was deleted, read from segments in their original order."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, join_tables
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.manifest import Manifest, ManifestJournal
from amberbox.blackbox.store.manifest_entries import SealedJournal, Segment, SegmentPart, Tombstone
from amberbox.blackbox.store.store import Store, run_and_number
from amberbox.core.types import Batch, ColumnData, Gap, ItemSchema, Ragged

WINDOW_ROWS = 4096
_KEYS = ("index", "parent_index")


@dataclass(frozen=True, slots=True)
class SequenceRange:
    """Rows of a journal, or of several: ``[first_seq, end_seq)`` of a writer's run."""

    journal: str
    writer: str
    run: int
    first_seq: int
    end_seq: int

    def meets(self, part: SegmentPart) -> bool:
        """Return whether a part of a segment may have rows of it."""
        same = (part.writer, part.run) == (self.writer, self.run)
        return same and part.last_seq >= self.first_seq and part.first_seq < self.end_seq


class TableRows:
    """One table's rows of a stretch, in ``seq`` order, read one row group at a time."""

    def __init__(
        self, store: Path, segment: Segment, schema: TableSchema, of: SequenceRange
    ) -> None:
        self.schema = schema
        self.damage = ""
        self._store = store
        self._segment = segment
        self._path = segment.path
        self._flats = _row_groups(store, segment, schema, of)
        none = np.empty(0, np.int64)
        columns = {column.name: col.empty(column.type) for column in schema.columns}
        self._none = FlatTable(schema, of.writer, of.run, none, none, none, none, columns)
        self._next = self._none
        self._read_on()

    @property
    def next_seq(self) -> int | None:
        """Return the position of the next row; None after the last one."""
        return int(self._next.seq[0]) if len(self._next) else None

    def take(self, end_seq: int) -> FlatTable:
        """Return the rows before ``end_seq`` that were not taken yet."""
        taken = []
        while len(self._next):
            cut = int(np.searchsorted(self._next.seq, end_seq))
            taken.append(self._next.take(slice(0, cut)))
            if cut < len(self._next):
                self._next = self._next.take(slice(cut, None))
                break
            self._read_on()
        found = [flat for flat in taken if len(flat)]
        return join_tables(found) if found else self._none

    def _read_on(self) -> None:
        try:
            self._next = next((flat for flat in self._flats if len(flat)), self._none)
        except mf.UNREADABLE as error:
            if not mf.is_listed(self._store, self._segment):  # joined or deleted meanwhile
                raise FileNotFoundError(self._path) from error
            self.damage = f"{self._path} is damaged: {mf.why(error)}"
            self._next = self._none


def _row_groups(
    store: Path, segment: Segment, schema: TableSchema, of: SequenceRange
) -> Iterator[FlatTable]:
    from amberbox.blackbox.store.segment_file import read_row_group, row_groups

    names = {column.name for column in schema.columns}
    for group in row_groups(store, segment, schema, "received"):
        for flat in read_row_group(store, segment, schema, names, group.number):
            if (flat.writer, flat.run) == (of.writer, of.run):
                yield flat.take((flat.seq >= of.first_seq) & (flat.seq < of.end_seq))


def tables_of(
    store: Path, known: Manifest, of: SequenceRange, items: Collection[str] | None
) -> list[TableRows]:
    """Open the tables of the given items (None: all) that have rows of a stretch."""
    found = []
    for segments in known.segments.values():
        for segment in segments:
            schema = known.schemas[segment.schema]
            wanted = items is None or (schema.parent or schema.item) in items
            if wanted and any(of.meets(part) for part in segment.parts):
                found.append(TableRows(store, segment, schema, of))
    return found


def windows(tables: Sequence[TableRows], of: SequenceRange) -> Iterator[int]:
    """Yield positions up to which rows may be taken together, each once those before are taken.

    No table has rows of two versions of its schema in one piece.
    """
    begins = sorted({table.next_seq for table in tables if table.next_seq is not None})
    while True:
        waiting = [table.next_seq for table in tables if table.next_seq is not None]
        if not waiting:
            break
        first = min(waiting)
        later = (begin for begin in begins if begin > first)
        end_seq = min(first + WINDOW_ROWS, next(later, of.end_seq))
        if end_seq >= of.end_seq:
            break
        yield end_seq
    yield of.end_seq


def batches(tables: Sequence[TableRows], end_seq: int) -> list[Batch]:
    """Return all rows before ``end_seq``: a batch per item, in the order of their first rows."""
    taken = [table.take(end_seq) for table in tables]
    tops = [flat for flat in taken if len(flat) and not flat.schema.parent]
    made = [_batch(flat, _children(flat, taken)) for flat in tops]
    return sorted(made, key=lambda batch: int(batch.seq[0]))


def damage(tables: Sequence[TableRows]) -> Iterator[tuple[str, str]]:
    """Yield the tables that could not be read to their end, with the reason, once."""
    for table in tables:
        if table.damage:
            why, table.damage = table.damage, ""
            yield table.schema.item, why


def _children(top: FlatTable, taken: Sequence[FlatTable]) -> dict[str, FlatTable]:
    """Return the child tables of an item by name, with the rows of these messages only."""
    mine = [flat for flat in taken if flat.schema.parent == top.schema.item]
    tables: dict[str, FlatTable] = {}
    for flat in mine:  # of two versions the one that has rows here
        if flat.schema.item not in tables or len(flat):
            tables[flat.schema.item] = flat
    return {name: flat.take(np.isin(flat.seq, top.seq)) for name, flat in tables.items()}


def _batch(flat: FlatTable, below: Mapping[str, FlatTable]) -> Batch:
    """Build a batch with its direct child tables among ``below``."""
    name, schema = flat.schema.item, flat.schema
    direct = [n for n in below if n.startswith(f"{name}__") and not _between(name, n, below)]
    children = {n.removeprefix(f"{name}__"): _batch(below[n], below) for n in direct}
    keys: dict[str, ColumnData] = {"parent_seq": flat.seq} if schema.parent else {}
    own = tuple(c for c in schema.columns if not (schema.parent and c.name in _KEYS))
    stamp = "" if schema.parent else schema.stamp
    below_schemas = {path: child.schema for path, child in children.items()}
    return Batch(
        item=name,
        schema=ItemSchema(schema.type, own, below_schemas, stamp),
        writer=flat.writer,
        run=flat.run,
        seq=flat.seq,
        log_time_ns=flat.log_time_ns,
        received_ns=flat.received_ns,
        timestamp_ns=flat.timestamp_ns,
        columns={**keys, **flat.columns},
        children=children,
        topic=schema.topic,
        source=schema.source,
    )


def _between(name: str, below: str, tables: Mapping[str, FlatTable]) -> bool:
    """Return whether a table hangs on another one that is nearer than ``name``."""
    return any(
        other not in (name, below)
        and other.startswith(f"{name}__")
        and below.startswith(f"{other}__")
        for other in tables
    )


def rest_of(batch: Batch, from_seq: int) -> Batch | None:
    """Return a batch without rows read before; None when none is left."""
    if int(batch.seq[0]) >= from_seq:
        return batch
    return _taken(batch, from_seq) if int(batch.seq[-1]) >= from_seq else None


def _taken(batch: Batch, from_seq: int) -> Batch:
    rows = batch.seq >= from_seq
    return replace(
        batch,
        seq=batch.seq[rows],
        log_time_ns=batch.log_time_ns[rows],
        received_ns=batch.received_ns[rows],
        timestamp_ns=batch.timestamp_ns[rows],
        columns={name: col.take(column, rows) for name, column in batch.columns.items()},
        children={path: _taken(child, from_seq) for path, child in batch.children.items()},
    )


def gaps_recorded(batch: Batch) -> Iterator[Gap]:
    """Yield the gaps of closed gap records in a batch of the gap channel."""
    names = ("from_ns", "to_ns", "reason", "item", "count")
    values = [_plain(batch.columns.get(name), len(batch)) for name in names]
    offsets = (batch.received_ns - batch.log_time_ns).tolist()
    for offset, from_ns, to_ns, reason, item, count in zip(offsets, *values, strict=True):
        if to_ns is not None:
            edges = from_ns + offset, to_ns + offset
            yield Gap(batch.writer, batch.run, *edges, reason, item, count)


def _plain(column: ColumnData | None, count: int) -> list[Any]:
    return [None] * count if column is None or isinstance(column, Ragged) else column.tolist()


LOST = "deleted or lost with its file"
FORGOTTEN = "deleted: older than the ring"
_GAP_ITEM = channels.GAP.replace("/", "_")


@dataclass(frozen=True, slots=True)
class DeletedJournal:
    """A journal whose file is deleted, or several adjacent ones (then without a name).

    ``reason`` is why rows are missing, empty when all of them are in segments. Times are
    times of receipt, ``place`` is run and number of the last file.
    """

    place: tuple[int, int]
    stretch: SequenceRange
    start_ns: int
    end_ns: int
    reason: str = ""


def gone_journals(known: Manifest, writer: str) -> list[DeletedJournal]:
    """Return a writer's journals by the manifest, as if all their files were deleted."""
    found = {gone.place: gone for gone in _gone(known, writer)}
    return [found[place] for place in sorted(found)]


def _gone(known: Manifest, writer: str) -> Iterator[DeletedJournal]:
    """Yield a writer's journals by the manifest; the best known version of each is the last one."""
    for sealed in known.sealed.values():
        if sealed.writer == writer:
            yield _of_file(sealed.journal, sealed, LOST)
    for tombstone in known.tombstones:
        if tombstone.writer == writer and tombstone.what != "raw":
            yield _of_tombstone(tombstone)
    for journal in known.journals.values():
        if journal.writer == writer:
            yield _of_file(journal.name, journal, "")


def _of_file(name: str, found: SealedJournal | ManifestJournal, reason: str) -> DeletedJournal:
    stretch = SequenceRange(name, found.writer, found.run, found.first_seq, found.end_seq)
    return DeletedJournal(run_and_number(Path(name)), stretch, found.start_ns, found.end_ns, reason)


def _of_tombstone(found: Tombstone) -> DeletedJournal:
    name = found.journals[0] if len(found.journals) == 1 else ""
    stretch = SequenceRange(name, found.writer, found.run, found.first_seq, found.end_seq)
    place = run_and_number(Path(found.journals[-1]))
    return DeletedJournal(place, stretch, found.start_ns, found.end_ns, f"deleted: {found.reason}")


class DeletedJournals:
    """The deleted journals of a writer; computed again only when the manifest has changed."""

    def __init__(self, store: Store, writer: str) -> None:
        self._store = store
        self._writer = writer
        self._known: Manifest | None = None
        self._journals: list[DeletedJournal] = []
        self._places: list[tuple[int, int]] = []

    def since(self, place: tuple[int, int], files: Sequence[Path]) -> list[DeletedJournal]:
        """Return those after a place whose file is not among these, in order."""
        known = mf.read(self._store.path)
        if known is not self._known:
            self._known = known
            self._journals = gone_journals(known, self._writer)
            self._places = [gone.place for gone in self._journals]
        later = self._journals[bisect_right(self._places, place) :]
        here = {run_and_number(path) for path in files} if later else set()
        return [gone for gone in later if gone.place not in here]


def outline_of(gone: DeletedJournal) -> JournalFile:
    """Return the outline of a journal without its file, in times of receipt."""
    stretch = gone.stretch
    return JournalFile(
        name=stretch.journal, path=Path(), writer=stretch.writer, run=stretch.run,
        number=gone.place[1], first_seq=stretch.first_seq, end_seq=stretch.end_seq,
        start_ns=gone.start_ns, end_ns=gone.end_ns, finished=True, items={}, bytes=0, clock=(),
        chain="", streams={}, places=(),
    )  # fmt: skip


def rows_of_deleted(
    store: Path,
    gone: DeletedJournal,
    items: Collection[str] | None,
    from_seq: int,
    read_to: Callable[[str], int],
) -> Iterator[tuple[int, list[Batch | Gap]]]:
    """Yield the remaining rows of a journal piecewise: the position after it, batches, gaps.

    ``read_to`` returns the position up to which an item has been read before. Raises
    FileNotFoundError when segments are moved meanwhile.
    """
    from amberbox.blackbox.store.segment_file import can_build

    stretch, known = gone.stretch, mf.read(store)
    from_seq = max(from_seq, stretch.first_seq)
    missing: list[Batch | Gap] = [_gap(gone, from_seq, gone.reason)] if gone.reason else []
    if not can_build():
        why = missing or [_gap(gone, from_seq, "needs pyarrow to be read")]
        yield stretch.end_seq, why
        return
    if items is not None and not items:
        yield stretch.end_seq, missing
        return
    wanted = None if items is None else {*items, _GAP_ITEM}
    tables = tables_of(store, known, stretch, wanted)
    for end_seq in windows(tables, stretch):
        found = list(_window(tables, end_seq, items, read_to))
        found += [_gap(gone, from_seq, why, item) for item, why in damage(tables)]
        if end_seq == stretch.end_seq:
            found += _known_gaps(known, stretch, items)
            found += missing
        yield end_seq, found


def _window(
    tables: Sequence[TableRows],
    end_seq: int,
    items: Collection[str] | None,
    read_to: Callable[[str], int],
) -> Iterator[Batch | Gap]:
    for batch in batches(tables, end_seq):
        rest = rest_of(batch, read_to(batch.item))
        if rest is None:
            continue
        if items is None or batch.item in items:
            yield rest
        if batch.topic == channels.GAP:
            yield from gaps_recorded(rest)


def _known_gaps(known: Manifest, of: SequenceRange, items: Collection[str] | None) -> Iterator[Gap]:
    """Yield gaps of undecodable and damaged rows that were found when the segments were built."""
    journal, sealed = known.journals.get(of.journal), known.sealed.get(of.journal)
    for gap in journal.gaps if journal is not None else ():
        if items is None or gap.item in items:
            yield gap
    if journal is not None and sealed is not None:
        yield from sealed.gaps()


def _gap(gone: DeletedJournal, from_seq: int, reason: str, item: str = "") -> Gap:
    of = gone.stretch
    count = None if item else of.end_seq - from_seq
    return Gap(of.writer, of.run, gone.start_ns, gone.end_ns + 1, reason, item, count,
               from_seq, of.end_seq)  # fmt: skip
