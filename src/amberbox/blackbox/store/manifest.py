"""The manifest: which segment holds which rows of which journal; append-only, hash-chained.

Unreadable lines are restored from segments' own metadata and from journals. A reader does so in
memory and writes nothing; the maintenance process writes them (``restore``). ``confirm`` records
which journals a server has verified and stored; ``condense`` rewrites a large manifest with only
the current entries, on the same chain.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store import manifest_lines
from amberbox.blackbox.store import store as store_store
from amberbox.blackbox.store.clocks import simplified
from amberbox.blackbox.store.manifest_entries import (
    ManifestSignature,
    SealedJournal,
    Segment,
    SegmentPart,
    Tombstone,
    confirmed_record,
    from_record,
    is_inside,
    part_clock,
    to_record,
    unconfirmed_record,
)
from amberbox.blackbox.store.manifest_lines import GrowingLines
from amberbox.blackbox.store.store import Store, WriterLock
from amberbox.core.errors import UsageError
from amberbox.core.files import sync_folder
from amberbox.core.types import Gap

NAME = "manifest"
# Errors of reading a damaged segment: its footer has no checksum of its own
UNREADABLE = (
    OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError,
    MemoryError, msgspec.MsgspecError,
)  # fmt: skip
# Held by the thread that appends to the manifest or deletes what it names
CHANGING = threading.RLock()


@dataclass(frozen=True, slots=True)
class ManifestJournal:
    """A journal whose rows are all in segments, but those in ``gaps``.

    ``start_ns`` and ``end_ns`` are when its first and last record were received;
    ``selection`` are the variables configured for its items.
    """

    name: str
    head: str
    writer: str
    run: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    gaps: tuple[Gap, ...] = ()
    selection: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Manifest:
    """The content of the manifest.

    ``columns_gone`` and ``raw_gone`` name the journals whose columns or raw data were deleted, as
    far as the manifest has not been condensed since; ``gone_segments`` are files deleted in this
    way. ``incidents`` is the last entry of each; ``lines`` is their number. ``unsigned`` are the
    journals that were sealed after the last signature; ``unconfirmed`` those that a server had
    confirmed but lacks now. ``names`` are the items' names by source and topic. ``damage`` names
    lines that cannot be read, ``mended`` those with one flipped bit, ``restored`` the damage that
    later lines repair. ``lost`` are listed segments that cannot be used, as far as that is known
    without opening them.
    """

    schemas: Mapping[str, TableSchema] = field(default_factory=dict)
    segments: Mapping[str, tuple[Segment, ...]] = field(default_factory=dict)
    journals: Mapping[str, ManifestJournal] = field(default_factory=dict)
    sealed: Mapping[str, SealedJournal] = field(default_factory=dict)
    tombstones: tuple[Tombstone, ...] = ()
    confirmed: frozenset[str] = frozenset()
    signatures: tuple[ManifestSignature, ...] = ()
    damage: tuple[str, ...] = ()
    last_hash: str = manifest_lines.FIRST_HASH
    columns_gone: frozenset[str] = frozenset()
    raw_gone: frozenset[str] = frozenset()
    gone_segments: frozenset[str] = frozenset()
    lines: int = 0
    incidents: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    unsigned: frozenset[str] = frozenset()
    unconfirmed: frozenset[str] = frozenset()
    names: Mapping[str, str] = field(default_factory=dict)
    mended: tuple[str, ...] = ()
    restored: frozenset[str] = frozenset()
    lost: tuple[Segment, ...] = ()

    @property
    def open_damage(self) -> tuple[str, ...]:
        """Return the damage that no later line makes up for; a torn end is none."""
        found = (d for d in self.damage if d not in self.restored)
        return tuple(d for d in found if not d.endswith(manifest_lines.TORN))

    def complete(self, item: str, existing: Container[str] | None = None) -> frozenset[str]:
        """Return the journals whose rows of this item are all in segments.

        Journals that are not among the ``existing`` ones always count: their rows can only be in
        segments.
        """
        found = self.segments.get(item, ())
        count = Counter(part.journal for segment in found for part in segment.parts)
        return frozenset(
            part.journal
            for segment in found
            for part in segment.parts
            if len(segment.parts) > 1
            or count[part.journal] >= part.files
            or (existing is not None and part.journal not in existing)
        )


def is_kept(schema: TableSchema) -> bool:
    """Return whether a table stays when the data around it go: events, gaps, runs, statuses."""
    return schema.source == channels.SOURCE and schema.topic != channels.COUNTERS


@dataclass(slots=True)
class _State:
    """The state after the lines read so far."""

    schemas: dict[str, TableSchema] = field(default_factory=dict)
    live: dict[str, Segment] = field(default_factory=dict)
    paths_of: dict[str, set[str]] = field(default_factory=dict)
    journals: dict[str, ManifestJournal] = field(default_factory=dict)
    sealed: dict[str, SealedJournal] = field(default_factory=dict)
    tombstones: list[Tombstone] = field(default_factory=list)
    confirmed: set[str] = field(default_factory=set)
    signatures: list[ManifestSignature] = field(default_factory=list)
    columns_gone: set[str] = field(default_factory=set)
    raw_gone: set[str] = field(default_factory=set)
    gone_segments: set[str] = field(default_factory=set)
    incidents: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    unsigned: set[str] = field(default_factory=set)
    unconfirmed: set[str] = field(default_factory=set)
    names: dict[str, str] = field(default_factory=dict)
    restored: set[str] = field(default_factory=set)

    def take(self, record: Mapping[str, Any]) -> None:
        """Add one record."""
        match record["kind"]:
            case "segment":
                self._take_segment(record)
            case "schema":
                self.schemas[str(record["id"])] = TableSchema.from_json(record["schema"])
            case "journal":
                fields = {name: record[name] for name in (*_JOURNAL_FIELDS, "gaps")}
                journal = msgspec.convert({"name": record["journal"], **fields}, ManifestJournal)
                self.journals[journal.name] = journal
            case "confirmed":
                self.confirmed.update(_names(record["journals"]))
                self.unconfirmed.difference_update(_names(record["journals"]))
            case "unconfirmed":
                self.confirmed.difference_update(_names(record["journals"]))
                self.unconfirmed.update(_names(record["journals"]))
            case "incident":
                entered = {k: v for k, v in record.items() if k not in ("hash", "prev")}
                self.incidents[str(record["incident"]["id"])] = entered
            case "names":
                self.names.update(msgspec.convert(record["names"], dict[str, str]))
            case "restored":
                self._take_restored(msgspec.convert(record, RestoredLines))
            case manifest_lines.CHECKPOINT:
                self.columns_gone.update(_names(record["columns_gone"]))
            case _:
                self._take_entry(from_record(record))

    def _take_segment(self, record: Mapping[str, Any]) -> None:
        segment = Segment.from_json(record["segment"])
        for path in _names(record.get("replaces", ())):
            self.live.pop(path, None)
        self.live[segment.path] = segment
        self.gone_segments.discard(segment.path)
        for part in segment.parts:
            self.paths_of.setdefault(part.journal, set()).add(segment.path)

    def _take_restored(self, restored: RestoredLines) -> None:
        self.restored.update(restored.damage)
        for name in restored.undone:
            self.journals.pop(name, None)
        for path in restored.gone:
            self.live.pop(path, None)

    def _take_entry(self, entry: SealedJournal | Tombstone | ManifestSignature | None) -> None:
        if isinstance(entry, SealedJournal):
            self.sealed[entry.journal] = entry
            self.unsigned.add(entry.journal)
        elif isinstance(entry, ManifestSignature):
            self.signatures.append(entry)
            self.unsigned.clear()
        elif isinstance(entry, Tombstone):
            if not (entry.journals and all(map(is_inside, entry.journals))):
                raise ValueError("a tombstone of nothing in the store")
            self.tombstones.append(entry)
            if entry.what != "columns":
                self.raw_gone.update(entry.journals)
            if entry.what != "raw":
                # A segment is deleted with the last of its journals, unless its table is kept.
                self.columns_gone.update(entry.journals)
                for name in entry.journals:
                    self.journals.pop(name, None)
                    for path in self.paths_of.pop(name, ()):
                        segment = self.live.get(path)
                        if segment is not None and self._is_over(segment):
                            del self.live[path]
                            self.gone_segments.add(path)

    def _is_over(self, segment: Segment) -> bool:
        gone = all(part.journal in self.columns_gone for part in segment.parts)
        schema = self.schemas.get(segment.schema)
        return gone and not (schema is not None and is_kept(schema))

    def result(self, read: manifest_lines.LineReader) -> Manifest:
        """Return a snapshot that later records do not change."""
        return Manifest(
            dict(self.schemas), by_item(self.live.values()), dict(self.journals),
            dict(self.sealed), tuple(self.tombstones),
            frozenset(self.confirmed), tuple(self.signatures), tuple(read.damage), read.last_hash,
            frozenset(self.columns_gone), frozenset(self.raw_gone), frozenset(self.gone_segments),
            read.number, dict(self.incidents), frozenset(self.unsigned),
            frozenset(self.unconfirmed), dict(self.names), tuple(read.mended),
            frozenset(self.restored),
        )  # fmt: skip


class _Reader:
    """Reads one store's manifest, and restores it once for each state of its lines."""

    def __init__(self, store: Path) -> None:
        self.lines: GrowingLines[Manifest] = GrowingLines(store / NAME, _State)
        self._store = store
        self._last: tuple[Manifest, Manifest] | None = None

    def read(self) -> Manifest:
        known, last = self.lines.read(), self._last
        if last is None or last[0] is not known:
            self._last = last = known, restored(self._store, known)
        return last[1]


@lru_cache(maxsize=8)
def _reader(store: Path) -> _Reader:
    return _Reader(store)


def read(store: Path) -> Manifest:
    """Read a store's manifest; lines that do not hold are named in ``damage``.

    Their content is restored in memory, as far as segments and journals allow.
    """
    return _reader(store).read()


def why(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def is_listed(store: Path, segment: Segment) -> bool:
    """Return whether the manifest lists a segment now."""
    return any(s.path == segment.path for s in read(store).segments.get(segment.item, ()))


def read_lines(store: Path) -> Manifest:
    """Read a store's manifest from its lines only, without restoring."""
    return _reader(store).lines.read()


def by_item(segments: Iterable[Segment]) -> dict[str, tuple[Segment, ...]]:
    grouped: dict[str, list[Segment]] = {}
    for segment in segments:
        grouped.setdefault(segment.item, []).append(segment)
    return {item: tuple(found) for item, found in grouped.items()}


def segment_record(segment: Segment, replaces: Sequence[str] = ()) -> dict[str, Any]:
    """Return the line that lists a segment, in place of others that may be removed afterwards."""
    record = {"kind": "segment", "segment": segment.to_json()}
    return {**record, "replaces": list(replaces)} if replaces else record


def schema_record(schema: TableSchema) -> dict[str, Any]:
    """Return the line of a schema that segments refer to."""
    return {"kind": "schema", "id": schema.id, "schema": schema.to_json()}


def journal_record(journal: ManifestJournal) -> dict[str, Any]:
    """Return the line of a journal whose rows are all in segments."""
    gaps = [{name: getattr(gap, name) for name in _GAP_FIELDS} for gap in journal.gaps]
    fields = {name: getattr(journal, name) for name in _JOURNAL_FIELDS}
    return {"kind": "journal", "journal": journal.name, **fields, "gaps": gaps}


_JOURNAL_FIELDS = (
    "head", "writer", "run", "first_seq", "end_seq", "start_ns", "end_ns", "selection",
)  # fmt: skip
_GAP_FIELDS = (
    "writer", "run", "from_ns", "to_ns", "reason", "item", "count", "from_seq", "to_seq",
)  # fmt: skip


def _names(value: object) -> tuple[str, ...]:
    return msgspec.convert(value, tuple[str, ...])


@dataclass(frozen=True, slots=True)
class RestoredLines:
    """The findings of the maintenance process on damaged lines of the manifest.

    ``damage`` names the lines, ``undone`` the journals that have to be processed again, ``gone``
    the listed segments without a file. The lines after it repeat the lost contents.
    """

    damage: tuple[str, ...] = ()
    undone: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()


def restored_record(restored: RestoredLines) -> dict[str, Any]:
    """Return the line that marks damaged lines as restored."""
    return {"kind": "restored", **asdict(restored)}


def names_record(names: Mapping[str, str]) -> dict[str, Any]:
    """Return the line of the item names of sources' topics."""
    return {"kind": "names", "names": dict(names)}


def append(store: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Append records in one write and make them durable. Only ``keep`` calls this.

    Raises OSError when writing fails: the manifest is then unchanged.
    """
    with CHANGING:
        content = manifest_lines.encode(records, read(store).last_hash)
        manifest_lines.append_durably(store / NAME, content)


def rewrite(
    store: Path, records: Sequence[Mapping[str, Any]], last_hash: str = manifest_lines.FIRST_HASH
) -> None:
    """Write a new, condensed manifest."""
    temporary = store / f".{NAME}.tmp"
    temporary.unlink(missing_ok=True)
    manifest_lines.append_durably(temporary, manifest_lines.encode(records, last_hash))
    temporary.rename(store / NAME)
    sync_folder(store)


FOLDER = "segments"
_MOST_NAMED = 5

Described = tuple[TableSchema, Segment]
Key = tuple[str, str, str]  # names rows of a segment: those of one table, version and journal


def restored(store: Path, known: Manifest) -> Manifest:
    """Return a manifest with the content of its damaged lines restored, as far as possible."""
    return known if _is_whole(store, known) else _find(store, known).manifest


def restore(store: Path) -> list[str]:
    """Repair the manifest on the disk; return its damage as texts. Only the keeper calls this.

    A line with one flipped bit is repaired. Unreadable lines stay in place, and their content
    follows at the end. Raises OSError when writing fails.
    """
    with CHANGING:
        texts = _mend(store)
        known = read_lines(store)
        # segments whose file is gone or was cut although a journal still holds their rows
        listed = (s for segments in known.segments.values() for s in segments)
        gone = [
            s for s in listed
            if not has_size(store, s) and any((store / part.journal).exists() for part in s.parts)
        ]  # fmt: skip
        if _is_whole(store, known) and not gone:
            return texts
        found = _find(store, known)
        made_up = RestoredLines(_damage(known), tuple(found.undone), tuple(found.replaced))
        records = [restored_record(made_up), *found.records()]
        if made_up != RestoredLines() or len(records) > 1:
            append(store, records)
        missing = [f"{segment.path} is gone or was cut" for segment in gone]
        unlisted = [
            f"no line told of {segment.path}"
            for segment in found.adopted
            if segment not in found.manifest.lost
        ]
        return [*texts, *_damage(known), *missing, *unlisted]


def notes(store: Path) -> list[str]:
    """Return texts on the damage of a store's manifest and the loss for readers."""
    known = read(store)
    unlisted = _paths(known) - _paths(read_lines(store))
    found = [*known.mended, *known.open_damage]
    if not (found or unlisted or known.lost):
        return []
    what = in_short(found) or f"{len(unlisted)} segments are in none of its lines"
    text = f"{NAME} is damaged ({what}): segments and journals make up for it"
    lost = [f"{len(known.lost)} segments that it lists cannot be used"] if known.lost else []
    return [text, *lost]


def _paths(known: Manifest) -> set[str]:
    return {segment.path for found in known.segments.values() for segment in found}


def in_short(texts: Sequence[str]) -> str:
    """Join texts in one line; of very many the first ones."""
    more = len(texts) - _MOST_NAMED
    return "; ".join(texts[:_MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _damage(known: Manifest) -> tuple[str, ...]:
    """Return the damaged lines as texts; of an empty manifest all are."""
    return known.open_damage or (() if known.lines else (f"{NAME}: there is none",))


def _is_whole(store: Path, known: Manifest) -> bool:
    """Return whether every line can be read, has its schema, and every file has its line."""
    used = {segment.schema for found in known.segments.values() for segment in found}
    if known.open_damage or not used <= known.schemas.keys():
        return False
    texts = _paths(known) | known.gone_segments
    return all(path in texts for path in _files(store))


def _files(store: Path) -> Iterator[str]:
    """Yield the names of the segments on the disk; there may be tens of thousands."""
    try:
        folders = [entry.name for entry in os.scandir(store / FOLDER) if entry.is_dir()]
    except OSError:
        return
    for folder in folders:
        with suppress(OSError):  # its last segment was deleted meanwhile
            for entry in os.scandir(store / FOLDER / folder):
                if entry.name.endswith(".parquet"):
                    yield f"{FOLDER}/{folder}/{entry.name}"


def _mend(store: Path) -> list[str]:
    """Repair the lines with one flipped bit; return the repairs as texts."""
    if not read_lines(store).mended:
        return []
    path, temporary = store / NAME, store / f".{NAME}.tmp"
    content = bytearray(path.read_bytes())
    texts = []
    for line in reversed(list(manifest_lines.split(bytes(content)))):
        if line.mended:
            end = line.offset + line.size - 1
            content[line.offset : end] = line.mended
            texts.append(f"{NAME} line {line.number}: one bit was flipped")
    temporary.unlink(missing_ok=True)
    manifest_lines.append_durably(temporary, bytes(content))
    temporary.rename(path)
    sync_folder(store)
    return texts[::-1]


@dataclass(frozen=True, slots=True)
class _Found:
    """The restored manifest, and how it differs from its lines.

    ``undone`` are journals to be processed again, ``replaced`` segments that are listed and not
    needed.
    """

    manifest: Manifest
    schemas: Sequence[TableSchema]
    adopted: Sequence[Segment]
    journals: Sequence[ManifestJournal]
    undone: Sequence[str]
    replaced: Sequence[str]

    def records(self) -> Iterator[Mapping[str, Any]]:
        """Yield the lines that repeat the lost contents."""
        yield from (schema_record(schema) for schema in self.schemas)
        yield from (segment_record(segment) for segment in self.adopted)
        yield from (journal_record(journal) for journal in self.journals)


def _find(store: Path, known: Manifest) -> _Found:
    """Compare the lines with the files; nothing is adopted whose journal still exists."""
    segments = {s.path: s for found in known.segments.values() for s in found}
    schemas = dict(known.schemas)
    live = [s for s in segments.values() if _is_there(store, s, schemas)]
    adopted = _adopted(store, known, live, schemas)
    rows_of = {*_keys(live), *_keys(adopted)}
    usable = {segment.path for segment in live}
    absent = [s for path, s in segments.items() if path not in usable]
    needed = [lost for s in absent if (lost := _lost(store, s, rows_of)) is not None]
    kept = [*live, *adopted]
    here = {name for name in known.journals if (store / name).exists()}
    if _damage(known):  # of a journal that left only events and the like, the tombstone is lost
        data = [s for s in (*kept, *needed) if s.schema in schemas]
        data = [s for s in data if not is_kept(schemas[s.schema])]
        undone = sorted(here | (known.journals.keys() - _journals(data)))
    else:
        undone = sorted(here & _journals(absent))
    journals = {n: j for n, j in known.journals.items() if n not in undone}
    entered = {*journals, *known.columns_gone, *_journals(needed), *undone}
    more = [
        journal
        for journal in journals_of(kept, known)
        if journal.name not in entered and not (store / journal.name).exists()
    ]
    journals |= {journal.name: journal for journal in more}
    manifest = replace(
        known, schemas=schemas, segments=by_item(kept), journals=journals, lost=tuple(needed)
    )
    new = [schema for name, schema in schemas.items() if name not in known.schemas]
    still = {segment.path for segment in needed}
    trimmed = [s for s in needed if s != segments[s.path]]
    replaced = sorted(s.path for s in absent if s.path not in still)
    return _Found(manifest, new, [*adopted, *trimmed], more, undone, replaced)


def _lost(store: Path, segment: Segment, rows_of: Collection[Key]) -> Segment | None:
    """Return the part of a segment that no journal and no other segment holds; None if none."""
    parts = tuple(
        part
        for part in segment.parts
        if (segment.item, segment.schema, part.journal) not in rows_of
        and not (store / part.journal).exists()
    )
    return replace(segment, parts=parts) if parts else None


def has_size(store: Path, segment: Segment) -> bool:
    """Return whether a segment's file exists with the number of bytes that were written."""
    try:
        return (store / segment.path).stat().st_size == segment.bytes
    except OSError:
        return False


def _has_raw(store: Path, segment: Segment) -> bool:
    """Return whether all journals of a segment still exist."""
    return all((store / part.journal).exists() for part in segment.parts)


def _is_there(store: Path, segment: Segment, schemas: dict[str, TableSchema]) -> bool:
    """Return whether a listed segment can be used; a schema whose line was lost is added."""
    if not has_size(store, segment):
        return False
    if segment.schema not in schemas:
        described = _described(store, segment.path)
        if described is None or described[0].id != segment.schema:
            return False
        schemas[segment.schema] = described[0]
    return True


def _described(store: Path, path: str) -> Described | None:
    """Read a segment's own metadata, and all of its pages; None if that is not possible."""
    from amberbox.blackbox.store.segment_file import can_build, outline, read_segment

    if not can_build():
        return None

    try:
        schema, segment = outline(store, path)
        read_segment(store, segment, schema, [column.name for column in schema.columns])
        with (store / path).open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    except UNREADABLE:
        return None
    return schema, replace(segment, sha256=sha256)


def _adopted(
    store: Path,
    known: Manifest,
    live: Sequence[Segment],
    schemas: dict[str, TableSchema],
) -> list[Segment]:
    """Return segments that no line lists and whose rows are nowhere else; add their schemas."""
    listed = {segment.path for segment in live} | known.gone_segments
    paths = [path for path in _files(store) if path not in listed]
    found = [_described(store, path) for path in sorted(paths)]
    taken = set(_keys(live))
    adopted = []
    for schema, segment in sorted((d for d in found if d), key=lambda d: -len(d[1].parts)):
        over = _journals([segment]) <= known.columns_gone and not is_kept(schema)
        if over or _has_raw(store, segment) or not taken.isdisjoint(_keys([segment])):
            continue
        taken |= _keys([segment])
        schemas.setdefault(schema.id, schema)
        adopted.append(segment)
    return adopted


def _journals(segments: Iterable[Segment]) -> set[str]:
    return {part.journal for segment in segments for part in segment.parts}


def _keys(segments: Iterable[Segment]) -> set[Key]:
    """Return the keys of the rows of segments."""
    return {(s.item, s.schema, part.journal) for s in segments for part in s.parts}


def journals_of(segments: Collection[Segment], known: Manifest) -> list[ManifestJournal]:
    """Derive the journals and their ends from segments and seals."""
    parts: dict[str, list[SegmentPart]] = {}
    for part in (part for segment in segments for part in segment.parts):
        parts.setdefault(part.journal, []).append(part)
    return [_journal(name, found, known) for name, found in parts.items()]


def _journal(name: str, parts: Sequence[SegmentPart], known: Manifest) -> ManifestJournal:
    sealed, part = known.sealed.get(name), parts[0]
    if sealed is not None:
        return ManifestJournal(
            name, sealed.chain, sealed.writer, sealed.run, sealed.first_seq, sealed.end_seq,
            sealed.start_ns, sealed.end_ns,
        )  # fmt: skip
    return ManifestJournal(
        name, part.head, part.writer, part.run,
        min(part.first_seq for part in parts), 1 + max(part.last_seq for part in parts),
        min(part.from_ns for part in parts), max(part.to_ns for part in parts),
    )  # fmt: skip


KIND, UNCONFIRM = "confirm", "unconfirm"


def confirm(store: Store, journals: Sequence[str], by: str) -> None:
    """Enter journals (``folder/file``) as held by the server ``by``.

    A running maintenance process gets a request to do it; else it is done at once.
    """
    _have_entered(store, KIND, journals, by)


def unconfirm(store: Store, journals: Sequence[str], by: str) -> None:
    """Record that the server ``by`` lacks journals that were confirmed, such as after a restore.

    They are then deleted no earlier than others, and are copied again.
    """
    _have_entered(store, UNCONFIRM, journals, by)


def _have_entered(store: Store, kind: str, journals: Sequence[str], by: str) -> None:
    try:
        lock = WriterLock(store, "keeper")
    except UsageError:
        store_store.submit(store, kind, {"journals": list(journals), "by": by})
        return
    try:
        _enter(store, kind, journals, by)
    finally:
        lock.release()


def _enter(store: Store, kind: str, journals: Sequence[str], by: str) -> None:
    """Append the new entries to the manifest; the caller holds the maintenance lock."""
    known = read(store.path).confirmed
    news = tuple(name for name in journals if (name in known) != (kind == KIND))
    if news:
        record = confirmed_record if kind == KIND else unconfirmed_record
        append(store.path, [record(news, by, time.time_ns())])


def take_confirmations(store: Store) -> None:
    """Carry out other processes' requests for entries, in their order."""
    for request in store_store.pending(store):
        if request.kind in (KIND, UNCONFIRM):
            names = [str(name) for name in request.values.get("journals", ())]
            _enter(store, request.kind, names, str(request.values.get("by", "")))
            store_store.finish(request)


LARGE_BYTES = 4_000_000
_WORTH = 3

ManifestRecord = Mapping[str, Any]
# Makes the line that signs a head, None where there is no key
SignHead = Callable[[str], ManifestRecord | None]


def condense(
    store: Path, exists: Callable[[str], bool], sign: SignHead, large_bytes: int = LARGE_BYTES
) -> bool:
    """Rewrite a large manifest if that makes it a third or less; return whether it was done.

    ``exists`` returns whether a journal still exists. The first line is a checkpoint that continues
    from the old one's last hash, the second the signature of that hash.
    """
    path = store / NAME
    size = path.stat().st_size if path.exists() else 0
    if size <= large_bytes:
        return False
    with CHANGING:
        return _condense(store, exists, sign, size)


def _condense(store: Path, exists: Callable[[str], bool], sign: SignHead, size: int) -> bool:
    known = read(store)
    if known.lines < _WORTH * _live_lines(known):
        return False
    records = [*_beginning(known, exists, sign), *live_records(known, exists)]
    if _WORTH * len(manifest_lines.encode(records, known.last_hash)) > size:
        return False
    rewrite(store, records, known.last_hash)
    return True


def _live_lines(known: Manifest) -> int:
    """Return about how many lines would be left; cheap, since it is called often."""
    segments = sum(map(len, known.segments.values()))
    others = (known.journals, known.sealed, known.schemas, known.incidents)
    return segments + sum(map(len, others))


def _beginning(
    known: Manifest, exists: Callable[[str], bool], sign: SignHead
) -> Iterator[ManifestRecord]:
    found = known.segments.values()
    named = {part.journal for segments in found for s in segments for part in s.parts}
    still = sorted(n for n in known.columns_gone if n in named or exists(n))
    yield {"kind": manifest_lines.CHECKPOINT, "columns_gone": still, "damage": list(known.damage)}
    signature = sign(known.last_hash)
    if signature is not None:
        yield signature


def live_records(known: Manifest, exists: Callable[[str], bool]) -> Iterator[ManifestRecord]:
    """Yield records equivalent to all lines of a manifest."""
    listed = [segment for found in known.segments.values() for segment in found]
    segments = [*listed, *known.lost]
    used = {segment.schema for segment in segments}
    for name, schema in known.schemas.items():
        if name in used:
            yield schema_record(schema)
    for segment in segments:
        yield segment_record(_coalesced(segment, known, exists))
    yield from kept_records(known, exists)


def kept_records(known: Manifest, exists: Callable[[str], bool]) -> Iterator[ManifestRecord]:
    """Yield the records of journals and incidents: done, sealed, deleted, confirmed, signed."""
    alive = {name for name in known.sealed if exists(name) or name not in known.columns_gone}
    for sealed in known.sealed.values():
        if sealed.journal in alive:
            yield to_record(sealed)
    if known.names:
        yield names_record(known.names)
    for journal in known.journals.values():
        yield journal_record(journal)
    for tombstone in joined(known.tombstones):
        yield to_record(tombstone)
    yield from known.incidents.values()
    confirmed = tuple(sorted(n for n in known.confirmed if exists(n) or n in known.journals))
    if confirmed:
        yield confirmed_record(confirmed, "", 0)
    unconfirmed = tuple(sorted(filter(exists, known.unconfirmed)))
    if unconfirmed:
        yield unconfirmed_record(unconfirmed, "", 0)
    for signature in known.signatures[-1:]:
        yield to_record(signature)


def joined(tombstones: Iterable[Tombstone]) -> list[Tombstone]:
    """Join the tombstones of neighbouring journals that were deleted for the same reason."""
    found: list[Tombstone] = []
    for tombstone in sorted(tombstones, key=_order):
        if found and _neighbours(found[-1], tombstone):
            first = found[-1]
            names = (*first.journals, *tombstone.journals)
            found[-1] = replace(
                tombstone,
                journals=(names[0], names[-1]),
                first_seq=first.first_seq,
                start_ns=min(first.start_ns, tombstone.start_ns),
                end_ns=max(first.end_ns, tombstone.end_ns),
                at_ns=max(first.at_ns, tombstone.at_ns),
            )
        else:
            found.append(tombstone)
    return found


def _order(tombstone: Tombstone) -> tuple[Any, ...]:
    return (*_kind(tombstone), tombstone.first_seq, tombstone.end_seq)


def _kind(tombstone: Tombstone) -> tuple[Any, ...]:
    t = tombstone
    return t.writer, t.run, t.what, t.reason, t.confirmed


def _neighbours(first: Tombstone, second: Tombstone) -> bool:
    return _kind(first) == _kind(second) and first.end_seq == second.first_seq


def _coalesced(segment: Segment, known: Manifest, exists: Callable[[str], bool]) -> Segment:
    """Return a segment with its parts of deleted journals joined, named like the last."""
    parts: list[SegmentPart] = []
    for part in segment.parts:
        gone = part.journal in known.columns_gone and not exists(part.journal)
        if gone and parts and _may_join(parts[-1], part, known, exists):
            parts[-1] = _joined_part(parts[-1], part)
        else:
            parts.append(part)
    return replace(segment, parts=tuple(parts))


def _may_join(
    first: SegmentPart, second: SegmentPart, known: Manifest, exists: Callable[[str], bool]
) -> bool:
    gone = first.journal in known.columns_gone and not exists(first.journal)
    ordered = first.to_ns <= second.from_ns and first.last_seq < second.first_seq
    return gone and ordered and (first.writer, first.run) == (second.writer, second.run)


def _joined_part(first: SegmentPart, second: SegmentPart) -> SegmentPart:
    points = sorted({*part_clock(first), *part_clock(second)})
    return replace(
        second,
        first_seq=first.first_seq,
        rows=first.rows + second.rows,
        from_ns=first.from_ns,
        stamp_from_ns=min(first.stamp_from_ns, second.stamp_from_ns),
        stamp_to_ns=max(first.stamp_to_ns, second.stamp_to_ns),
        files=1,
        bytes=first.bytes + second.bytes,
        clock=simplified(points),
    )
