"""The manifest: which segment holds which rows of which journal; append-only, hash-chained."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from amberbox.blackbox.segments.entries import Sealed, Signature, Tombstone, from_record
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.store import sync_folder
from amberbox.core.types import Gap

NAME = "manifest"
_FIRST_HASH = "0" * 64
_HASH_FIELD = 75  # {"hash":"<64 hex digits>",

ClockPoints: TypeAlias = tuple[tuple[int, int], ...]


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
    def clock(self) -> ClockPoints:
        """The offsets of all parts; log time only grows from part to part."""
        return sum((part_clock(part) for part in self.parts), ())

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
        parts = tuple(part_from_json(part) for part in data["parts"])
        return cls(**{**data, "parts": parts})


def part_from_json(data: Mapping[str, Any]) -> Part:
    """Read a part as it stands in the manifest and in a segment's own metadata."""
    clock = tuple((int(log_ns), int(offset_ns)) for log_ns, offset_ns in data["clock"])
    return Part(**{**data, "clock": clock})


def part_clock(part: Part) -> ClockPoints:
    """Return the offsets of one part, the first of them moved to the part's first row."""
    if not part.clock:
        return ((part.from_ns, 0),)
    valid = [offset for log_ns, offset in part.clock if log_ns <= part.from_ns]
    first = valid[-1] if valid else part.clock[0][1]
    later = [entry for entry in part.clock if part.from_ns < entry[0] <= part.to_ns]
    return ((part.from_ns, first), *later)


@dataclass(frozen=True, slots=True)
class Deletion:
    """A segment that was deleted on purpose: what is missing now, and why."""

    segment: Segment
    reason: str
    at_ns: int


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
    """What the manifest says now."""

    schemas: Mapping[str, TableSchema] = field(default_factory=dict)
    segments: Mapping[str, tuple[Segment, ...]] = field(default_factory=dict)
    journals: Mapping[str, Journal] = field(default_factory=dict)
    deletions: tuple[Deletion, ...] = ()
    sealed: Mapping[str, Sealed] = field(default_factory=dict)
    tombstones: tuple[Tombstone, ...] = ()
    confirmed: frozenset[str] = frozenset()
    signatures: tuple[Signature, ...] = ()
    damage: tuple[str, ...] = ()
    last_hash: str = _FIRST_HASH

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


def read(store: Path) -> Manifest:
    """Read a store's manifest; lines that do not hold are left out and named in ``damage``."""
    path = store / NAME
    try:
        state = path.stat()
    except FileNotFoundError:
        return Manifest()
    return _read_cached(path, state.st_mtime_ns, state.st_size, state.st_ino)


@lru_cache(maxsize=8)
def _read_cached(path: Path, _mtime_ns: int, size: int, _inode: int) -> Manifest:
    with path.open("rb") as file:
        content = file.read(size)
    records, damage, last_hash = _verified(content)
    return _manifest(records, damage, last_hash)


def _verified(content: bytes) -> tuple[list[dict[str, Any]], list[str], str]:
    """Return the records whose hash holds, what does not, and the hash of the last record."""
    records: list[dict[str, Any]] = []
    damage: list[str] = []
    last_hash = _FIRST_HASH
    lines = content.split(b"\n")
    for number, line in enumerate(lines, 1):
        if not line:
            continue
        record = _record(line)
        if record is None:
            torn = number == len(lines)
            damage.append(f"line {number}: " + ("torn at the end" if torn else "damaged"))
            continue
        if record["prev"] != last_hash:
            damage.append(f"line {number}: does not follow the line before")
        last_hash = record["hash"]
        records.append(record)
    return records, damage, last_hash


def _record(line: bytes) -> dict[str, Any] | None:
    expected = b'{"hash":"%s",' % hashlib.sha256(line[_HASH_FIELD:]).hexdigest().encode()
    if line[:_HASH_FIELD] != expected:
        return None
    record: dict[str, Any] = json.loads(line)
    return record


def _manifest(records: list[dict[str, Any]], damage: list[str], last_hash: str) -> Manifest:
    live: dict[str, Segment] = {}
    deletions: list[Deletion] = []
    for record in records:
        if record["kind"] == "segment":
            _take_segment(live, record)
        elif record["kind"] == "deleted" and record["path"] in live:
            gone = live.pop(record["path"])
            deletions.append(Deletion(gone, record["reason"], record["at_ns"]))
    schemas = {r["id"]: TableSchema.from_json(r["schema"]) for r in _of_kind(records, "schema")}
    done = list(_of_kind(records, "journal"))
    entries = [entry for entry in map(from_record, records) if entry is not None]
    return Manifest(
        schemas,
        _by_item(live.values()),
        {record["journal"]: _journal_from_json(record) for record in done},
        tuple(deletions),
        {entry.journal: entry for entry in entries if isinstance(entry, Sealed)},
        tuple(entry for entry in entries if isinstance(entry, Tombstone)),
        frozenset(name for r in _of_kind(records, "confirmed") for name in r["journals"]),
        tuple(entry for entry in entries if isinstance(entry, Signature)),
        tuple(damage),
        last_hash,
    )


def _of_kind(records: list[dict[str, Any]], kind: str) -> Iterable[dict[str, Any]]:
    return (record for record in records if record["kind"] == kind)


def _take_segment(live: dict[str, Segment], record: Mapping[str, Any]) -> None:
    for path in record.get("replaces", ()):
        live.pop(path, None)
    segment = Segment.from_json(record["segment"])
    live[segment.path] = segment


def _by_item(segments: Iterable[Segment]) -> dict[str, tuple[Segment, ...]]:
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
    fields = {name: record[name] for name in _JOURNAL_FIELDS}
    return Journal(record["journal"], gaps=tuple(Gap(**g) for g in record["gaps"]), **fields)


def _gap_to_json(gap: Gap) -> dict[str, Any]:
    return {name: getattr(gap, name) for name in _GAP_FIELDS}


def deleted_record(path: str, reason: str, at_ns: int) -> dict[str, Any]:
    """Say that a segment is deleted, and why; append it before the file goes."""
    return {"kind": "deleted", "path": path, "reason": reason, "at_ns": at_ns}


def append(store: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Append records in one write and make them durable. Only ``keep`` calls this."""
    path = store / NAME
    before = read(store)
    content = _lines(records, before.last_hash)
    if not _ends_with_newline(path):
        content = b"\n" + content
    _append_durably(path, content)


def _lines(records: Sequence[Mapping[str, Any]], last_hash: str) -> bytes:
    lines = []
    for record in records:
        rest = json.dumps({"prev": last_hash, **record}, separators=(",", ":"))[1:].encode()
        last_hash = hashlib.sha256(rest).hexdigest()
        lines.append(b'{"hash":"%s",%s\n' % (last_hash.encode(), rest))
    return b"".join(lines)


def _ends_with_newline(path: Path) -> bool:
    if not path.exists() or path.stat().st_size == 0:
        return True
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def _append_durably(path: Path, content: bytes) -> None:
    is_new = not path.exists()
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        while content:
            content = content[os.write(descriptor, content) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if is_new:
        sync_folder(path.parent)


def replace(store: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Write a manifest anew, for a rebuild from the segments."""
    temporary = store / f".{NAME}.tmp"
    temporary.unlink(missing_ok=True)
    _append_durably(temporary, _lines(records, _FIRST_HASH))
    temporary.rename(store / NAME)
    sync_folder(store)
