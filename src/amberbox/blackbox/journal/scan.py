"""Read an MCAP file whatever happened to it: every chunk that its CRC vouches for is found.

The walk goes record by record. Where something does not hold, it looks for the next chunk that
does, starting right after the last one that held, so that damage costs only what it touches.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.chunk import Chunk, decompress, index_offsets, open_chunk
from amberbox.blackbox.journal.summary import Summary, is_finished, read_summary
from amberbox.blackbox.journal.writer import CHAIN_METADATA, START_METADATA
from amberbox.core.types import IntArray

Buffer: TypeAlias = "bytes | memoryview"

_KNOWN = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}
_LOOSE = {mcap.SCHEMA, mcap.CHANNEL, mcap.MESSAGE}
_LOOSE_BYTES = 4 << 20
_MARK = re.compile(
    rb"\x06.{36}(?:\x04\0\0\0zstd|\0\0\0\0.{8}[\x03\x04\x05]|\x03\0\0\0lz4)"
    rb"|\x0c.{8}(?:\x0e\0\0\0" + START_METADATA.encode() + rb"|\x0e\0\0\0"
    + CHAIN_METADATA.encode() + rb")",
    re.DOTALL,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes of a file that no checksum vouches for."""

    from_offset: int
    to_offset: int
    reason: str


@dataclass(frozen=True, slots=True)
class Metadata:
    """A metadata record, with the offset of its end."""

    offset: int
    end: int
    name: str
    values: Mapping[str, str]


Found: TypeAlias = "Chunk | Metadata | Damage"


@dataclass(slots=True)
class Walk:
    """A walk over a buffer that may still grow; ``at`` is where the next one would go on."""

    data: Buffer
    at: int = 0
    tag: str = ""
    grows: bool = False
    finished: bool = False
    trusted: int = 0
    _failed: str = ""
    _waits: bool = False

    def __iter__(self) -> Iterator[Found]:
        if self.at == 0:
            self._start()
        while self.at < len(self.data) and not self.finished:
            before = self.at
            found = self._step()
            if found is not None:
                yield from self._report_damage(self._offset_of(found))
                self._trust(found)
                yield found
            elif self.at == before and (self._waits or not self._failed):
                break
        if not self.grows:
            yield from self._report_damage(len(self.data), "cut short")

    def _start(self) -> None:
        if bytes(self.data[: len(mcap.MAGIC)]) == mcap.MAGIC:
            self.at = self.trusted = len(mcap.MAGIC)
        else:
            self._failed = "no MCAP magic"

    def _offset_of(self, found: Found) -> int:
        return found.from_offset if isinstance(found, Damage) else found.offset

    def _trust(self, found: Found) -> None:
        if not isinstance(found, Damage):
            self.trusted = found.end

    def _report_damage(self, until: int, reason: str = "") -> Iterator[Damage]:
        """Tell of the bytes since the last thing that held, if something went wrong there."""
        torn = reason if until > self.at else ""
        if (self._failed or torn) and until > self.trusted and not self.finished:
            yield Damage(self.trusted, until, self._failed or torn)
        self._failed = ""

    def _step(self) -> Found | None:
        """Take the record at ``at``; None when it is of no interest or does not hold."""
        if self._failed:
            return self._resync()
        head = self._record_head()
        if head is None:
            return None
        opcode, end = head
        if opcode == mcap.CHUNK:
            return self._chunk(end)
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
        """Return opcode and end of the record at ``at``, or note that there is none."""
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
        """Remember the damage and go back to right behind what held last."""
        self._failed = reason
        self.at = max(self.trusted, len(mcap.MAGIC) if self.trusted else 0)

    def _resync(self) -> Found | None:
        """Find the next chunk or start record that holds, from ``at`` on."""
        for match in _MARK.finditer(self.data, self.at):
            found = self._probe(match.start())
            if found is not None:
                self.at = found.end
                return found
        self._waits = self.grows  # what is being written may complete a match
        if not self.grows:
            self.at = len(self.data)
        return None

    def _probe(self, offset: int) -> Chunk | Metadata | None:
        if self.data[offset] == mcap.METADATA:
            return _metadata_at(self.data, offset)
        head = mcap.parse_chunk_head(self.data, offset)
        if head is None:
            return None
        return self._open(head.offset, head.offset + head.length)

    def _chunk(self, end: int) -> Found | None:
        chunk = self._open(self.at, end)
        if chunk is None:
            self._fail("chunk does not match its checksum")
            return None
        self.at = chunk.end
        return chunk

    def _open(self, offset: int, end: int) -> Chunk | None:
        head = mcap.parse_chunk_head(self.data, offset)
        body = decompress(head, self.data) if head else None
        if body is None:
            return None
        offsets, end = self._index_after(end)
        chunk = open_chunk(body, offset, end, offsets)
        return chunk if chunk is not None and self._is_ours(chunk) else None

    def _index_after(self, at: int) -> tuple[IntArray, int]:
        """Read the message index records that follow a chunk."""
        records = []
        while at + 15 <= len(self.data) and self.data[at] == mcap.MESSAGE_INDEX:
            length, channel, size = struct.unpack_from("<QHI", self.data, at + 1)
            if length != size + 6 or size % 16 or at + 9 + length > len(self.data):
                break
            records.append((channel, bytes(self.data[at + 15 : at + 15 + size])))
            at += 9 + int(length)
        return index_offsets(records), at

    def _is_ours(self, chunk: Chunk) -> bool:
        """Tell a chunk of this run from a block of another file that a dying disk put here."""
        if not self.tag:
            return True
        return all(c.metadata.get("run", self.tag) == self.tag for c in chunk.channels.values())

    def _metadata(self, end: int) -> Found | None:
        found = _metadata_at(self.data, self.at)
        if found is None:
            self._fail("metadata record is damaged")
            return None
        self.at = end
        if found.name == START_METADATA:
            self.tag = run_tag(found.values)
        return found

    def _loose_messages(self) -> Found | None:
        """Take records that stand outside chunks, as other writers may leave them."""
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
        self.finished = True
        self.at = len(self.data)


def run_tag(start: Mapping[str, str]) -> str:
    """Compose the mark that all chunks of a run carry, from the file's start record."""
    try:
        return f"{start['store_id'][:8]}-{start['writer']}-{start['run']}"
    except KeyError:
        return ""


def _metadata_at(data: Buffer, offset: int) -> Metadata | None:
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
    return Metadata(offset, offset + 9 + length, name, values)


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Where a chunk lies and what it holds, without holding it."""

    offset: int
    start_ns: int
    end_ns: int
    count: int
    first_sequence: int | None = None


@dataclass(slots=True)
class FileScan:
    """What a file holds: from its summary if it has a sound one, else from a full walk."""

    path: Path
    size: int
    start: Mapping[str, str] = field(default_factory=dict)
    chain: str = ""
    finished: bool = False
    walked: bool = False
    summary: Summary = field(default_factory=Summary)
    places: list[ChunkPlace] = field(default_factory=list)
    indexed: int | None = None
    """How many messages the file was finished with, also where some are damaged now."""
    damage: list[Damage] = field(default_factory=list)


def scan(path: Path, *, walk: bool = False) -> FileScan:
    """Find the chunks of a file; ``walk`` distrusts the summary and checks every byte.

    Chunks of a walked journal of ours come in ``seq`` order even where pages were swapped.
    """
    with open_buffer(path) as data:
        start = _start_record(data)
        summary = read_summary(data)
        headless = summary is not None and not start and _tag_of(summary)
        if summary is None or walk or headless:
            return _from_walk(path, data, summary)
        return _from_summary(path, data, start, summary)


def start_record(path: Path) -> Mapping[str, str]:
    """Read what a journal file says about itself at its start; empty if it says nothing."""
    with path.open("rb") as file:
        return _start_record(file.read(1 << 16))


def _start_record(data: Buffer) -> Mapping[str, str]:
    walk = Walk(data[: 1 << 16], grows=True)
    for found in walk:
        if isinstance(found, Metadata) and found.name == START_METADATA:
            return found.values
        break
    return {}


def _from_summary(path: Path, data: Buffer, start: Mapping[str, str], summary: Summary) -> FileScan:
    places = [
        ChunkPlace(
            c.offset, c.start_ns, c.end_ns, (c.index_length - 15 * len(c.index_offsets)) // 16
        )
        for c in summary.chunks
    ]
    result = FileScan(path, len(data), start, finished=True, summary=summary, places=places)
    for offset, _, name in summary.metadata[-1:]:
        last = _metadata_at(data, offset)
        if last is not None and name == CHAIN_METADATA:
            result.chain = last.values.get("chain", "")
    return result


def _from_walk(path: Path, data: Buffer, summary: Summary | None) -> FileScan:
    result = FileScan(path, len(data), walked=True)
    walk = Walk(data)
    for found in walk:
        if isinstance(found, Damage):
            result.damage.append(found)
        elif isinstance(found, Metadata):
            _take_metadata(result, found)
        else:
            _take_chunk(result, found)
    result.finished = walk.finished
    if summary is not None:  # it has a checksum of its own: definitions whose chunks are damaged
        result.summary.schemas = {**summary.schemas, **result.summary.schemas}
        result.summary.channels = {**summary.channels, **result.summary.channels}
        result.indexed = summary.counts.total()
    if not result.start:
        result.start = _start_by_mark(result)
    if result.start:
        result.places = _in_order(result)
    return result


def _tag_of(summary: Summary) -> str:
    return next((c.metadata["run"] for c in summary.channels.values() if "run" in c.metadata), "")


def _start_by_mark(result: FileScan) -> Mapping[str, str]:
    """Tell from the mark of its chunks whose file this is, when its start is damaged."""
    parts = _tag_of(result.summary).split("-")
    if len(parts) != 3 or not result.places:
        return {}
    first = min(place.first_sequence or 0 for place in result.places)
    result.indexed = None  # of what stood before the first sound chunk nothing is known
    keys = ("store_id", "writer", "run", "first_seq")
    return dict(zip(keys, (*parts, str(first)), strict=True))


def _take_metadata(result: FileScan, found: Metadata) -> None:
    if found.name == START_METADATA:
        result.start = found.values
    elif found.name == CHAIN_METADATA:
        result.chain = found.values.get("chain", "")


def _take_chunk(result: FileScan, chunk: Chunk) -> None:
    summary = result.summary
    summary.schemas.update(chunk.schemas)
    summary.channels.update(chunk.channels)
    if not len(chunk):
        return
    numbers, counts = np.unique(chunk.channel, return_counts=True)
    for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
        summary.counts[number] += count
    first, last = int(chunk.log_ns.min()), int(chunk.log_ns.max())
    summary.start_ns = min(summary.start_ns, first) if result.places else first
    summary.end_ns = max(summary.end_ns, last)
    result.places.append(ChunkPlace(chunk.offset, first, last, len(chunk), int(chunk.sequence[0])))


def _in_order(result: FileScan) -> list[ChunkPlace]:
    """Order chunks by sequence and drop what a confused disk shows twice."""
    base = int(result.start.get("first_seq", 0))
    ordered, expected = [], 0
    for place in sorted(result.places, key=lambda p: ((p.first_sequence or 0) - base) & 0xFFFFFFFF):
        relative = ((place.first_sequence or 0) - base) & 0xFFFFFFFF
        if relative >= expected:
            ordered.append(place)
            expected = relative + place.count
    return ordered


def read_chunk(data: Buffer, place: ChunkPlace) -> Chunk | None:
    """Decode one chunk; None if its checksum refuses it."""
    walk = Walk(data, at=place.offset, grows=True)
    head = mcap.parse_chunk_head(data, place.offset)
    if head is not None:
        return walk._open(place.offset, place.offset + head.length)
    found = walk._loose_messages() if data[place.offset] in _LOOSE else None
    return found if isinstance(found, Chunk) else None


class open_buffer:  # noqa: N801  (used like a function in ``with``)
    """Map a file into memory; an empty file gives empty bytes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._map: mmap.mmap | None = None

    def __enter__(self) -> Buffer:
        with self.path.open("rb") as file:
            if self.path.stat().st_size == 0:
                return b""
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._view = memoryview(self._map)
        return self._view

    def __exit__(self, *_: object) -> None:
        if self._map is not None:
            with suppress(BufferError):  # an exception may still hold a slice of it
                self._view.release()
                self._map.close()
