"""The archive as queries read it: one catalogue per store, pruned files, rollups for long plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Row

from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema
from amberbox.blackbox.columns.variables import item_named, resolve_columns, suggest_names
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.catalogue import StoreCatalogue as StoreCatalogue
from amberbox.blackbox.store.catalogue import boot_in, corrected, union
from amberbox.blackbox.store.clocks import ClockBook, ClockTable, JournalClock, book_of
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.manifest import Manifest
from amberbox.blackbox.store.manifest_entries import Segment
from amberbox.blackbox.store.segment_file import overlaps
from amberbox.blackbox.store.table_reader import RowRequest, gather
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, ColumnData, IntArray, Ragged
from amberbox.server.archive.catalogue import COMMITTED, ArchiveCatalogue, RobotStore
from amberbox.server.archive.delta_files import (
    ArchiveLayout,
    LiveFile,
    segment_at,
    stored_name,
    table_of,
)
from amberbox.server.archive.rollups import LEVELS, is_plotted, level_schema
from amberbox.server.journals import decode

Offsets = Mapping[int, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class StoreClocks:
    """The clocks of a store, and the bounds of each run's log time error."""

    book: ClockBook
    offsets: Offsets
    selection: Mapping[str, Sequence[str]]


@dataclass
class _Known:
    """Cached data of an archive at one revision; each commit begins a new cache."""

    revision: int
    schemas: list[TableSchema]
    clocks: dict[RobotStore, StoreClocks] = field(default_factory=dict)
    held: dict[RobotStore, set[str]] = field(default_factory=dict)


_REMEMBERED: dict[Path, _Known] = {}


def _known(catalogue: ArchiveCatalogue) -> _Known:
    path, revision = catalogue.database.path, catalogue.revision()
    found = _REMEMBERED.get(path)
    if found is None or found.revision != revision:
        found = _REMEMBERED[path] = _Known(revision, catalogue.schemas())
    return found


class ArchiveReader:
    """A reader of the stores of some robots; ``files_read`` counts the files that were opened."""

    def __init__(
        self, layout: ArchiveLayout, catalogue: ArchiveCatalogue, sources: Sequence[RobotStore]
    ) -> None:
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

    def held(self, source: RobotStore) -> set[str]:
        """Return the ids of the schemas of which a store has rows."""
        if source not in self._known.held:
            self._known.held[source] = self._catalogue.held(source)
        return self._known.held[source]

    def schema(self, table: str) -> TableSchema:
        """Return the union of a table's versions; raises UsageError for an unknown table."""
        name = item_named(self.schemas, table)
        if name is None:
            hint = suggest_names(table, sorted(self.schemas))
            raise UsageError(f"there is no data item {table!r}", hint)
        return union(self.schemas[name])

    @property
    def selection(self) -> Mapping[str, Sequence[str]]:
        """Return the variables configured for each item, by the newest journal."""
        chosen: dict[str, Sequence[str]] = {}
        for source in self.sources:
            chosen.update(self.clocks(source).selection)
        return chosen

    def clocks(self, source: RobotStore) -> StoreClocks:
        """Return the present knowledge of a store's clocks."""
        if source not in self._known.clocks:
            rows = [row for row in self._catalogue.journals(source) if row.state == COMMITTED]
            self._known.clocks[source] = _clocks(rows)
        return self._known.clocks[source]

    def of(
        self, source: RobotStore, *tables: str, request: RowRequest | None = None, level: str = ""
    ) -> StoreCatalogue:
        """Return a store's catalogue of some tables; of all without a name.

        With ``request`` it has only the files that may hold rows of its range; ``level`` names a
        rollup level.
        """
        clocks, held = self.clocks(source), self.held(source)
        schemas: dict[str, TableSchema] = {}
        segments: dict[str, tuple[Segment, ...]] = {}
        for table in tables or self.schemas:
            for schema in (s for s in self.schemas.get(table, ()) if s.id in held):
                kind = level_schema(schema, level) if level else schema
                schemas[kind.id] = kind
                files = self.files(source, schema, request, level)
                self.files_read += len(files)
                folder = table_of(schema, level)
                found = [segment_at(self.layout.tables, f"{folder}/{file.path}") for file in files]
                segments[table] = (*segments.get(table, ()), *found)
        manifest = corrected(Manifest(schemas, segments), clocks.book)
        return StoreCatalogue(self.layout.tables, manifest, book=clocks.book, stored=stored_name)

    def with_journals(
        self, source: RobotStore, journals: Sequence[JournalFile], *tables: str
    ) -> StoreCatalogue:
        """Return a store's catalogue of some tables (see ``of``), with journals in no table yet."""
        store, book = self.of(source, *tables), self.clocks(source).book
        opened = {}
        for journal in journals:
            points = book.points(journal.name)
            opened[journal.name] = journal if points is None else replace(journal, clock=points)
        return replace(store, existing=tuple(opened), opened=opened)

    def files(
        self, source: RobotStore, schema: TableSchema, request: RowRequest | None, level: str = ""
    ) -> list[LiveFile]:
        """Return the files of a table that may hold rows of a request."""
        table, clocks = table_of(schema, level), self.clocks(source)
        return [
            file
            for file in self.layout.snapshot(table).files.values()
            if (file.robot, file.low["store_id"]) == (source.robot, source.store_id)
            and (request is None or _may_hold(file, schema, request, clocks.offsets))
        ]


def _may_hold(file: LiveFile, schema: TableSchema, request: RowRequest, offsets: Offsets) -> bool:
    """Return whether a file may hold rows of a request, by its log times and clock offsets."""
    if request.by == "timestamp" and schema.stamp:
        return overlaps(file.low["timestamp"], file.high["timestamp"], request.span)
    known = [offsets[run] for run in range(file.low["run"], file.high["run"] + 1) if run in offsets]
    if not known:  # its batch is being committed right now
        return overlaps(file.low["received"], file.high["received"], request.span)
    least, most = min(low for low, _ in known), max(high for _, high in known)
    return overlaps(file.low["log_time"] + least, file.high["log_time"] + most, request.span)


def _clocks(rows: Sequence[Row[Any]]) -> StoreClocks:
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
    return StoreClocks(book, offsets, selection)


Span = tuple[int | None, int | None]
"""From and to, in ns; None is open."""
_STATES = ("min", "max", "mean", "count")


def envelope(
    reader: ArchiveReader, item: str, variables: Sequence[str], span: Span, points: int
) -> Table:
    """Return least, greatest and mean values in about ``points`` buckets.

    See ``ArchiveRecord.envelope``. Raises UsageError for variables that are not numeric.
    """
    schema = reader.schema(item)
    columns = [wanted.column for wanted in resolve_columns(schema.columns, list(variables), item)]
    texts = [column.name for column in columns if not is_plotted(column)]
    if texts or points < 1:
        what = f"{texts[0]} is no number" if texts else "points must be 1 or more"
        raise UsageError(what, "an envelope has numbers only; query gives every row")
    from_ns, to_ns = _bounds(reader, schema.item, span)
    width_ns = max(-(-(to_ns - from_ns) // points), 1)
    level = next((n for n, w in reversed(LEVELS.items()) if w <= width_ns), "1s")
    names = [f"{column.name}:{state}" for column in columns for state in _STATES]
    # a bucket has the time of its first row, so the first bucket may begin before the range
    request = RowRequest(schema.item, names, (from_ns - LEVELS[level], to_ns))
    found = []
    for source in reader.sources:
        store = reader.of(source, schema.item, request=request, level=level)
        for piece in gather(store, request).pieces:  # buckets are cut by log time
            ends_ns = piece.received_ns + LEVELS[level] - piece.log_time_ns % LEVELS[level]
            found.append((source.robot, piece.take(np.flatnonzero(ends_ns > from_ns))))
    width_ns = max(width_ns, LEVELS[level])
    return _table(schema.item, columns, found, from_ns, width_ns)


def _bounds(reader: ArchiveReader, item: str, span: Span) -> tuple[int, int]:
    """Return the range, with open ends replaced by those of the record."""
    from_ns, to_ns = span
    if from_ns is not None and to_ns is not None:
        return from_ns, to_ns
    files = [
        file
        for source in reader.sources
        for schema in reader.schemas[item]
        for file in reader.files(source, schema, None)
    ]
    low = min((file.low["received"] for file in files), default=0)
    high = max((file.high["received"] for file in files), default=0) + 1
    return low if from_ns is None else from_ns, high if to_ns is None else to_ns


def _table(
    item: str,
    columns: Sequence[Column],
    found: Sequence[tuple[str, FlatTable]],
    from_ns: int,
    width_ns: int,
) -> Table:
    """Aggregate rows of a level into buckets, robot by robot."""
    robots = sorted({robot for robot, _ in found})
    parts = [
        np.maximum(p.received_ns - from_ns, 0) // width_ns * len(robots) + robots.index(robot)
        for robot, p in found
    ]
    keys = np.concatenate(parts) if parts else np.empty(0, np.int64)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    firsts = np.flatnonzero(np.concatenate(([True], keys[1:] != keys[:-1]))) if len(keys) else keys
    steps = keys[firsts] // max(len(robots), 1)
    out: dict[str, ColumnData] = {"timestamp": from_ns + steps * width_ns}
    fields = [Column("timestamp", "timestamp", "time")]
    if len(robots) > 1:
        fields.append(Column("robot", "robot", "string"))
        out["robot"] = np.array(robots, object)[keys[firsts] % len(robots)]
    for column in columns:
        names = [f"{column.name}:{state}" for state in _STATES]
        lines = ([_values(piece, name) for _, piece in found] for name in names)
        four = [np.concatenate(line or [keys])[order] for line in lines]
        for name, line in zip(names, _states(four, firsts), strict=True):
            kind = "int64" if name.endswith(":count") else "float64"
            fields.append(replace(column, name=name, type=kind))
            out[name] = line
    return Table(item, tuple(fields), out)


def _values(piece: FlatTable, name: str) -> NDArray[Any]:
    """Return a column of a level; zero counts or NaN where this schema version lacks it."""
    known = piece.columns.get(name)
    if known is None:
        return np.zeros(len(piece)) if name.endswith(":count") else np.full(len(piece), np.nan)
    assert not isinstance(known, Ragged)  # levels have numbers only
    return known


def _states(four: Sequence[NDArray[Any]], firsts: IntArray) -> list[ColumnData]:
    low, high, mean, count = (np.asarray(line, np.float64) for line in four)
    if not len(firsts):
        return [low, high, mean, count.astype(np.int64)]
    total = np.add.reduceat(np.where(count > 0, mean * count, 0.0), firsts)
    number = np.add.reduceat(count, firsts)
    middle = np.full(len(firsts), np.nan)
    np.divide(total, number, out=middle, where=number > 0)
    return [
        np.fmin.reduceat(low, firsts), np.fmax.reduceat(high, firsts), middle,
        number.astype(np.int64),
    ]  # fmt: skip
