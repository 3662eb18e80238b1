"""The catalogue of a store at one instant: tables, their schemas, and the files of their rows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TypeVar

from amberbox.blackbox.columns.arrays import wider
from amberbox.blackbox.columns.flat_tables import TableSchema, tables_of
from amberbox.blackbox.columns.variables import item_named, suggest_names
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.batches import ItemStream
from amberbox.blackbox.store.clocks import (
    UNKNOWN_BOOT,
    ClockBook,
    ClockReading,
    ClockTable,
    JournalClock,
    book_of,
)
from amberbox.blackbox.store.journal_reader import KEPT_RAW, JournalFile, journal_file, with_columns
from amberbox.blackbox.store.manifest import Manifest
from amberbox.blackbox.store.manifest_entries import SealedJournal, Segment, SegmentPart
from amberbox.blackbox.store.segment_builder import selection_of
from amberbox.blackbox.store.segment_file import stored_name
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Column, Gap

_ATTEMPTS = 5
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class StoreCatalogue:
    """A snapshot of a store: its manifest and its journal files.

    ``with_segments`` is false where segments cannot be read (no pyarrow): then all rows are read
    from journals, as far as these still exist. ``stored`` maps a variable to its name in the
    segments.
    """

    store: Path
    manifest: Manifest
    with_segments: bool = True
    existing: tuple[str, ...] = ()
    book: ClockBook = field(default_factory=ClockBook)
    stored: Callable[[str], str] = stored_name
    opened: dict[str, JournalFile] = field(default_factory=dict, compare=False, repr=False)
    """Journals as they were found at first: one that grows is looked into once."""
    lasting: bool = False
    """Whether it is queried for a long time: then it also reads what is added to the store
    meanwhile.
    """

    def journals(self, skip: Container[str]) -> Iterator[JournalFile]:
        """Open the journal files that are not named in ``skip``, in the order of writing.

        Their clocks are corrected by all later readings.
        """
        for name in self.existing:
            if name not in skip:
                if name not in self.opened or (self.lasting and not self.opened[name].finished):
                    journal = journal_file(open_store(self.store).journal_path(name), name)
                    points = self.book.points(name)
                    self.opened[name] = (
                        journal if points is None else replace(journal, clock=points)
                    )
                yield self.opened[name]

    @property
    def done(self) -> Collection[str]:
        """Return the names of the journals whose rows are all in segments."""
        return self.manifest.journals.keys() if self.with_segments else ()

    @cached_property
    def columns_done(self) -> Collection[str]:
        """Return the names of the journals that need not be opened to know their columns.

        Others had messages without columns when their segments were built: they may have some now.
        """
        without_columns = (
            done.name
            for done in self.manifest.journals.values()
            if any(
                gap.item not in self.manifest.segments or gap.reason.startswith(KEPT_RAW)
                for gap in done.gaps
            )
        )
        return {*self.done} - {*without_columns}

    @cached_property
    def raw(self) -> dict[str, list[tuple[JournalFile, Gap]]]:
        """Return, by item, the journal files with messages of it that have no columns, and why."""
        found: dict[str, list[tuple[JournalFile, Gap]]] = {}
        for journal in self.journals(skip=self.columns_done):
            without_columns: list[Gap] = []
            with_columns(journal, without_columns.append)
            for gap in without_columns:
                found.setdefault(gap.item, []).append((journal, gap))
        return found

    @cached_property
    def schemas(self) -> dict[str, list[TableSchema]]:
        """Return the versions of each table's schema, oldest first."""
        return self._versions(None)

    def _versions(self, table: str | None) -> dict[str, list[TableSchema]]:
        """Return the versions of schemas: those of one table, not reading others, or all."""
        found: dict[str, list[TableSchema]] = {}
        tables = self.manifest.segments if table is None else (table,)
        for name in tables if self.with_segments else ():
            for segment in self.manifest.segments.get(name, ()):
                _add(found, self.manifest.schemas[segment.schema])
        for journal in self.journals(skip=self.columns_done):
            for schema in journal_tables(journal, table):
                _add(found, schema)
        return found

    def schema(self, table: str) -> TableSchema:
        """Return the union of a table's versions: every column, in its widest type.

        Raises UsageError for an unknown table.
        """
        known = self.schemas if "schemas" in self.__dict__ else self._versions(table)
        if known.get(table):
            return union(known[table])
        name = item_named(self.schemas, table)
        if name is None and table in self.raw:
            why = self.raw[table][-1][1].reason.partition(": ")[2]
            hint = (
                "its messages are kept as they came: "
                f"amberbox export WHERE --format mcap --item {table} -o FILE"
            )
            raise UsageError(f"{table} has no columns: {why}", hint)
        if name is None:
            raise UsageError(
                f"there is no data item {table!r}",
                suggest_names(table, sorted({*self.schemas, *self.raw})),
            )
        return union(self.schemas[name])

    def segments(self, table: str) -> Sequence[Segment]:
        """Return the segments to read for a table, in order."""
        if not self.with_segments:
            return ()
        complete = self.manifest.complete(table, self.existing)
        found = self.manifest.segments.get(table, ())
        return [s for s in found if all(part.journal in complete for part in s.parts)]

    def covered(self, table: str) -> frozenset[str]:
        """Return the journals that need not be read for a table."""
        if not self.with_segments:
            return frozenset()
        return self.manifest.complete(table, self.existing)

    @cached_property
    def selection(self) -> dict[str, Sequence[str]]:
        """Return the variables configured for each item, as in the newest journal."""
        chosen: dict[str, Sequence[str]] = {}
        for done in self.manifest.journals.values():
            chosen.update(done.selection)
        for journal in self.journals(skip=self.manifest.journals.keys()):
            chosen.update(selection_of(journal))
        return chosen

    def still_holds(self) -> bool:
        """Return whether no journal was deleted while its segments were read; the ring has no
        segments.
        """
        waiting = (
            name
            for name in self.existing
            if name not in self.manifest.journals and not name.startswith("ring/")
        )
        store = open_store(self.store)
        return all(store.journal_path(name).exists() for name in waiting)

    def without(self, segment: Segment) -> StoreCatalogue:
        """Return the same without a segment that turned out to be damaged."""
        return replace(self, manifest=_without(self.manifest, segment))


def _without(manifest: Manifest, segment: Segment) -> Manifest:
    rest = tuple(other for other in manifest.segments[segment.item] if other is not segment)
    return replace(manifest, segments={**manifest.segments, segment.item: rest})


def read_catalogue(store: Path, *, with_segments: bool = True) -> StoreCatalogue:
    """Read a store. Journals first: one deleted meanwhile is in the manifest already."""
    opened = open_store(store)
    existing = tuple(
        f"{path.parent.name}/{path.name}"
        for writer in opened.writers()
        for path in opened.journal_files(writer)
    )
    manifest = mf.read(store)
    found: dict[str, JournalFile] = {}
    book = book_of(_clocks(opened, manifest, existing, found))
    for name, journal in found.items():
        points = book.points(name)
        found[name] = journal if points is None else replace(journal, clock=points)
    known = corrected(manifest, book)
    return StoreCatalogue(store, known, with_segments, existing, book, opened=found)


def query_catalogue(
    store: Path, question: Callable[[StoreCatalogue], Answer], *, with_segments: bool = True
) -> Answer:
    """Return the answer from a store's catalogue; read it again when files change meanwhile."""
    for _ in range(_ATTEMPTS):
        catalogue = read_catalogue(store, with_segments=with_segments)
        try:
            answer = question(catalogue)
        except FileNotFoundError:
            continue
        if catalogue.still_holds():
            return answer
    raise AmberboxError(
        f"the files of {store} changed while they were being read",
        "ask again, for a shorter range if it is a long one",
    )


def _clocks(
    store: Store, manifest: Manifest, existing: Sequence[str], opened: dict[str, JournalFile]
) -> Iterator[JournalClock]:
    """Yield the clock readings of journals: from the manifest if sealed, else from the file.

    The files that are read are added to ``opened``.
    """
    for sealed in manifest.sealed.values():
        yield _sealed_clock(sealed)
    for name in existing:
        if name not in manifest.sealed:
            with suppress(FileNotFoundError):  # deleted meanwhile
                journal = opened[name] = journal_file(store.journal_path(name), name)
                yield JournalClock(name, boot_in(name), journal.run, journal.readings)


def _sealed_clock(sealed: SealedJournal) -> JournalClock:
    base_ns, last = sealed.boot_base_ns, len(sealed.clock) - 1
    readings = tuple(
        ClockReading(
            log_ns, offset_ns, sealed.synchronised if number == last else None,
            None if base_ns is None else log_ns - base_ns,
        )
        for number, (log_ns, offset_ns) in enumerate(sealed.clock)
    )  # fmt: skip
    return JournalClock(sealed.journal, boot_in(sealed.journal), sealed.run, readings)


def boot_in(journal: str) -> str:
    """Read from a journal's file name in which boot it was written."""
    parts = journal.rpartition("/")[2].split("-")
    return parts[1] if len(parts) == 3 else UNKNOWN_BOOT


def corrected(manifest: Manifest, book: ClockBook) -> Manifest:
    """Return the manifest with the clocks of its segments corrected by the present knowledge."""
    return replace(manifest, segments=_Corrected(manifest, book))


class _Corrected(Mapping[str, tuple[Segment, ...]]):
    """Segments by table with clocks as known now; computed for the tables that are read."""

    def __init__(self, manifest: Manifest, book: ClockBook) -> None:
        self._manifest, self._book = manifest, book
        self._done: dict[str, tuple[Segment, ...]] = {}

    def __getitem__(self, table: str) -> tuple[Segment, ...]:
        if table not in self._done:
            schemas, found = self._manifest.schemas, self._manifest.segments[table]
            self._done[table] = tuple(
                _corrected(segment, self._book, stamped=bool(schemas[segment.schema].stamp))
                for segment in found
            )
        return self._done[table]

    def __iter__(self) -> Iterator[str]:
        return iter(self._manifest.segments)

    def __len__(self) -> int:
        return len(self._manifest.segments)


def _corrected(segment: Segment, book: ClockBook, *, stamped: bool) -> Segment:
    if not any(part.journal in book.journals for part in segment.parts):
        return segment
    parts = tuple(_corrected_part(part, book, stamped=stamped) for part in segment.parts)
    return replace(segment, parts=parts)


def _corrected_part(part: SegmentPart, book: ClockBook, *, stamped: bool) -> SegmentPart:
    """Replace the clock of a part; rows without a stamp of their own are stamped by it."""
    points = book.points(part.journal)
    if points is None:
        return part
    if stamped:
        return replace(part, clock=points)
    first_ns, last_ns = ClockTable(points).span(part.from_ns, part.to_ns)
    return replace(part, clock=points, stamp_from_ns=first_ns, stamp_to_ns=last_ns)


def journal_tables(journal: JournalFile, table: str | None = None) -> Iterator[TableSchema]:
    """Yield the tables of a journal's items that have rows and columns, or only one of a name."""
    for stream in journal.streams.values():
        if stream.repeated or not journal.items.get(stream.item):
            continue
        if table is None:
            yield from stream_tables(stream)
        elif table == stream.item or table.startswith(f"{stream.item}__"):
            yield from (schema for schema in stream_tables(stream) if schema.item == table)


@lru_cache(maxsize=4096)
def stream_tables(stream: ItemStream) -> Sequence[TableSchema]:
    """Return the tables that a stream's messages make: its own first, then its children's."""
    try:
        schema = stream.unroller().schema
    except AmberboxError:  # a message type without columns: kept, not shown
        return ()
    return tables_of(stream.item, schema, stream.topic.name, stream.source)


def item_of(journal: JournalFile, table: str) -> str | None:
    """Return the item of a journal whose messages hold a table's rows."""
    tables = journal_tables(journal, table)
    return next((schema.parent or schema.item for schema in tables), None)


def _add(found: dict[str, list[TableSchema]], schema: TableSchema) -> None:
    versions = found.setdefault(schema.item, [])
    if schema not in versions:
        versions.append(schema)


def union(versions: Sequence[TableSchema]) -> TableSchema:
    """Join schema versions: columns by name, each in the widest type (int, float, string)."""
    columns: dict[str, Column] = {}
    for schema in versions:
        for column in schema.columns:
            known = columns.get(column.name)
            kind = wider(known.type, column.type) if known else column.type
            columns[column.name] = replace(column, type=kind)
    return replace(versions[-1], columns=tuple(columns.values()))
