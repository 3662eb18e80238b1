"""Commits: journals become table rows in batches; small files are joined; journals that fail are
refused.
"""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
from sqlalchemy import Connection, Row

from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, flatten
from amberbox.blackbox.store.journal_reader import JournalFile, batches_of, journal_file
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Gap
from amberbox.core.version import __version__
from amberbox.server import settings
from amberbox.server.archive import delta_files
from amberbox.server.archive.catalogue import (
    PUT,
    REFUSED,
    ArchiveCatalogue,
    CommitBatch,
    RobotStore,
    name_of,
)
from amberbox.server.archive.delta_files import (
    ArchiveLayout,
    FileBuilder,
    JournalOrigin,
    LiveFile,
    TableFilePath,
    by_day,
    join_files,
    table_of,
    tables_of,
)
from amberbox.server.archive.retention import remove_rows
from amberbox.server.archive.rollups import RollupBuilder
from amberbox.server.ingest.link_state import log_event
from amberbox.server.journals import CommitResult, decode, encode, gap_facts, sha256_of

# Number of tries of a batch; a worker may also die for other reasons
TRIES = 2

# Kind of the event about a journal that was refused
KIND = "journal_refused"

_NAME = "archive.suspects"


@dataclass(frozen=True, slots=True)
class Suspects:
    """Failures of a batch: their number, journal and reason; ``alone`` are journals committed
    separately.

    Journals are named ``robot/store_id/folder/file``; ``at`` is empty when the failures happened at
    different journals, or at none.
    """

    batch: int = 0
    times: int = 0
    at: str = ""
    why: str = ""
    alone: tuple[str, ...] = ()

    def is_given_up(self, batch: CommitBatch) -> bool:
        """Return whether a batch has failed too often to be begun again."""
        return self.batch == batch.number and self.times >= TRIES


def read_suspects(connection: Connection) -> Suspects:
    """Read the state of failures, in a transaction."""
    return settings.read(connection, _NAME, Suspects)


def load_suspects(catalogue: ArchiveCatalogue) -> Suspects:
    """Read the state of failures."""
    with catalogue.database.reading() as connection:
        return read_suspects(connection)


def note_failure(catalogue: ArchiveCatalogue, now_ns: int, at: str, why: str) -> None:
    """Count that the open batch failed over the journal ``at``."""
    batch = catalogue.open_batch()
    if batch is None:
        return
    with catalogue.database.begin() as connection:
        before = read_suspects(connection)
        if before.batch != batch.number:
            before = replace(before, batch=batch.number, times=0, at=at)
        after = replace(
            before, times=before.times + 1, at=at if at == before.at else "", why=why[:500]
        )
        settings.write(connection, now_ns, _NAME, after)


def give_up(catalogue: ArchiveCatalogue, batch: CommitBatch, now_ns: int) -> int:
    """End a failed batch without rows in any table; return how many journals were refused.

    The journal at which it failed is committed alone from now on, or each of them when that is
    unknown. A journal that fails alone is refused.
    """
    with catalogue.database.begin() as connection:
        suspects = read_suspects(connection)
        names = {name_of(row): row for row in batch.journals}
        blamed = {suspects.at} & names.keys() or names.keys()
        left = [name for name in suspects.alone if name not in names]
        refused = next((row for name, row in names.items() if name in suspects.alone), None)
        if refused is not None:
            facts = decode(refused.facts)
            facts.refused, facts.by = f"it cannot be made rows of: {suspects.why}", __version__
            catalogue.change_in(connection, [refused], state=REFUSED, facts=encode(facts))
            log_event(
                connection, refused.robot, now_ns, KIND, _refusal_text(refused, facts.refused)
            )
            blamed = set()
        catalogue.cancel(connection, batch)
        after = Suspects(alone=(*left, *sorted(blamed)))
        settings.write(connection, now_ns, _NAME, after)
    return 0 if refused is None else 1


def clear_suspects(catalogue: ArchiveCatalogue, batch: CommitBatch, now_ns: int) -> None:
    """Clear the failures of journals that are committed now."""
    before = load_suspects(catalogue)
    if before == Suspects():
        return
    done = {name_of(row) for row in batch.journals}
    left = tuple(name for name in before.alone if name not in done)
    with catalogue.database.begin() as connection:
        settings.write(connection, now_ns, _NAME, Suspects(alone=left))


def try_again(catalogue: ArchiveCatalogue, now_ns: int) -> int:
    """Requeue journals, each alone, that another version of the server refused; return their
    number.
    """
    rows = [row for row in catalogue.journals() if row.state == REFUSED and not row.raw_gone]
    found = [row for row in rows if decode(row.facts).by not in ("", __version__)]
    with catalogue.database.begin() as connection:
        for row in found:
            facts = decode(row.facts)
            facts.refused = facts.by = ""
            catalogue.change_in(connection, [row], state=PUT, facts=encode(facts))
        before = read_suspects(connection)
        alone = (*before.alone, *map(name_of, found))
        settings.write(connection, now_ns, _NAME, replace(before, alone=alone))
    return len(found)


def _refusal_text(row: Row[Any], reason: str) -> str:
    return (
        f"{row.file} is kept and in no table: {reason}. It is damaged or forged, or this server "
        "has a mistake: run amberbox verify on the robot, and report the error of the server's "
        f"log with the file journals/{name_of(row)}. After an update it is tried again"
    )


# Limits of one batch, for memory and time; the rest follows a minute later
BATCH_BYTES = 512 << 20


class Step(msgspec.Struct, frozen=True):
    """The next step of a commit: the journal at hand (empty: none), and its size in bytes."""

    at: str = ""
    bytes: int = 0


Steps: TypeAlias = Generator[Step, None, CommitResult]


def commit(
    layout: ArchiveLayout, catalogue: ArchiveCatalogue, now_ns: int, every_s: float
) -> Steps:
    """Finish the open batch, else commit what waits if the last commit is ``every_s`` seconds ago.

    A batch that failed too often is split, see ``Suspects``.
    """
    begun, refused = catalogue.open_batch(), 0
    if begun is not None:
        if not load_suspects(catalogue).is_given_up(begun):
            done = yield from _commit(layout, catalogue, begun, now_ns)
            return replace(done, waiting=len(catalogue.waiting()))
        yield from _withdraw(layout, catalogue, begun)
        refused = give_up(catalogue, begun, now_ns)
    waiting, last_ns = catalogue.waiting(), catalogue.last_batch_ns()
    names = load_suspects(catalogue).alone
    alone = [row for row in waiting if name_of(row) in names]
    others = [row for row in waiting if name_of(row) not in names]
    passed_s = every_s if last_ns is None else (now_ns - last_ns) / NS
    is_due = bool(others) and not 0 <= passed_s < every_s
    chosen = list(_first(others)) if is_due else alone[:1]
    if not chosen:
        due = max(every_s - passed_s, 0.0) if waiting else every_s
        return CommitResult(refused=refused, waiting=len(waiting), next_in_s=due)
    sound = _refuse_changed(layout, catalogue, chosen)
    if sound:  # others are due when they would be without those committed alone
        catalogue.plan(sound, now_ns if is_due or last_ns is None else last_ns)
    batch = catalogue.open_batch()
    done = CommitResult()
    if batch is not None:
        done = yield from _commit(layout, catalogue, batch, now_ns)
    left = len(waiting) - len(chosen)
    soon = 0.0 if len(alone) > (0 if is_due else 1) else every_s
    refused += len(chosen) - len(sound)
    return replace(done, refused=refused, waiting=left, next_in_s=soon)


def _withdraw(
    layout: ArchiveLayout, catalogue: ArchiveCatalogue, batch: CommitBatch
) -> Iterator[Step]:
    """Remove the rows of a failed batch from the tables; idempotent."""
    by_source: dict[RobotStore, list[Row[Any]]] = {}
    for row in batch.journals:
        by_source.setdefault(RobotStore(row.robot, row.store_id), []).append(row)
    for table, schema in (pair for known in catalogue.schemas() for pair in tables_of(known)):
        if layout.snapshot(table).batch >= batch.number:
            yield Step()
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
    layout: ArchiveLayout, catalogue: ArchiveCatalogue, rows: Sequence[Row[Any]]
) -> list[Row[Any]]:
    """Refuse journals whose file is gone or has changed; return the others."""
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
    layout: ArchiveLayout, catalogue: ArchiveCatalogue, batch: CommitBatch, now_ns: int
) -> Steps:
    writing = _Writing(layout, catalogue, batch.number)
    try:
        yield from writing.write(batch.journals)
        found = writing.finish()
    finally:
        writing.discard()
    for table, (schema, files) in found.items():
        yield Step()
        about = f"batch {batch.number}: {len(batch.journals)} journals"
        delta_files.change_table(
            layout.table(table), schema, files, batch=batch.number, about=about
        )
    catalogue.finish(batch, writing.facts)
    clear_suspects(catalogue, batch, now_ns)
    return CommitResult(len(batch.journals), writing.rows, len(found))


@dataclass
class _Writing:
    """Writes the files of one batch, one writer of one store after the other."""

    layout: ArchiveLayout
    catalogue: ArchiveCatalogue
    batch: int
    rows: int = 0
    facts: dict[str, str] = field(default_factory=dict)
    _done: dict[str, tuple[TableSchema, list[LiveFile]]] = field(default_factory=dict)
    _open: dict[tuple[str, str], FileBuilder] = field(default_factory=dict)
    _known: set[tuple[RobotStore, str]] = field(default_factory=set)
    _present: dict[str, bool] = field(default_factory=dict)

    def write(self, journals: Sequence[Row[Any]]) -> Iterator[Step]:
        """Write all rows of all journals; yield each journal before it is read."""
        group: tuple[RobotStore, str] | None = None
        for row in journals:
            mine = RobotStore(row.robot, row.store_id), row.writer
            if group not in (None, mine):
                self._close()
            group = mine
            yield Step(name_of(row), row.bytes)
            self._journal(row, mine[0])
        self._close()

    def _journal(self, row: Row[Any], source: RobotStore) -> None:
        path = self.layout.journal(row.robot, row.store_id, row.file)
        journal = journal_file(path, row.file)
        gaps: list[Gap] = []
        sizes: dict[str, int] = {}
        climbs: dict[TableSchema, RollupBuilder] = {}
        for flat in flats_of(journal, gaps, sizes):
            self.rows += len(flat)
            self._add(source, table_of(flat.schema), flat)
            climbs.setdefault(flat.schema, RollupBuilder(flat.schema)).add(flat)
        for schema, climb in climbs.items():
            for level, flat in climb.levels():
                self._add(source, table_of(schema, level), flat)
            if (source, schema.id) not in self._known:
                self._known.add((source, schema.id))
                self.catalogue.register(schema, source)
        origin = JournalOrigin(row.file, row.sha256, tuple(journal.clock))
        for (table, _), builder in self._open.items():
            is_level = "." in table.rpartition("/")[2]
            size = 0 if is_level else sizes.pop(builder.schema.item, 0)  # once per journal
            builder.end_part(origin, journal.writer, journal.run, size)
        if gaps:
            facts = decode(row.facts)
            facts.gaps = [*facts.gaps, *gap_facts(gaps)]
            self.facts[name_of(row)] = encode(facts)

    def _add(self, source: RobotStore, table: str, flat: FlatTable) -> None:
        """Add rows to the files of their days, unless the table has this batch already."""
        if table not in self._present:
            self._present[table] = self.layout.snapshot(table).batch >= self.batch
        if self._present[table]:
            return
        for day, rows in by_day(flat):
            if (table, day) not in self._open:
                name = f"{self.batch:08}-{flat.writer}-{source.store_id}"
                place = TableFilePath(table, source, day, name)
                self._open[table, day] = FileBuilder(self.layout.tables, place, flat.schema)
            self._open[table, day].add(rows)

    def _close(self) -> None:
        for table, day in list(self._open):
            builder = self._open[table, day]
            file = builder.finish()
            del self._open[table, day]
            self._done.setdefault(table, (builder.schema, []))[1].append(file)

    def finish(self) -> Mapping[str, tuple[TableSchema, Sequence[LiveFile]]]:
        """Return the files by table, rollup levels first, so that levels exist when rows do."""
        return dict(sorted(self._done.items(), reverse=True))

    def discard(self) -> None:
        """Delete half-written files after an error."""
        for builder in self._open.values():
            builder.discard()


def flats_of(journal: JournalFile, gaps: list[Gap], sizes: dict[str, int]) -> Iterator[FlatTable]:
    """Unroll a journal as on the robot; messages that cannot be decoded become gaps.

    ``sizes`` collects the bytes of each item's messages.
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


def leftovers(layout: ArchiveLayout, schemas: Sequence[TableSchema]) -> Iterator[Path]:
    """Yield files that no table refers to: from interrupted commits, or joined since."""
    for table, _ in (pair for schema in schemas for pair in tables_of(schema)):
        folder = layout.table(table)
        live = {str(folder / path) for path in layout.snapshot(table).files}
        for path in folder.glob("robot=*/day=*/*"):
            if str(path) not in live and not path.name.startswith("_"):
                yield path


SMALL_BYTES = 32 << 20
FULL_BYTES = 128 << 20
# Number of small files that are joined, on a day that still grows; on past days two
COUNT = 8

_LOG = logging.getLogger(__name__)


def compact(layout: ArchiveLayout, catalogue: ArchiveCatalogue) -> int:
    """Join small files of all tables, one commit per join; return how many files were replaced."""
    gone = 0
    for table, schema in (pair for known in catalogue.schemas() for pair in tables_of(known)):
        files = list(layout.snapshot(table).files.values())
        for group in compaction_groups(files):
            try:
                made = join_files(layout.tables, table, schema, group)
            except MemoryError:  # the files stay small; go on with other tables
                _LOG.warning("%s: %d files are too large to be joined", table, len(group))
                continue
            assert made is not None  # join_files was given nothing to leave out
            about = f"joined {len(group)} files"
            folder = layout.table(table)
            delta_files.change_table(folder, schema, [made], group, same_rows=True, about=about)
            gone += len(group)
    return gone


def compaction_groups(files: Sequence[LiveFile]) -> Iterator[list[LiveFile]]:
    """Yield the groups of small files to join: of one store, writer and day, by age."""
    newest = {file.robot: file.day for file in sorted(files, key=lambda file: file.day)}
    by_place: dict[tuple[str, ...], list[LiveFile]] = {}
    for file in files:
        if file.bytes < SMALL_BYTES:
            place = (file.robot, file.day, file.low["store_id"], file.low["writer"])
            by_place.setdefault(place, []).append(file)
    for (robot, day, *_), found in sorted(by_place.items()):
        enough = COUNT if day == newest[robot] else 2
        for group in _full(sorted(found, key=lambda f: (f.low["run"], f.low["log_time"], f.path))):
            if len(group) >= enough:
                yield group


def _full(files: Sequence[LiveFile]) -> Iterator[list[LiveFile]]:
    group: list[LiveFile] = []
    for file in files:
        if group and sum(f.bytes for f in group) + file.bytes > FULL_BYTES:
            yield group
            group = []
        group.append(file)
    if group:
        yield group
