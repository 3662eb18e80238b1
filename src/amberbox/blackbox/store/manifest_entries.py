"""Entries of the manifest: segments and their parts; journals sealed, signed, confirmed or
deleted.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import PurePosixPath
from typing import Any, Literal

import msgspec

from amberbox.blackbox.store.clocks import ClockPoints, ClockTable
from amberbox.core.types import Gap

DeletionKind = Literal["raw", "columns", "both"]


@dataclass(frozen=True, slots=True)
class Hole:
    """Rows that were written and could not be read any more when the journal was sealed."""

    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class SealedJournal:
    """A finished journal file, as it was when the maintenance process sealed it.

    ``chain`` is the last link of its hash chain, ``start_chain`` the one it began with; ``tail`` is
    the SHA-256 of the ``bytes - tail_from`` bytes that follow the last link (the summary). Times
    are corrected times of receipt, inclusive. ``clock`` are (log time, wall minus log time) pairs,
    ``boot_base_ns`` is log time minus boot time, None where the file does not state it.
    """

    journal: str
    writer: str
    run: int
    number: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    bytes: int
    start_chain: str
    chain: str
    tail_from: int
    tail: str
    boot_id: str = ""
    boot_base_ns: int | None = None
    clock: tuple[tuple[int, int], ...] = ()
    synchronised: bool | None = None
    config_hash: str = ""
    holes: tuple[Hole, ...] = ()

    def gaps(self) -> tuple[Gap, ...]:
        """Return the holes as gaps of the record."""
        return tuple(
            Gap(self.writer, self.run, h.from_ns, h.to_ns, h.reason, "", h.to_seq - h.from_seq,
                h.from_seq, h.to_seq)
            for h in self.holes
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tombstone:
    """A deliberate deletion: a stretch of one writer's run, raw, columns or both.

    ``journals`` are the files (one, or several once the manifest has been condensed), ``chain`` the
    last link of the last of them, so that the chain continues across the deletion.
    """

    journals: tuple[str, ...]
    what: DeletionKind
    writer: str
    run: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    chain: str
    reason: str
    confirmed: bool
    at_ns: int


@dataclass(frozen=True, slots=True)
class ManifestSignature:
    """The robot's signature of the manifest up to the line with hash ``head``.

    ``key`` is the public key (hex), ``signature`` Ed25519 over store_id, head and at_ns.
    """

    head: str
    at_ns: int
    key: str
    signature: str


_KINDS: dict[str, type] = {"sealed": SealedJournal, "gone": Tombstone, "signed": ManifestSignature}
_NAMES = {cls: kind for kind, cls in _KINDS.items()}


def to_record(entry: SealedJournal | Tombstone | ManifestSignature) -> dict[str, Any]:
    """Return an entry as a line of the manifest."""
    return {"kind": _NAMES[type(entry)], "entry": msgspec.to_builtins(entry)}


def confirmed_record(journals: tuple[str, ...], by: str, at_ns: int) -> dict[str, Any]:
    """Return the line that a server holds these journals, verified."""
    return {"kind": "confirmed", "journals": list(journals), "by": by, "at_ns": at_ns}


def unconfirmed_record(journals: tuple[str, ...], by: str, at_ns: int) -> dict[str, Any]:
    """Return the line that a server lacks journals that it had confirmed."""
    return {"kind": "unconfirmed", "journals": list(journals), "by": by, "at_ns": at_ns}


def from_record(record: Mapping[str, Any]) -> SealedJournal | Tombstone | ManifestSignature | None:
    """Read what ``to_record`` returned; None for a line of another kind."""
    cls = _KINDS.get(record["kind"])
    if cls is None:
        return None
    entry: SealedJournal | Tombstone | ManifestSignature = msgspec.convert(record["entry"], cls)
    return entry


@dataclass(frozen=True, slots=True)
class SegmentPart:
    """The rows of a segment that come from one journal. Times are inclusive, in log time.

    ``clock`` lists the offsets of the time of receipt, each from a log time on; ``stamp_offset_ns``
    is the median of received minus stamp, None for items without a stamp. ``files`` is the number
    of segments that this table of the journal was written to: one per version of its schema.
    ``bytes`` is the size of the messages (0 for child tables).
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

    @property
    def received_range_ns(self) -> tuple[int, int]:
        """Return when the first and the last row were received, ns."""
        return ClockTable(part_clock(self)).span(self.from_ns, self.to_ns)


@dataclass(frozen=True, slots=True)
class Segment:
    """One Parquet file: its place in the store, its content, and its fingerprint."""

    path: str
    item: str
    schema: str
    rows: int
    bytes: int
    sha256: str
    parts: tuple[SegmentPart, ...]

    @property
    def offsets_ns(self) -> tuple[int, int]:
        """Return the least and greatest offset of the time of receipt from log time, ns."""
        bounds = [ClockTable(part_clock(part)).bounds() for part in self.parts]
        return min(low for low, _ in bounds), max(high for _, high in bounds)

    @property
    def received_range_ns(self) -> tuple[int, int]:
        """Return the bounds of the time of receipt, ns, both inclusive."""
        lows = [p.from_ns + min(o for _, o in part_clock(p)) for p in self.parts]
        highs = [p.to_ns + max(o for _, o in part_clock(p)) for p in self.parts]
        return min(lows), max(highs)

    @property
    def stamp_range_ns(self) -> tuple[int, int]:
        """Return the bounds of the item's own stamps, ns, both inclusive."""
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


def part_from_json(data: Mapping[str, Any]) -> SegmentPart:
    """Read a part from its form in the manifest and in a segment's own metadata."""
    return msgspec.convert(data, SegmentPart)


def is_inside(path: str) -> bool:
    """Return whether a path of the manifest stays below the store."""
    found = PurePosixPath(path)
    return bool(found.parts) and not found.is_absolute() and ".." not in found.parts


def part_clock(part: SegmentPart) -> ClockPoints:
    """Return the points that the offsets of a part's rows depend on, from before to after them."""
    if not part.clock:
        return ((part.from_ns, 0),)
    times = [log_ns for log_ns, _ in part.clock]
    first = max(bisect_right(times, part.from_ns) - 1, 0)
    end = bisect_left(times, part.to_ns) + 1
    return part.clock[first : max(end, first + 1)]
