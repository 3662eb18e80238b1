"""A snapshot of a robot's record: the archive's tables, and journals that are in no table yet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import Row, select

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.columns.variables import item_named, suggest_names
from amberbox.blackbox.query.overview import ItemInfo, overview
from amberbox.blackbox.query.record import Time
from amberbox.blackbox.query.rows import By, answer
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.catalogue import StoreCatalogue as StoreCatalogue
from amberbox.blackbox.store.catalogue import item_of, journal_tables, union
from amberbox.blackbox.store.journal_reader import JournalFile, journal_file
from amberbox.blackbox.store.table_reader import (
    GatheredRows,
    RowRequest,
    gather,
    journal_rows,
    within,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Gap, ItemSchema
from amberbox.server.archive.catalogue import PUT, ArchiveCatalogue, RobotStore
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.archive.gaps import gaps_of
from amberbox.server.archive.reader import ArchiveReader, Span
from amberbox.server.archive.record import ArchiveRecord, summed
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.journals import decode
from amberbox.server.schema import JOURNALS

if TYPE_CHECKING:
    from amberbox.blackbox.retention.missions import RecordedMission

READ_BYTES = 64 << 20
"""Bytes of waiting journals that a query reads; with more, the answer states up to when it is
complete.
"""

NONE = (
    "no journal of this robot has come yet: it sends one every ten minutes, or when it is asked for"
)

_ATTEMPTS = 5
_MARGIN_NS = 60 * 10**9
"""Margin for corrected times of receipt, which may differ from those noted when a journal
arrived.
"""

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class WaitingJournal:
    """A journal whose rows are in no table yet."""

    source: RobotStore
    row: Row[Any]
    path: Path

    def meets(self, span: Span) -> bool:
        """Return whether it may hold rows of ``[from, to)`` by receive time."""
        from_ns, to_ns = span
        late = to_ns is not None and self.row.start_ns - _MARGIN_NS >= to_ns
        return not late and (from_ns is None or self.row.end_ns + _MARGIN_NS >= from_ns)

    @property
    def journal(self) -> JournalFile:
        """The description of the journal file."""
        return journal_file(self.path, self.row.file)


@dataclass
class RecordSnapshot:
    """The record of one robot; ``skipped`` are journals of the range that were not read."""

    reader: ArchiveReader
    catalogue: ArchiveCatalogue
    waiting: Sequence[WaitingJournal]
    skipped: list[WaitingJournal] = field(default_factory=list)

    @cached_property
    def readable(self) -> Sequence[WaitingJournal]:
        """The newest of the waiting journals, up to the limit of bytes per query."""
        found, size = [], 0
        for one in sorted(self.waiting, key=lambda w: -w.row.end_ns):
            size += one.row.bytes
            if size <= READ_BYTES and one.path.exists():
                found.append(one)
        return found

    @cached_property
    def journals(self) -> Mapping[RobotStore, Sequence[JournalFile]]:
        """The readable journals by store, in the order of writing."""
        found: dict[RobotStore, list[JournalFile]] = {}
        for one in reversed(self.readable):
            found.setdefault(one.source, []).append(one.journal)
        return found

    @cached_property
    def schemas(self) -> dict[str, list[TableSchema]]:
        """The versions of each table's schema, oldest first."""
        found = {name: list(versions) for name, versions in self.reader.schemas.items()}
        for one in reversed(self.readable):
            for schema in journal_tables(one.journal):
                versions = found.setdefault(schema.item, [])
                if schema not in versions:
                    versions.append(schema)
        return found

    def schema(self, table: str) -> TableSchema:
        """Return a table's columns; raises UsageError for an unknown table."""
        versions = self.reader.schemas.get(table)
        if versions is not None and not self.readable:
            return union(versions)
        name = item_named(self.schemas, table)
        if name is None:
            known = sorted(self.schemas)
            hint = suggest_names(table, known) if known else NONE
            raise UsageError(f"there is no data item {table!r}", hint)
        return union(self.schemas[name])

    @property
    def selection(self) -> Mapping[str, Sequence[str]]:
        """The variables configured for each item, by the newest journal."""
        chosen = dict(self.reader.selection)
        for one in reversed(self.readable):
            chosen.update(decode(one.row.facts).selection)
        return chosen

    def rows(self, request: RowRequest) -> GatheredRows:
        """Read the rows of a request, each once."""
        found = GatheredRows()
        for source in self.reader.sources:
            store = self.reader.of(source, request.table, request=request)
            one = gather(store, request)
            found.pieces += one.pieces
            found.gaps += one.gaps
            found.notes += one.notes
            if self.waiting:
                self._add(found, source, request, _inside(store, request.table))
        return found

    def only_in_journals(self, table: str) -> Iterator[WaitingJournal]:
        """Yield the readable journals whose rows are still missing in a table."""
        inside = {
            source: _inside(self.reader.of(source, table), table)
            for source in {one.source for one in self.readable}
        }
        return (one for one in self.readable if one.row.file not in inside[one.source])

    def _add(
        self, found: GatheredRows, source: RobotStore, request: RowRequest, inside: set[str]
    ) -> None:
        span = request.span if request.by == "received" else (None, None)
        for one in self.waiting:
            if not one.meets(span) or one.source != source or one.row.file in inside:
                continue
            if one not in self.readable:
                self.skipped.append(one)
                continue
            journal = one.journal
            item = item_of(journal, request.table)
            points = self.reader.clocks(source).book.points(journal.name)
            if item is not None:
                journal = journal if points is None else replace(journal, clock=points)
                rows = journal_rows(journal, item, request, span, found.gaps)
                pieces = (within(piece, request.span, request.by) for piece in rows)
                found.pieces += [piece for piece in pieces if len(piece)]

    def complete_ns(self) -> int | None:
        """Return the time (ns) up to which all data on the server are read; None without data."""
        if self.skipped:
            return min(int(one.row.start_ns) for one in self.skipped)
        ends = [one.row.end_ns for one in self.waiting]
        last = self.committed_ns()
        return max([*ends, *([last] if last is not None else [])], default=None)

    def committed_ns(self) -> int | None:
        """Return the latest receive time (ns) in the tables, or None."""
        robots = [source.robot for source in self.reader.sources]
        return self.catalogue.last_ns(robots) if robots else None


def _inside(store: StoreCatalogue, table: str) -> set[str]:
    """Return the names of the journals whose rows are in a table."""
    return {part.journal for segment in store.segments(table) for part in segment.parts}


@lru_cache(maxsize=4)
def open_catalogue(folder: Path) -> ArchiveCatalogue:
    """Open the archive's catalogue, once per worker."""
    return ArchiveCatalogue(ServerDatabase(folder / FILE, read_only=True))


def with_snapshot(
    folder: Path,
    robot: str,
    question: Callable[[RecordSnapshot], Answer],
    span: Span = (None, None),
) -> Answer:
    """Answer from one snapshot of a robot's record; retry when files were joined meanwhile.

    Of the journals that are in no table yet it has those that meet ``span``.
    """
    catalogue, layout = open_catalogue(folder), ArchiveLayout(folder)
    for _ in range(_ATTEMPTS):
        waiting = [one for one in _waiting(catalogue, layout, robot) if one.meets(span)]
        reader = ArchiveReader(layout, catalogue, catalogue.sources([robot]))
        try:
            return question(RecordSnapshot(reader, catalogue, waiting))
        except FileNotFoundError:
            continue
    raise AmberboxError(f"the archive of {robot} changed while it was being read", "ask again")


def _waiting(
    catalogue: ArchiveCatalogue, layout: ArchiveLayout, robot: str
) -> list[WaitingJournal]:
    chosen = (
        select(JOURNALS)
        .where(JOURNALS.c.robot == robot, JOURNALS.c.state == PUT, JOURNALS.c.raw_gone.is_(False))
        .order_by(JOURNALS.c.start_ns)
    )
    with catalogue.database.reading() as connection:
        rows = connection.execute(chosen).all()
    return [
        WaitingJournal(
            RobotStore(r.robot, r.store_id), r, layout.journal(r.robot, r.store_id, r.file)
        )
        for r in rows
    ]


@dataclass(frozen=True)
class SnapshotRecord(ArchiveRecord):
    """The record of one robot on the server, with the journals that are in no table yet and meet
    ``span``; SQL and envelopes are answered from the tables only.
    """

    span: Span = (None, None)

    def items(self) -> list[ItemInfo]:
        """See ``Record``."""
        return self._ask(
            lambda look: summed(
                overview(look.reader.with_journals(source, look.journals.get(source, ())))
                for source in look.reader.sources
            )
        )

    def has_item(self, item: str) -> bool:
        """See ``Record``."""
        return self._ask(lambda look: item in look.schemas)

    def variables(self, item: str) -> ItemSchema:
        """See ``Record``."""
        schema = self._ask(lambda look: look.schema(item))
        return ItemSchema(schema.type, schema.columns, {}, schema.stamp)

    def query(
        self,
        item: str,
        variables: Sequence[str] | None = None,
        from_: Time = None,
        to: Time = None,
        by: By = "received",
        points: int | None = None,
        *,
        missions: Sequence[RecordedMission] | None = None,
    ) -> Table:
        """See ``Record``."""
        if missions is not None:
            raise UsageError("missions cannot be named here", "give from and to")
        span = self.span_ns(from_, to)
        return self._ask(lambda look: answer(look, look.rows, item, variables, span, by, points))

    def last_ns(self) -> int | None:
        """See ``Record``."""
        return self._ask(lambda look: look.complete_ns())

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return the gaps with their reasons; for one item also messages that have no columns."""
        span = self.span_ns(from_, to)

        def find(look: RecordSnapshot) -> list[Gap]:
            found = gaps_of(look.reader, look.catalogue, item, span, waiting=look.journals)
            return found if item is None else [*found, *look.rows(RowRequest(item, (), span)).gaps]

        return self._ask(find)

    def _ask(self, question: Callable[[RecordSnapshot], Answer]) -> Answer:
        (robot,) = self.robots
        return with_snapshot(self.path, robot, question, self.span)
