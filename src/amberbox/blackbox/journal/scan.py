"""Scan an MCAP file in any state: every chunk with a valid CRC, every damaged range.

A valid summary is used; without one, or on request, the whole file is walked record by record. At
damage the walk searches for the next valid chunk from right after the last valid record, so that
only damaged chunks are lost.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.chunk import (
    Buffer,
    Chunk,
    decompress,
    index_offsets,
    open_buffer,
    open_chunk,
)
from amberbox.blackbox.journal.mcap import (
    CHAIN_METADATA,
    START_METADATA,
    McapSummary,
    ends_of_data,
    is_finished,
    read_summary,
)
from amberbox.core.clock import NS
from amberbox.core.types import IntArray

_KNOWN = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}
_LOOSE = {mcap.SCHEMA, mcap.CHANNEL, mcap.MESSAGE}
_LOOSE_BYTES = 4 << 20
_INDEX = struct.Struct("<QHI").unpack_from
_MARK = re.compile(
    rb"\x06.{36}(?:\x04\0\0\0zstd|\0\0\0\0.{8}[\x03\x04\x05]|\x03\0\0\0lz4)"
    rb"|\x0c.{8}(?:\x0e\0\0\0" + START_METADATA.encode() + rb"|\x0e\0\0\0"
    + CHAIN_METADATA.encode() + rb")",
    re.DOTALL,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class JournalDamage:
    """A range of a file without a valid checksum."""

    from_offset: int
    to_offset: int
    reason: str


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """A metadata record, with the offset of its end."""

    offset: int
    end: int
    name: str
    values: Mapping[str, str]


WalkItem: TypeAlias = "Chunk | MetadataRecord | JournalDamage"


@dataclass(slots=True)
class JournalWalk:
    """A walk over the records of a buffer that may still grow; ``at`` is where to continue."""

    data: Buffer
    at: int = 0
    tag: str = ""
    grows: bool = False
    finished: bool = False
    trusted: int = 0
    _failed: str = ""
    _waits: bool = False

    def __iter__(self) -> Iterator[WalkItem]:
        if self.at == 0:
            if bytes(self.data[: len(mcap.MAGIC)]) == mcap.MAGIC:
                self.at = self.trusted = len(mcap.MAGIC)
            else:
                self._failed = "no MCAP magic"
        while self.at < len(self.data) and not self.finished:
            before = self.at
            found = self._step()
            if found is not None:
                yield from self._report_damage(self._offset_of(found))
                if not isinstance(found, JournalDamage):
                    self.trusted = found.end
                yield found
            elif self.at == before and (self._waits or not self._failed):
                break
        if not self.grows:
            yield from self._report_damage(len(self.data), "cut short")

    def _offset_of(self, found: WalkItem) -> int:
        return found.from_offset if isinstance(found, JournalDamage) else found.offset

    def _report_damage(self, until: int, reason: str = "") -> Iterator[JournalDamage]:
        """Yield the damage since the last valid record, if there is any."""
        torn = reason if until > self.at else ""
        if (self._failed or torn) and until > self.trusted and not self.finished:
            yield JournalDamage(self.trusted, until, self._failed or torn)
        self._failed = ""

    def _step(self) -> WalkItem | None:
        """Read the record at ``at``; None when it is of no interest or invalid."""
        if self._failed:
            return self._resync()
        head = self._record_head()
        if head is None:
            return None
        opcode, end = head
        if opcode == mcap.CHUNK:
            chunk = self._open(self.at, end)
            if chunk is None:
                self._fail("chunk does not match its checksum")
                return None
            self.at = chunk.end
            return chunk
        if opcode in _LOOSE:
            return self._loose_messages()
        if opcode == mcap.METADATA:
            return self._metadata(end)
        if opcode in (mcap.DATA_END, mcap.FOOTER):
            self._data_end()
        elif opcode == mcap.MESSAGE_INDEX:  # a sound one was taken with its chunk
            self._fail("message index is damaged")
        else:
            self.at = end
        return None

    def _record_head(self) -> tuple[int, int] | None:
        """Return opcode and end of the record at ``at``; None, and the damage noted, if invalid."""
        if self.at + 9 > len(self.data):
            self._incomplete()
            return None
        opcode, length = struct.unpack_from("<BQ", self.data, self.at)
        end = self.at + 9 + length
        if opcode not in _KNOWN:
            self._fail("unknown record")
            return None
        if end > len(self.data):
            self._incomplete()
            return None
        return opcode, end

    def _incomplete(self) -> None:
        if not self.grows:
            self._fail("record is cut short or its length is damaged")

    def _fail(self, reason: str) -> None:
        """Record the damage and go back to the end of the last valid record."""
        self._failed = reason
        self.at = max(self.trusted, len(mcap.MAGIC) if self.trusted else 0)

    def _resync(self) -> WalkItem | None:
        """Find the next valid chunk or metadata record from ``at`` on."""
        for match in _MARK.finditer(self.data, self.at):
            found = self._probe(match.start())
            if found is not None:
                self.at = found.end
                return found
        self._waits = self.grows  # bytes being written may complete a match
        if not self.grows:
            self.at = len(self.data)
        return None

    def _probe(self, offset: int) -> Chunk | MetadataRecord | None:
        if self.data[offset] == mcap.METADATA:
            return metadata_at(self.data, offset)
        head = mcap.parse_chunk_head(self.data, offset)
        if head is None:
            return None
        return self._open(head.offset, head.offset + head.length)

    def _open(self, offset: int, end: int) -> Chunk | None:
        head = mcap.parse_chunk_head(self.data, offset)
        body = decompress(head, self.data) if head else None
        if body is None:
            return None
        entries, end = index_entries(self.data, end)
        chunk = open_chunk(body, offset, end, index_offsets(entries))
        return chunk if chunk is not None and self._is_ours(chunk) else None

    def _is_ours(self, chunk: Chunk) -> bool:
        """Return whether a chunk is of this run; failing disks return blocks of other files."""
        if not self.tag:
            return True
        return all(c.metadata.get("run", self.tag) == self.tag for c in chunk.channels.values())

    def _metadata(self, end: int) -> WalkItem | None:
        found = metadata_at(self.data, self.at)
        if found is None:
            self._fail("metadata record is damaged")
            return None
        self.at = end
        if found.name == START_METADATA:
            self.tag = run_tag(found.values)
        return found

    def _loose_messages(self) -> WalkItem | None:
        """Read message records outside of chunks, as other writers may leave them."""
        at, first = self.at, self.at
        while at + 9 <= len(self.data) and self.data[at] in _LOOSE and at - first < _LOOSE_BYTES:
            (length,) = struct.unpack_from("<Q", self.data, at + 1)
            if at + 9 + length > len(self.data):
                break
            at += 9 + length
        chunk = open_chunk(bytes(self.data[first:at]), first, at) if at > first else None
        if chunk is None:
            self._incomplete()
            return None
        self.at = at
        return chunk

    def _data_end(self) -> None:
        if not is_finished(self.data):
            if not self.grows:
                self._fail("summary is damaged")
            return
        if self.at not in ends_of_data(self.data):  # a damaged record that looks like the end
            self._fail("end of data in the middle")
            return
        self.finished = True
        self.at = len(self.data)


def index_entries(data: Buffer, at: int) -> tuple[list[Buffer], int]:
    """Return the entries of the valid message index records from ``at`` on, and their end."""
    entries, end = list[Buffer](), len(data)
    while at + 15 <= end and data[at] == mcap.MESSAGE_INDEX:
        length, _, size = _INDEX(data, at + 1)
        if length != size + 6 or size % 16 or at + 9 + length > end:
            break
        entries.append(data[at + 15 : at + 15 + size])
        at += 9 + length
    return entries, at


def run_tag(start: Mapping[str, str]) -> str:
    """Return the tag that all chunks of a run carry, from the file's start record."""
    try:
        return f"{start['store_id'][:8]}-{start['writer']}-{start['run']}"
    except KeyError:
        return ""


def metadata_at(data: Buffer, offset: int) -> MetadataRecord | None:
    """Read the metadata record at an offset; None if its lengths do not fit together."""
    try:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        content = bytes(data[offset + 9 : offset + 9 + length])
        if opcode != mcap.METADATA or len(content) != length or length > 1 << 24:
            return None
        name, values = mcap.parse_metadata(content)
    except (ValueError, struct.error):
        return None
    if len(mcap.text(name) + mcap.text_map(values)) != length:
        return None
    return MetadataRecord(offset, offset + 9 + length, name, values)


def chunk_at(data: Buffer, offset: int) -> Chunk | None:
    """Decode the chunk at an offset, or messages outside of chunks; None if invalid."""
    walk = JournalWalk(data, at=offset, grows=True)
    head = mcap.parse_chunk_head(data, offset)
    if head is not None:
        return walk._open(offset, offset + head.length)
    found = walk._loose_messages() if data[offset] in _LOOSE else None
    return found if isinstance(found, Chunk) else None


class ChunkPlace(NamedTuple):
    """Offset, time range and counts of a chunk, without its messages."""

    offset: int
    start_ns: int
    end_ns: int
    count: int  # type: ignore[assignment] # hides tuple.count, which is not used on places
    first_sequence: int | None = None
    channels: tuple[int, ...] | None = None  # channels that have messages in it; None if unknown

    def may_hold(self, channels: Set[int]) -> bool:
        """Return whether it may contain a message of one of these channels."""
        return self.channels is None or not channels.isdisjoint(self.channels)


class ChannelTally(NamedTuple):
    """Messages of one channel in a file: how many, first and last log time, their bytes."""

    rows: int
    first_ns: int
    last_ns: int
    bytes: int

    def plus(self, other: ChannelTally | None) -> ChannelTally:
        """Return the sum of both."""
        if other is None:
            return self
        first_ns, last_ns = min(self.first_ns, other.first_ns), max(self.last_ns, other.last_ns)
        return ChannelTally(self.rows + other.rows, first_ns, last_ns, self.bytes + other.bytes)


@dataclass(slots=True)
class FileScan:
    """The contents of a file: from its summary if that is valid, else from a full walk."""

    path: Path
    size: int
    start: Mapping[str, str] = field(default_factory=dict)
    chain: str = ""
    finished: bool = False
    walked: bool = False
    summary: McapSummary = field(default_factory=McapSummary)
    places: list[ChunkPlace] = field(default_factory=list)
    # how many messages the file had when it was finished, damaged ones included
    indexed: int | None = None
    damage: list[JournalDamage] = field(default_factory=list)
    # messages counted by channel; None if not counted yet
    tallies: Mapping[int, ChannelTally] | None = None


def scan(path: Path, *, walk: bool = False) -> FileScan:
    """Find the chunks of a file; ``walk`` ignores the summary and checks every byte.

    Chunks of a walked journal of ours come in ``seq`` order even where disk pages were swapped.
    """
    with open_buffer(path) as data:
        start = _start_record(data)
        summary = read_summary(data)
        headless = summary is not None and not start and _tag_of(summary)
        if summary is None or walk or headless:
            return _from_walk(path, data, summary)
        return _from_summary(path, data, start, summary)


def start_record(path: Path) -> Mapping[str, str]:
    """Return the start record of a journal file; empty if it has none."""
    with path.open("rb") as file:
        return _start_record(file.read(1 << 16))


_LATEST_NS = 3600 * NS


def late_ns_of(start: Mapping[str, str]) -> int:
    """Return how late the rows of a file may be by its start record, ns; at most an hour."""
    text = start.get("late_ns", "0")
    return min(int(text), _LATEST_NS) if text.isdecimal() else 0


def _start_record(data: Buffer) -> Mapping[str, str]:
    walk = JournalWalk(data[: 1 << 16], grows=True)
    for found in walk:
        if isinstance(found, MetadataRecord) and found.name == START_METADATA:
            return found.values
        break
    return {}


def _from_summary(
    path: Path, data: Buffer, start: Mapping[str, str], summary: McapSummary
) -> FileScan:
    places = [
        ChunkPlace(
            c.offset, c.start_ns, c.end_ns, (c.index_length - 15 * len(c.index_offsets)) // 16,
            channels=tuple([number for number, _ in c.index_offsets]) if c.index_offsets else None,
        )
        for c in summary.chunks
    ]  # fmt: skip
    result = FileScan(path, len(data), start, finished=True, summary=summary, places=places)
    for offset, _, name in summary.metadata[-1:]:
        last = metadata_at(data, offset)
        if last is not None and name == CHAIN_METADATA:
            result.chain = last.values.get("chain", "")
    return result


def _from_walk(path: Path, data: Buffer, summary: McapSummary | None) -> FileScan:
    result = FileScan(path, len(data), walked=True)
    walk = JournalWalk(data)
    tallies: dict[ChunkPlace, Mapping[int, ChannelTally]] = {}
    for found in walk:
        if isinstance(found, JournalDamage):
            result.damage.append(found)
        elif isinstance(found, MetadataRecord):
            if found.name == START_METADATA:
                result.start = found.values
            elif found.name == CHAIN_METADATA:
                result.chain = found.values.get("chain", "")
        else:
            tallies.update(_take_chunk(result, found))
    result.finished = walk.finished
    if summary is not None:  # it has a checksum of its own: definitions whose chunks are damaged
        result.summary.schemas = {**summary.schemas, **result.summary.schemas}
        result.summary.channels = {**summary.channels, **result.summary.channels}
        result.indexed = summary.counts.total()
    if not result.start:
        result.start = _start_by_mark(result)
    if result.start:
        result.places = _in_order(result)
    result.tallies = merge_tallies(tallies[place] for place in result.places)
    result.summary.counts = Counter({n: tally.rows for n, tally in result.tallies.items()})
    return result


def _tag_of(summary: McapSummary) -> str:
    return next((c.metadata["run"] for c in summary.channels.values() if "run" in c.metadata), "")


def _start_by_mark(result: FileScan) -> Mapping[str, str]:
    """Reconstruct a damaged start record from the run tag of the chunks."""
    parts = _tag_of(result.summary).split("-")
    if len(parts) != 3 or not result.places:
        return {}
    first = min(place.first_sequence or 0 for place in result.places)
    result.indexed = None  # the content before the first sound chunk is unknown
    keys = ("store_id", "writer", "run", "first_seq")
    return dict(zip(keys, (*parts, str(first)), strict=True))


def _take_chunk(result: FileScan, chunk: Chunk) -> Mapping[ChunkPlace, Mapping[int, ChannelTally]]:
    """Add a chunk to a scan; return its place and its messages counted by channel, if any."""
    summary = result.summary
    summary.schemas.update(chunk.schemas)
    summary.channels.update(chunk.channels)
    if not len(chunk):
        return {}
    tallies = tally_chunk(chunk)
    first, last = int(chunk.log_ns.min()), int(chunk.log_ns.max())
    summary.start_ns = min(summary.start_ns, first) if result.places else first
    summary.end_ns = max(summary.end_ns, last)
    first_sequence, channels = int(chunk.sequence[0]), tuple(tallies)
    place = ChunkPlace(chunk.offset, first, last, len(chunk), first_sequence, channels)
    result.places.append(place)
    return {place: tallies}


def tally(
    channels: NDArray[np.uint16],
    first_ns: IntArray,
    last_ns: IntArray,
    sizes: IntArray,
    counts: IntArray,
) -> dict[int, ChannelTally]:
    """Count messages by channel; the columns are parallel, each row is for several messages."""
    if not len(channels):
        return {}
    order = np.argsort(channels, kind="stable")
    grouped = channels[order]
    starts = np.flatnonzero(np.concatenate(([True], grouped[1:] != grouped[:-1])))
    columns = (
        grouped[starts], np.add.reduceat(counts[order], starts),
        np.minimum.reduceat(first_ns[order], starts), np.maximum.reduceat(last_ns[order], starts),
        np.add.reduceat(sizes[order], starts),
    )  # fmt: skip
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {number: ChannelTally(*figures) for number, *figures in rows}


def tally_chunk(chunk: Chunk) -> dict[int, ChannelTally]:
    """Count the messages of a chunk by channel."""
    ones = np.ones(len(chunk), np.int64)
    return tally(chunk.channel, chunk.log_ns, chunk.log_ns, chunk.ends - chunk.starts, ones)


def merge_tallies(parts: Iterable[Mapping[int, ChannelTally]]) -> dict[int, ChannelTally]:
    """Add up the counts of several parts of a file by channel."""
    found: dict[int, ChannelTally] = {}
    for part in parts:
        for number, one in part.items():
            found[number] = one.plus(found.get(number))
    return found


def _in_order(result: FileScan) -> list[ChunkPlace]:
    """Order chunks by sequence and drop chunks that a failing disk returns twice."""
    base = int(result.start.get("first_seq", 0))
    ordered, expected = [], 0
    for place in sorted(result.places, key=lambda p: ((p.first_sequence or 0) - base) & 0xFFFFFFFF):
        relative = ((place.first_sequence or 0) - base) & 0xFFFFFFFF
        if relative >= expected:
            ordered.append(place)
            expected = relative + place.count
    return ordered


def read_chunk(data: Buffer, place: ChunkPlace) -> Chunk | None:
    """Decode one chunk; None if its checksum is wrong."""
    return chunk_at(data, place.offset)
