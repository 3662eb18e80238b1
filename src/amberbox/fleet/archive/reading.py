"""The archive as the black box's queries see it: one catalogue per store, its files pruned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.query.catalogue import Catalogue as StoreCatalogue
from amberbox.blackbox.query.catalogue import boot_in, corrected, union
from amberbox.blackbox.query.clockbook import ClockBook, JournalClock, book_of
from amberbox.blackbox.query.gather import Request
from amberbox.blackbox.query.variables import closest
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.segments.manifest import Manifest, Segment
from amberbox.blackbox.segments.parquet import overlaps
from amberbox.core.errors import UsageError
from amberbox.fleet.archive.catalogue import COMMITTED, Catalogue, Source
from amberbox.fleet.archive.files import Layout, table_of
from amberbox.fleet.archive.journal import decode
from amberbox.fleet.archive.layout import stored_name
from amberbox.fleet.archive.log import LiveFile
from amberbox.fleet.archive.pyramid import level_schema
from amberbox.fleet.archive.segments import segment_at

Offsets = Mapping[int, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class Clocks:
    """What is known of a store's clocks, and by how much the log time of each run may be off."""

    book: ClockBook
    offsets: Offsets
    selection: Mapping[str, Sequence[str]]


@dataclass
class _Known:
    """What was read of an archive at one revision; a new commit makes a new one."""

    revision: int
    schemas: list[TableSchema]
    clocks: dict[Source, Clocks] = field(default_factory=dict)
    held: dict[Source, set[str]] = field(default_factory=dict)


_REMEMBERED: dict[Path, _Known] = {}


def _known(catalogue: Catalogue) -> _Known:
    path, revision = catalogue.database.path, catalogue.revision()
    found = _REMEMBERED.get(path)
    if found is None or found.revision != revision:
        found = _REMEMBERED[path] = _Known(revision, catalogue.schemas())
    return found


class Reader:
    """One look at the stores of some robots. ``files_read`` counts the files that were opened."""

    def __init__(self, layout: Layout, catalogue: Catalogue, sources: Sequence[Source]) -> None:
        self.layout = layout
        self.sources = sources
        self.files_read = 0
        self._catalogue = catalogue
        self._known = _known(catalogue)

    @cached_property
    def schemas(self) -> dict[str, list[TableSchema]]:
        """Return the versions of each table's schema, oldest first."""
        held = {name for source in self.sources for name in self.held(source)}
        found: dict[str, list[TableSchema]] = {}
        for schema in self._known.schemas:
            if schema.id in held:
                found.setdefault(schema.item, []).append(schema)
        return found

    def held(self, source: Source) -> set[str]:
        """Return the ids of the schemas that a store has rows of."""
        if source not in self._known.held:
            self._known.held[source] = self._catalogue.held(source)
        return self._known.held[source]

    def schema(self, table: str) -> TableSchema:
        """Return the union of a table's versions; raises UsageError for one that is not there."""
        by_case = {name.casefold(): name for name in reversed(self.schemas)}
        name = table if table in self.schemas else by_case.get(table.casefold())
        if name is None:
            hint = closest(table, sorted(self.schemas))
            raise UsageError(f"there is no data item {table!r}", hint)
        return union(self.schemas[name])

    @property
    def selection(self) -> Mapping[str, Sequence[str]]:
        """Return the variables configured for each item, the newest journal's word counting."""
        chosen: dict[str, Sequence[str]] = {}
        for source in self.sources:
            chosen.update(self.clocks(source).selection)
        return chosen

    def clocks(self, source: Source) -> Clocks:
        """Return what is known of a store's clocks by now."""
        if source not in self._known.clocks:
            rows = [row for row in self._catalogue.journals(source) if row.state == COMMITTED]
            self._known.clocks[source] = _clocks(rows)
        return self._known.clocks[source]

    def of(
        self, source: Source, *tables: str, request: Request | None = None, level: str = ""
    ) -> StoreCatalogue:
        """Return a store's catalogue of some tables, of all without a name.

        With ``request`` it has only the files that may hold rows of its range; ``level`` names
        one of the pyramid's.
        """
        clocks, held = self.clocks(source), self.held(source)
        schemas: dict[str, TableSchema] = {}
        segments: dict[str, tuple[Segment, ...]] = {}
        for table in tables or self.schemas:
            for schema in (s for s in self.schemas.get(table, ()) if s.id in held):
                kind = level_schema(schema, level) if level else schema
                schemas[kind.id] = kind
                found = tuple(self._segments(source, clocks, schema, request, level))
                segments[table] = (*segments.get(table, ()), *found)
        manifest = corrected(Manifest(schemas, segments), clocks.book)
        return StoreCatalogue(self.layout.tables, manifest, book=clocks.book, stored=stored_name)

    def files(
        self, source: Source, schema: TableSchema, request: Request | None, level: str = ""
    ) -> list[LiveFile]:
        """List the files of a table that may hold rows of a request."""
        table, clocks = table_of(schema, level), self.clocks(source)
        return [
            file
            for file in self.layout.snapshot(table).files.values()
            if (file.robot, file.low["store_id"]) == (source.robot, source.store_id)
            and (request is None or _may_hold(file, schema, request, clocks.offsets))
        ]

    def _segments(
        self, source: Source, clocks: Clocks, schema: TableSchema, request: Request | None,
        level: str,
    ) -> Iterator[Segment]:  # fmt: skip
        for file in self.files(source, schema, request, level):
            self.files_read += 1
            yield segment_at(self.layout.tables, f"{table_of(schema, level)}/{file.path}")


def _may_hold(file: LiveFile, schema: TableSchema, request: Request, offsets: Offsets) -> bool:
    """Judge a file by the bounds of its log times and by what is known of the clock now."""
    if request.by == "timestamp" and schema.stamp:
        return overlaps(file.low["timestamp"], file.high["timestamp"], request.span)
    known = [offsets[run] for run in range(file.low["run"], file.high["run"] + 1) if run in offsets]
    if not known:  # its batch is being committed right now
        return overlaps(file.low["received"], file.high["received"], request.span)
    least, most = min(low for low, _ in known), max(high for _, high in known)
    return overlaps(file.low["log_time"] + least, file.high["log_time"] + most, request.span)


def _clocks(rows: Sequence[Row[Any]]) -> Clocks:
    selection: dict[str, Sequence[str]] = {}
    clocks = []
    for row in rows:
        facts = decode(row.facts)
        clocks.append(JournalClock(row.file, boot_in(row.file), row.run, facts.readings))
        selection.update(facts.selection)
    book = book_of(clocks)
    offsets: dict[int, tuple[int, int]] = {}
    for clock in clocks:
        known = book.points(clock.name)
        points = known or tuple((r.log_ns, r.offset_ns) for r in clock.readings)
        low, high = ClockTable(points).bounds()
        least, most = offsets.get(clock.run, (low, high))
        offsets[clock.run] = min(low, least), max(high, most)
    return Clocks(book, offsets, selection)
