"""The manifest: which segment holds which rows of which journal; append-only, hash-chained."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.clocktable import ClockPoints, ClockTable
from amberbox.blackbox.segments import lines as text
from amberbox.blackbox.segments.entries import Sealed, Signature, Tombstone, from_record
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.segments.growing import GrowingLines
from amberbox.core.files import sync_folder
from amberbox.core.types import Gap

NAME = "manifest"
UNREADABLE = (
    OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError,
    MemoryError, msgspec.MsgspecError,
)  # fmt: skip
"""What a damaged segment may raise when it is read: its footer has no checksum of its own."""
CHANGING = threading.RLock()
"""Held by the thread of the keeper that appends to the manifest or deletes what it names."""


@dataclass(frozen=True, slots=True)
class Part:
    """The rows of a segment that come from one journal. Times are inclusive, in log time.

    ``clock`` says from which log time on which offset gives the time of receipt;
    ``stamp_offset_ns`` is the median of received minus stamp, None for items without a stamp.
    ``files`` is the number of segments that this table of the journal was written to: one per
    version of its schema. ``bytes`` is the size of the messages (0 for child tables).
    """

    journal: str
    head: str
    writer: str
    run: int
    first_seq: int
    last_seq: int
    rows: int
    from_ns: int
    to_ns: int
    stamp_from_ns: int
    stamp_to_ns: int
    files: int = 1
    bytes: int = 0
    stamp_offset_ns: int | None = None
    clock: ClockPoints = ()


@dataclass(frozen=True, slots=True)
class Segment:
    """One Parquet file: its place in the store, what is in it, and its fingerprint."""

    path: str
    item: str
    schema: str
    rows: int
    bytes: int
    sha256: str
    parts: tuple[Part, ...]

    @property
    def offsets_ns(self) -> tuple[int, int]:
        """By how much log time may differ from the time of receipt: least and most."""
        bounds = [ClockTable(part_clock(part)).bounds() for part in self.parts]
        return min(low for low, _ in bounds), max(high for _, high in bounds)

    @property
    def received_range_ns(self) -> tuple[int, int]:
        """Bounds of the time of receipt, both inclusive."""
        lows = [p.from_ns + min(o for _, o in part_clock(p)) for p in self.parts]
        highs = [p.to_ns + max(o for _, o in part_clock(p)) for p in self.parts]
        return min(lows), max(highs)

    @property
    def stamp_range_ns(self) -> tuple[int, int]:
        """Bounds of the item's own stamps, both inclusive."""
        lows = [part.stamp_from_ns for part in self.parts]
        return min(lows), max(part.stamp_to_ns for part in self.parts)

    def to_json(self) -> dict[str, Any]:
        """Return the segment as plain data."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Segment:
        """Read what ``to_json`` returned."""
        segment = msgspec.convert(data, cls)
        if not segment.parts or not is_inside(segment.path):
            raise ValueError(f"{segment.path} is no segment of a store")
        return segment


def part_from_json(data: Mapping[str, Any]) -> Part:
    """Read a part as it stands in the manifest and in a segment's own metadata."""
    return msgspec.convert(data, Part)


def is_inside(path: str) -> bool:
    """Tell whether a path of the manifest stays below the store."""
    found = PurePosixPath(path)
    return bool(found.parts) and not found.is_absolute() and ".." not in found.parts


def part_clock(part: Part) -> ClockPoints:
    """Return the points that the offsets of a part's rows depend on, from before to after them."""
    if not part.clock:
        return ((part.from_ns, 0),)
    times = [log_ns for log_ns, _ in part.clock]
    first = max(bisect_right(times, part.from_ns) - 1, 0)
    end = bisect_left(times, part.to_ns) + 1
    return part.clock[first : max(end, first + 1)]


@dataclass(frozen=True, slots=True)
class Journal:
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
    """What the manifest says now.

    ``columns_gone`` and ``raw_gone`` name the journals of which one or the other was deleted, as
    far as the manifest has not been condensed since; ``gone_segments`` are files that went thus.
    ``incidents`` is what was said last of each; ``lines`` is how many there are. ``unsigned`` are
    the journals that were sealed after the last signature; ``unconfirmed`` those that a server had
    confirmed and lacks now. ``names`` are the items' names by source and topic. ``damage`` names
    lines that cannot be read, ``mended`` those of which one bit is flipped, ``restored`` the damage
    that later lines make up for. ``lost`` are segments that are listed and cannot be used, as far
    as that is known without opening them.
    """

    schemas: Mapping[str, TableSchema] = field(default_factory=dict)
    segments: Mapping[str, tuple[Segment, ...]] = field(default_factory=dict)
    journals: Mapping[str, Journal] = field(default_factory=dict)
    sealed: Mapping[str, Sealed] = field(default_factory=dict)
    tombstones: tuple[Tombstone, ...] = ()
    confirmed: frozenset[str] = frozenset()
    signatures: tuple[Signature, ...] = ()
    damage: tuple[str, ...] = ()
    last_hash: str = text.FIRST_HASH
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
        return tuple(d for d in found if not d.endswith(text.TORN))

    def complete(self, item: str, existing: Container[str] | None = None) -> frozenset[str]:
        """Return the journals whose rows of this item are all in segments.

        Of journals that are not among the ``existing`` ones, segments are all there is.
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
    """Tell whether a table stays when the data around it go: events, gaps, runs, statuses."""
    return schema.source == reserved.SOURCE and schema.topic != reserved.COUNTERS


@dataclass(slots=True)
class _State:
    """What the lines read so far add up to."""

    schemas: dict[str, TableSchema] = field(default_factory=dict)
    live: dict[str, Segment] = field(default_factory=dict)
    paths_of: dict[str, set[str]] = field(default_factory=dict)
    journals: dict[str, Journal] = field(default_factory=dict)
    sealed: dict[str, Sealed] = field(default_factory=dict)
    tombstones: list[Tombstone] = field(default_factory=list)
    confirmed: set[str] = field(default_factory=set)
    signatures: list[Signature] = field(default_factory=list)
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
                journal = _journal_from_json(record)
                self.journals[journal.name] = journal
            case "confirmed":
                self.confirmed.update(_names(record["journals"]))
                self.unconfirmed.difference_update(_names(record["journals"]))
            case "unconfirmed":
                self.confirmed.difference_update(_names(record["journals"]))
                self.unconfirmed.update(_names(record["journals"]))
            case "incident":
                said = {k: v for k, v in record.items() if k not in ("hash", "prev")}
                self.incidents[str(record["incident"]["id"])] = said
            case "names":
                self.names.update(msgspec.convert(record["names"], dict[str, str]))
            case "restored":
                self._take_restored(msgspec.convert(record, Restored))
            case text.CHECKPOINT:
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

    def _take_restored(self, restored: Restored) -> None:
        self.restored.update(restored.damage)
        for name in restored.undone:
            self.journals.pop(name, None)
        for path in restored.gone:
            self.live.pop(path, None)

    def _take_entry(self, entry: Sealed | Tombstone | Signature | None) -> None:
        if isinstance(entry, Sealed):
            self.sealed[entry.journal] = entry
            self.unsigned.add(entry.journal)
        elif isinstance(entry, Signature):
            self.signatures.append(entry)
            self.unsigned.clear()
        elif isinstance(entry, Tombstone):
            if not (entry.journals and all(map(is_inside, entry.journals))):
                raise ValueError("a tombstone of nothing in the store")
            self.tombstones.append(entry)
            if entry.what != "columns":
                self.raw_gone.update(entry.journals)
            if entry.what != "raw":
                self._drop_columns(entry.journals)

    def _drop_columns(self, journals: Sequence[str]) -> None:
        """A segment goes with the last of its journals, unless its table is kept."""
        self.columns_gone.update(journals)
        for name in journals:
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

    def result(self, read: text.LineReader) -> Manifest:
        """Return what it all says, not touched by records to come."""
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
        from amberbox.blackbox.segments.restoring import restored  # it reads segments

        known, last = self.lines.read(), self._last
        if last is None or last[0] is not known:
            self._last = last = known, restored(self._store, known)
        return last[1]


@lru_cache(maxsize=8)
def _reader(store: Path) -> _Reader:
    return _Reader(store)


def read(store: Path) -> Manifest:
    """Read a store's manifest; lines that do not hold are named in ``damage``.

    What these said is made up for in memory, as far as segments and journals tell.
    """
    return _reader(store).read()


def why(error: BaseException) -> str:
    """Return the first line of what an error says."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def is_listed(store: Path, segment: Segment) -> bool:
    """Tell whether the manifest says that a segment is there now."""
    return any(s.path == segment.path for s in read(store).segments.get(segment.item, ()))


def read_lines(store: Path) -> Manifest:
    """Read a store's manifest as its lines say, and nothing else."""
    return _reader(store).lines.read()


def by_item(segments: Iterable[Segment]) -> dict[str, tuple[Segment, ...]]:
    grouped: dict[str, list[Segment]] = {}
    for segment in segments:
        grouped.setdefault(segment.item, []).append(segment)
    return {item: tuple(found) for item, found in grouped.items()}


def segment_record(segment: Segment, replaces: Sequence[str] = ()) -> dict[str, Any]:
    """Say that a segment is there, in place of others that may be removed afterwards."""
    record = {"kind": "segment", "segment": segment.to_json()}
    return {**record, "replaces": list(replaces)} if replaces else record


def schema_record(schema: TableSchema) -> dict[str, Any]:
    """Say what the columns are that segments refer to."""
    return {"kind": "schema", "id": schema.id, "schema": schema.to_json()}


def journal_record(journal: Journal) -> dict[str, Any]:
    """Say that all rows of a journal are in segments now."""
    gaps = [_gap_to_json(gap) for gap in journal.gaps]
    fields = {name: getattr(journal, name) for name in _JOURNAL_FIELDS}
    return {"kind": "journal", "journal": journal.name, **fields, "gaps": gaps}


_JOURNAL_FIELDS = (
    "head", "writer", "run", "first_seq", "end_seq", "start_ns", "end_ns", "selection",
)  # fmt: skip
_GAP_FIELDS = (
    "writer", "run", "from_ns", "to_ns", "reason", "item", "count", "from_seq", "to_seq",
)  # fmt: skip


def _journal_from_json(record: Mapping[str, Any]) -> Journal:
    fields = {name: record[name] for name in (*_JOURNAL_FIELDS, "gaps")}
    return msgspec.convert({"name": record["journal"], **fields}, Journal)


def _names(value: object) -> tuple[str, ...]:
    return msgspec.convert(value, tuple[str, ...])


def _gap_to_json(gap: Gap) -> dict[str, Any]:
    return {name: getattr(gap, name) for name in _GAP_FIELDS}


@dataclass(frozen=True, slots=True)
class Restored:
    """What the keeper found out about damaged lines of the manifest.

    ``damage`` names the lines, ``undone`` the journals that have to be looked through again,
    ``gone`` segments that are listed and not there. The lines after it say again what was lost.
    """

    damage: tuple[str, ...] = ()
    undone: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()


def restored_record(restored: Restored) -> dict[str, Any]:
    """Say that damaged lines were made up for."""
    return {"kind": "restored", **asdict(restored)}


def names_record(names: Mapping[str, str]) -> dict[str, Any]:
    """State the item names of sources' topics."""
    return {"kind": "names", "names": dict(names)}


def append(store: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Append records in one write and make them durable. Only ``keep`` calls this.

    Raises OSError when the disk does not take them: the manifest is then as it was before.
    """
    with CHANGING:
        content = text.encode(records, read(store).last_hash)
        text.append_durably(store / NAME, content)


def replace(
    store: Path, records: Sequence[Mapping[str, Any]], last_hash: str = text.FIRST_HASH
) -> None:
    """Write a manifest anew, for a rebuild from the segments or to condense it."""
    temporary = store / f".{NAME}.tmp"
    temporary.unlink(missing_ok=True)
    text.append_durably(temporary, text.encode(records, last_hash))
    temporary.rename(store / NAME)
    sync_folder(store)
