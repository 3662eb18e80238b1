"""From journals to tables: a batch is planned, written, committed table by table, and ended.

Whatever dies on the way, the batch is the same when it is done again, its files have the same
names, and a table that has its number already is left alone: no row is lost or doubled. A batch
over which the worker fails again is taken apart, so that one journal never holds up the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.follow.read import JournalFile, batches_of, journal_file
from amberbox.blackbox.segments.flat import Flat, TableSchema, flatten
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Gap
from amberbox.fleet.archive import suspects
from amberbox.fleet.archive.catalogue import REFUSED, Batch, Catalogue, Source, name_of
from amberbox.fleet.archive.files import Layout, table_of, tables_of
from amberbox.fleet.archive.journal import decode, encode, gap_facts, sha256_of
from amberbox.fleet.archive.log import LiveFile
from amberbox.fleet.archive.pyramid import Climb
from amberbox.fleet.archive.retaining import remove_rows
from amberbox.fleet.archive.store import Committed
from amberbox.fleet.archive.writing import FileBuilder, Origin, Place, by_day

BATCH_BYTES = 512 << 20
"""Journals of one batch: so much memory and time at most; the rest follows a minute later."""


Progress = Callable[[str, int], None]
"""Hears of each step: which journal is at hand (empty: none), and how many bytes it has."""


def unheard(_name: str, _size: int) -> None:
    """Hear of steps and do nothing."""


def commit(
    layout: Layout, catalogue: Catalogue, now_ns: int, every_s: float,
    progress: Progress = unheard,
) -> Committed:  # fmt: skip
    """Finish what was begun, else commit what waits if the last commit is long enough ago.

    A batch that failed too often is taken apart: see ``suspects``.
    """
    begun, refused = catalogue.open_batch(), 0
    if begun is not None:
        if not suspects.known(catalogue).is_given_up(begun):
            done = _commit(layout, catalogue, begun, now_ns, progress)
            return replace(done, waiting=len(catalogue.waiting()))
        _withdraw(layout, catalogue, begun, progress)
        refused = suspects.give_up(catalogue, begun, now_ns)
    waiting, last_ns = catalogue.waiting(), catalogue.last_batch_ns()
    alone, others = _apart(waiting, suspects.known(catalogue).alone)
    passed_s = every_s if last_ns is None else (now_ns - last_ns) / NS
    is_due = bool(others) and not 0 <= passed_s < every_s
    chosen = list(_first(others)) if is_due else alone[:1]
    if not chosen:
        due = max(every_s - passed_s, 0.0) if waiting else every_s
        return Committed(refused=refused, waiting=len(waiting), next_in_s=due)
    sound = _refuse_changed(layout, catalogue, chosen)
    if sound:  # others are due when they would be without those that are committed alone
        catalogue.plan(sound, now_ns if is_due or last_ns is None else last_ns)
    batch = catalogue.open_batch()
    done = Committed() if batch is None else _commit(layout, catalogue, batch, now_ns, progress)
    left = len(waiting) - len(chosen)
    soon = 0.0 if len(alone) > (0 if is_due else 1) else every_s
    refused += len(chosen) - len(sound)
    return replace(done, refused=refused, waiting=left, next_in_s=soon)


def _apart(
    waiting: Sequence[Row[Any]], alone: Sequence[str]
) -> tuple[list[Row[Any]], list[Row[Any]]]:
    """Part journals that are committed alone from the others."""
    names = set(alone)
    found: tuple[list[Row[Any]], list[Row[Any]]] = ([], [])
    for row in waiting:
        found[name_of(row) not in names].append(row)
    return found


def _withdraw(layout: Layout, catalogue: Catalogue, batch: Batch, progress: Progress) -> None:
    """Take out of the tables what a batch that failed brought there; done again it is the same."""
    by_source: dict[Source, list[Row[Any]]] = {}
    for row in batch.journals:
        by_source.setdefault(Source(row.robot, row.store_id), []).append(row)
    for table, schema in (pair for known in catalogue.schemas() for pair in tables_of(known)):
        if layout.snapshot(table).batch >= batch.number:
            progress("", 0)
            about = f"batch {batch.number} failed"
            for source, rows in by_source.items():
                remove_rows(layout, table, schema, source, rows, about)


def _first(waiting: Sequence[Row[Any]]) -> Iterator[Row[Any]]:
    size = 0
    for row in waiting:
        size += row.bytes
        if size > BATCH_BYTES and size != row.bytes:
            return
        yield row


def _refuse_changed(
    layout: Layout, catalogue: Catalogue, rows: Sequence[Row[Any]]
) -> list[Row[Any]]:
    """Leave out journals that are not what they were when they came, whole."""
    sound = []
    for row in rows:
        path = layout.journal(row.robot, row.store_id, row.file)
        reason = "" if path.exists() else "the file is gone"
        if not reason and sha256_of(path) != row.sha256:
            reason = "the file changed after it was verified"
        if not reason:
            sound.append(row)
            continue
        facts = decode(row.facts)
        facts.refused = reason
        catalogue.change([row], state=REFUSED, facts=encode(facts))
    return sound


def _commit(
    layout: Layout, catalogue: Catalogue, batch: Batch, now_ns: int, progress: Progress
) -> Committed:
    from amberbox.fleet.archive import delta

    writing = _Writing(layout, catalogue, batch.number, progress)
    try:
        writing.write(batch.journals)
        found = writing.finish()
    finally:
        writing.discard()
    for table, (schema, files) in found.items():
        progress("", 0)
        about = f"batch {batch.number}: {len(batch.journals)} journals"
        delta.change(layout.table(table), schema, files, batch=batch.number, about=about)
    catalogue.finish(batch, writing.facts)
    suspects.clear(catalogue, batch, now_ns)
    return Committed(len(batch.journals), writing.rows, len(found))


@dataclass
class _Writing:
    """The files of one batch. A store's writer comes whole, then the next one."""

    layout: Layout
    catalogue: Catalogue
    batch: int
    progress: Progress
    rows: int = 0
    facts: dict[str, str] = field(default_factory=dict)
    _done: dict[str, tuple[TableSchema, list[LiveFile]]] = field(default_factory=dict)
    _open: dict[tuple[str, str], FileBuilder] = field(default_factory=dict)
    _known: set[tuple[Source, str]] = field(default_factory=set)
    _present: dict[str, bool] = field(default_factory=dict)

    def write(self, journals: Sequence[Row[Any]]) -> None:
        """Write all rows of all journals."""
        group: tuple[Source, str] | None = None
        for row in journals:
            mine = Source(row.robot, row.store_id), row.writer
            if group not in (None, mine):
                self._close()
            group = mine
            self.progress(name_of(row), row.bytes)
            self._journal(row, mine[0])
        self._close()

    def _journal(self, row: Row[Any], source: Source) -> None:
        path = self.layout.journal(row.robot, row.store_id, row.file)
        journal = journal_file(path, row.file)
        gaps: list[Gap] = []
        sizes: dict[str, int] = {}
        climbs: dict[TableSchema, Climb] = {}
        for flat in flats_of(journal, gaps, sizes):
            self.rows += len(flat)
            self._add(source, table_of(flat.schema), flat)
            climbs.setdefault(flat.schema, Climb(flat.schema)).add(flat)
        for schema, climb in climbs.items():
            for level, flat in climb.levels():
                self._add(source, table_of(schema, level), flat)
            self._register(source, schema)
        origin = Origin(row.file, row.sha256, tuple(journal.clock))
        for (table, _), builder in self._open.items():
            is_level = "." in table.rpartition("/")[2]
            size = 0 if is_level else sizes.pop(builder.schema.item, 0)  # of several days, once
            builder.end_part(origin, journal.writer, journal.run, size)
        if gaps:
            facts = decode(row.facts)
            facts.gaps = [*facts.gaps, *gap_facts(gaps)]
            self.facts[name_of(row)] = encode(facts)

    def _register(self, source: Source, schema: TableSchema) -> None:
        if (source, schema.id) not in self._known:
            self._known.add((source, schema.id))
            self.catalogue.register(schema, source)

    def _add(self, source: Source, table: str, flat: Flat) -> None:
        """Give rows to the file of their day, unless the table has this batch already."""
        if self._has_batch(table):
            return
        for day, rows in by_day(flat):
            if (table, day) not in self._open:
                name = f"{self.batch:08}-{flat.writer}-{source.store_id}"
                place = Place(table, source, day, name)
                self._open[table, day] = FileBuilder(self.layout.tables, place, flat.schema)
            self._open[table, day].add(rows)

    def _has_batch(self, table: str) -> bool:
        if table not in self._present:
            self._present[table] = self.layout.snapshot(table).batch >= self.batch
        return self._present[table]

    def _close(self) -> None:
        for table, day in list(self._open):
            builder = self._open[table, day]
            file = builder.finish()
            del self._open[table, day]
            self._done.setdefault(table, (builder.schema, []))[1].append(file)

    def finish(self) -> Mapping[str, tuple[TableSchema, Sequence[LiveFile]]]:
        """Return the files by table: the levels first, so that rows are there when they are."""
        return dict(sorted(self._done.items(), reverse=True))

    def discard(self) -> None:
        """Leave nothing half written, after an error."""
        for builder in self._open.values():
            builder.discard()


def flats_of(journal: JournalFile, gaps: list[Gap], sizes: dict[str, int]) -> Iterator[Flat]:
    """Unroll a journal as the keeper does; what cannot be decoded is told as gaps.

    The bytes of each item's messages are added up in ``sizes``.
    """
    items = set()
    for stream in journal.streams.values():
        try:
            stream.unroller()
            items.add(stream.item)
        except AmberboxError as error:
            reason = f"no columns, only in {journal.name}: {error.what}"
            count = journal.items.get(stream.item)
            span = journal.start_ns, journal.end_ns + 1
            gaps.append(Gap(journal.writer, journal.run, *span, reason, stream.item, count))
    for batch in batches_of(journal, items, on_gap=gaps.append, sizes=sizes):
        yield from (flat for flat in flatten(batch) if len(flat))


def leftovers(layout: Layout, schemas: Sequence[TableSchema]) -> Iterator[Path]:
    """Find files that no table names: of a commit that was cut short, or joined since."""
    for table, _ in (pair for schema in schemas for pair in tables_of(schema)):
        folder = layout.table(table)
        live = {str(folder / path) for path in layout.snapshot(table).files}
        for path in folder.glob("robot=*/day=*/*"):
            if str(path) not in live and not path.name.startswith("_"):
                yield path
