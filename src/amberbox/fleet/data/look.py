"""One look at a robot's record: the archive's tables, and the journals that are in none yet.

What waits is listed before the tables are read: a journal that is committed in between is found in
both, and told by its name. So each row is there exactly once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import Row, select

from amberbox.blackbox.follow.read import JournalFile, journal_file
from amberbox.blackbox.query.catalogue import Catalogue as StoreCatalogue
from amberbox.blackbox.query.catalogue import item_of, journal_tables, union
from amberbox.blackbox.query.gather import Gathered, Request, gather, journal_rows, within
from amberbox.blackbox.query.variables import closest
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Gap
from amberbox.fleet.archive.catalogue import PUT, Catalogue, Source
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.journal import decode
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.database.database import FILE, Database

READ_BYTES = 64 << 20
"""Waiting journals that a question reads; of more the answer says up to when it is complete."""

NONE = (
    "no journal of this robot has come yet: it sends one every ten minutes, or when it is asked for"
)

_ATTEMPTS = 5
_MARGIN_NS = 60 * 10**9
"""Corrected times of receipt may differ from those that were noted when a journal came."""

Span = tuple[int | None, int | None]
Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Waiting:
    """A journal whose rows are in no table yet."""

    source: Source
    row: Row[Any]
    path: Path

    def meets(self, span: Span) -> bool:
        """Tell whether it may hold rows of ``[from, to)`` by time of receipt."""
        from_ns, to_ns = span
        late = to_ns is not None and self.row.start_ns - _MARGIN_NS >= to_ns
        return not late and (from_ns is None or self.row.end_ns + _MARGIN_NS >= from_ns)

    @property
    def journal(self) -> JournalFile:
        """The journal's file, looked into."""
        return journal_file(self.path, self.row.file)


@dataclass
class Look:
    """What there is of one robot. ``skipped`` are journals of the range that were not read."""

    reader: Reader
    catalogue: Catalogue
    waiting: Sequence[Waiting]
    skipped: list[Waiting] = field(default_factory=list)

    @cached_property
    def readable(self) -> Sequence[Waiting]:
        """The newest of the journals that wait, as many as one question may read."""
        found, size = [], 0
        for one in sorted(self.waiting, key=lambda w: -w.row.end_ns):
            size += one.row.bytes
            if size <= READ_BYTES and one.path.exists():
                found.append(one)
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
        """Return a table's columns; raises UsageError for one that is not there."""
        versions = self.reader.schemas.get(table)
        if versions is not None and not self.readable:
            return union(versions)
        by_case = {name.casefold(): name for name in reversed(self.schemas)}
        name = table if table in self.schemas else by_case.get(table.casefold())
        if name is None:
            known = sorted(self.schemas)
            hint = closest(table, known) if known else NONE
            raise UsageError(f"there is no data item {table!r}", hint)
        return union(self.schemas[name])

    @property
    def selection(self) -> Mapping[str, Sequence[str]]:
        """The variables configured for each item, the newest journal's word counting."""
        chosen = dict(self.reader.selection)
        for one in reversed(self.readable):
            chosen.update(decode(one.row.facts).selection)
        return chosen

    def rows(self, request: Request) -> Gathered:
        """Read the rows of a request, each once."""
        found = Gathered()
        for source in self.reader.sources:
            store = self.reader.of(source, request.table, request=request)
            one = gather(store, request)
            found.pieces += one.pieces
            found.gaps += one.gaps
            found.notes += one.notes
            if self.waiting:
                self._add(found, source, request, _inside(store, request.table))
        return found

    def only_in_journals(self, table: str) -> Iterator[Waiting]:
        """Yield the readable journals whose rows a table does not have, not even by now."""
        inside = {
            source: _inside(self.reader.of(source, table), table)
            for source in {one.source for one in self.readable}
        }
        return (one for one in self.readable if one.row.file not in inside[one.source])

    def _add(self, found: Gathered, source: Source, request: Request, inside: set[str]) -> None:
        span = request.span if request.by == "received" else (None, None)
        gaps: list[Gap] = []
        for one in self._meeting(span):
            if one.source != source or one.row.file in inside:
                continue
            if one not in self.readable:
                self.skipped.append(one)
                continue
            journal = one.journal
            item = item_of(journal, request.table)
            points = self.reader.clocks(source).book.points(journal.name)
            if item is not None:
                journal = journal if points is None else replace(journal, clock=points)
                rows = journal_rows(journal, item, request, span, gaps)
                pieces = (within(piece, request.span, request.by) for piece in rows)
                found.pieces += [piece for piece in pieces if len(piece)]

    def _meeting(self, span: Span) -> Iterator[Waiting]:
        return (one for one in self.waiting if one.meets(span))

    def complete_ns(self) -> int | None:
        """Return up to when everything that the server holds was looked at; None: of nothing."""
        if self.skipped:
            return min(int(one.row.start_ns) for one in self.skipped)
        ends = [one.row.end_ns for one in self.waiting]
        last = self.committed_ns()
        return max([*ends, *([last] if last is not None else [])], default=None)

    def committed_ns(self) -> int | None:
        """Return when the newest row of the tables was received."""
        robots = [source.robot for source in self.reader.sources]
        return self.catalogue.last_ns(robots) if robots else None


def _inside(store: StoreCatalogue, table: str) -> set[str]:
    """Name the journals whose rows a table has."""
    return {part.journal for segment in store.segments(table) for part in segment.parts}


@lru_cache(maxsize=4)
def open_catalogue(folder: Path) -> Catalogue:
    """Open what the archive knows, once per worker."""
    return Catalogue(Database(folder / FILE, read_only=True))


def look(folder: Path, robot: str, question: Callable[[Look], Answer]) -> Answer:
    """Answer from one look at a robot's record; look again when files were joined meanwhile."""
    catalogue, layout = open_catalogue(folder), Layout(folder)
    for _ in range(_ATTEMPTS):
        waiting = _waiting(catalogue, layout, robot)
        reader = Reader(layout, catalogue, catalogue.sources([robot]))
        try:
            return question(Look(reader, catalogue, waiting))
        except FileNotFoundError:
            continue
    raise AmberboxError(f"the archive of {robot} changed while it was being read", "ask again")


def _waiting(catalogue: Catalogue, layout: Layout, robot: str) -> list[Waiting]:
    chosen = (
        select(JOURNALS)
        .where(JOURNALS.c.robot == robot, JOURNALS.c.state == PUT, JOURNALS.c.raw_gone.is_(False))
        .order_by(JOURNALS.c.start_ns)
    )
    with catalogue.database.reading() as connection:
        rows = connection.execute(chosen).all()
    return [
        Waiting(Source(r.robot, r.store_id), r, layout.journal(r.robot, r.store_id, r.file))
        for r in rows
    ]
