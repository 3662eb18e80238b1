"""Read a journal without unpacking each chunk: by its message indices, or chunks in groups.

A file that is being written has no summary yet, but each chunk is followed by its message index
records: they state the number of messages of each channel, their log times and their lengths.
``GrowingIndex`` unpacks only chunks that introduce a channel and checks no checksum.
``read_in_groups`` unpacks many small chunks as one, with the same checks as one by one.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zstandard

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.chunk import (
    MAX_CHUNK_BYTES,
    Buffer,
    Chunk,
    decompress,
    is_definitions_only,
    open_buffer,
    open_joined_chunks,
)
from amberbox.blackbox.journal.mcap import (
    CHAIN_METADATA,
    MESSAGE_HEAD,
    START_METADATA,
    ChunkHead,
    McapChannel,
    McapSummary,
)
from amberbox.blackbox.journal.scan import (
    ChannelTally,
    ChunkPlace,
    FileScan,
    MetadataRecord,
    chunk_at,
    index_entries,
    merge_tallies,
    metadata_at,
    tally,
)
from amberbox.blackbox.journal.tail import read_head
from amberbox.core.types import IntArray, Schema

_CHUNKS = 64
_BYTES = 4 << 20


def read_in_groups(data: Buffer, places: Iterable[ChunkPlace]) -> Iterator[Chunk | None]:
    """Yield the chunks in order, many joined into one; None for a damaged one.

    A joined chunk has no definitions.
    """
    for group in _groups(data, places):
        joined = _joined(data, [head for _, head in group if head is not None])
        if joined is not None and all(head is not None for _, head in group):
            yield joined
        else:
            yield from (chunk_at(data, place.offset) for place, _ in group)


def _groups(
    data: Buffer, places: Iterable[ChunkPlace]
) -> Iterator[list[tuple[ChunkPlace, ChunkHead | None]]]:
    group: list[tuple[ChunkPlace, ChunkHead | None]] = []
    size = 0
    for place in places:
        head = mcap.parse_chunk_head(data, place.offset)
        size += head.size if head is not None else 0
        if group and (size > _BYTES or len(group) == _CHUNKS):
            yield group
            group, size = [], head.size if head is not None else 0
        group.append((place, head))
    if group:
        yield group


def _joined(data: Buffer, heads: Sequence[ChunkHead]) -> Chunk | None:
    """Read chunks as one; None if one of them has to be read alone."""
    if len(heads) < 2:
        return None
    zstd = zstandard.ZstdDecompressor()
    bodies, entries, counts = list[bytes](), list[Buffer](), list[int]()
    for head in heads:
        body = decompress(head, data, zstd)
        if body is None:
            return None
        bodies.append(body)
        found, end = index_entries(data, head.offset + head.length)
        if end + 15 <= len(data) and data[end] == mcap.MESSAGE_INDEX:  # a damaged index
            return None
        entries += found
        counts.append(sum(map(len, found)) // 16)
    if not all(counts):
        return None
    offsets = np.frombuffer(b"".join(entries), "<i8")[1::2]
    bounds = np.cumsum([0, *map(len, bodies)])
    if int(offsets.min()) < 0 or bool((offsets >= np.repeat(np.diff(bounds), counts)).any()):
        return None
    starts = np.sort(offsets + np.repeat(bounds[:-1], counts))
    firsts = np.cumsum([0, *counts[:-1]])
    begins = (starts[firsts] - bounds[:-1]).tolist()
    if not all(
        is_definitions_only(body[:begin]) for body, begin in zip(bodies, begins, strict=True)
    ):
        return None
    return open_joined_chunks(b"".join(bodies), starts, bounds[1:], firsts, heads[0].offset)


_RECORD = struct.Struct("<BQ").unpack_from
_CHUNK = struct.Struct("<QQQ").unpack_from
_GROWING_INDEX = struct.Struct("<HI").unpack_from
_CHUNK_HEAD, _INDEX_HEAD = 24, 6


class UnindexedError(Exception):
    """Raised for a file with records other than our writer's: its chunks have to be read."""


@dataclass(slots=True)
class _Records:
    """Chunk heads and message index records in the order of the file."""

    offsets: list[int] = field(default_factory=list)
    starts_ns: list[int] = field(default_factory=list)
    ends_ns: list[int] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    # number of each chunk's first message index record
    firsts: list[int] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)
    # bytes of the entries of each message index record
    lengths: list[int] = field(default_factory=list)
    entries: bytes = b""  # log time and offset of each message, record by record

    def drop_last(self) -> None:
        """Remove the last chunk."""
        first = self.firsts.pop()
        for column in (self.offsets, self.starts_ns, self.ends_ns, self.sizes):
            column.pop()
        for index in (self.channels, self.lengths):
            del index[first:]
        self.entries = self.entries[: sum(self.lengths)]

    def places(self) -> list[ChunkPlace]:
        """Return the places of the chunks."""
        known: dict[tuple[int, ...], tuple[int, ...]] = {}
        bounds = [*self.firsts, len(self.channels)]
        found = []
        for number, offset in enumerate(self.offsets):
            part = slice(bounds[number], bounds[number + 1])
            channels = tuple(self.channels[part])
            channels = known.setdefault(channels, channels)
            found.append(ChunkPlace(
                offset, self.starts_ns[number], self.ends_ns[number],
                sum(self.lengths[part]) // 16, None, channels,
            ))  # fmt: skip
        return found

    def tallies(self) -> dict[int, ChannelTally]:
        """Return the messages of the chunks counted by channel.

        Raises UnindexedError when the entries cannot be those of their chunks.
        """
        if not self.entries:
            return {}
        if len(self.firsts) != len(set(self.firsts)) or self.firsts[-1] == len(self.channels):
            raise UnindexedError("chunk without a message index")
        if max(self.sizes) > MAX_CHUNK_BYTES or max(*self.starts_ns, *self.ends_ns) >= 1 << 63:
            raise UnindexedError("chunk head")
        log_ns, offsets = np.frombuffer(self.entries, "<i8").reshape(-1, 2).T
        counts = np.array(self.lengths, np.int64) // 16
        begins = np.cumsum(counts) - counts
        of_chunk = np.repeat(
            np.arange(len(self.offsets)), np.diff([*self.firsts, len(self.channels)])
        )
        first_ns, last_ns = (f.reduceat(log_ns, begins) for f in (np.minimum, np.maximum))
        starts, ends = np.array(self.starts_ns)[of_chunk], np.array(self.ends_ns)[of_chunk]
        if bool(((first_ns < starts) | (last_ns > ends)).any()):
            raise UnindexedError("message index")
        bounds = np.cumsum([0, *self.sizes])
        inside = offsets + np.repeat(bounds[of_chunk], counts)
        if bool((offsets < 0).any() or (inside >= np.repeat(bounds[of_chunk + 1], counts)).any()):
            raise UnindexedError("message index")
        sizes = np.add.reduceat(_message_sizes(inside, bounds), begins)
        numbers = np.array(self.channels, np.uint16)
        return tally(numbers, first_ns, last_ns, sizes, counts)


def _message_sizes(begins: IntArray, bounds: IntArray) -> IntArray:
    """Return the sizes of messages from their offsets; the messages have to be adjacent.

    All offsets count from the first chunk's first byte; ``bounds`` are those at which the chunks
    begin and end.
    """
    order = np.argsort(begins, kind="stable")  # they come in long runs that are in order
    begin = begins[order]
    following = np.append(begin[1:], bounds[-1])
    lasts = np.searchsorted(begin, bounds[1:]) - 1
    following[lasts] = bounds[1:]
    sizes = np.empty(len(order), np.int64)
    sizes[order] = following - begin - MESSAGE_HEAD
    if int(sizes.min()) < 0:
        raise UnindexedError("message index")
    return sizes


class GrowingIndex:
    """The index of one file that grows; ``read`` continues where it ended."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0
        self._start: dict[str, str] = {}
        self._chain = ""
        self._places: list[ChunkPlace] = []
        self._tallies: dict[int, ChannelTally] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, McapChannel] = {}
        self._defined: set[tuple[int, ...]] = set()
        self._times_ns = 0, 0

    def read(self) -> FileScan:
        """Read the added bytes, and return a scan of the whole file.

        Raises UnindexedError for a file that is not whole up to its writer's position.
        """
        head = read_head(self._path.parent)  # before the file, which then has all of it
        written = head.size if head is not None and head.file == self._path.name else None
        with open_buffer(self._path) as data:
            if len(data) < self._at:
                raise UnindexedError("shorter than before")
            self._take(data)
            rest = bytes(data[self._at : self._at + 1])
            if rest and (written is None or self._at < written or rest[0] == mcap.DATA_END):
                raise UnindexedError("not whole, or just being finished")
            return self._found(len(data))

    def _found(self, size: int) -> FileScan:
        counts = Counter({number: one.rows for number, one in self._tallies.items()})
        first_ns, last_ns = self._times_ns
        summary = McapSummary(
            dict(self._schemas), dict(self._channels), counts=counts,
            start_ns=first_ns, end_ns=last_ns,
        )  # fmt: skip
        return FileScan(
            self._path, size, dict(self._start), self._chain, summary=summary,
            places=list(self._places), tallies=dict(self._tallies),
        )  # fmt: skip

    def _take(self, data: Buffer) -> None:
        records, at = _records(data, self._at, self._note)
        if records.offsets and not _is_whole(data, records):
            at = records.offsets[-1]
            records.drop_last()
        places, tallies = records.places(), records.tallies()
        for place in places:
            self._define(data, place)
        if places:
            known = self._times_ns if self._places else (places[0].start_ns, places[0].end_ns)
            self._times_ns = min(known[0], *records.starts_ns), max(known[1], *records.ends_ns)
        self._places += places
        self._tallies = merge_tallies([self._tallies, tallies])
        self._at = at

    def _note(self, found: MetadataRecord) -> None:
        """Set the start record, or the newest link of the hash chain."""
        if found.name == START_METADATA:
            self._start = dict(found.values)
        elif found.name == CHAIN_METADATA:
            self._chain = found.values.get("chain", "")

    def _define(self, data: Buffer, place: ChunkPlace) -> None:
        """Read the definitions of a chunk with a channel that is not known yet."""
        assert place.channels is not None
        if place.channels in self._defined:
            return
        if not all(number in self._channels for number in place.channels):
            chunk = chunk_at(data, place.offset)
            if chunk is None:
                raise UnindexedError("chunk")
            self._schemas.update(chunk.schemas)
            self._channels.update(chunk.channels)
        known = (self._channels.get(number) for number in place.channels)
        if not all(c and (not c.schema_id or c.schema_id in self._schemas) for c in known):
            raise UnindexedError("definitions")
        self._defined.add(place.channels)


def _records(
    data: Buffer, at: int, note: Callable[[MetadataRecord], None] = lambda found: None
) -> tuple[_Records, int]:
    """Read the heads of all whole records from ``at`` on; return also where they end."""
    found, entries, size = _Records(), [], len(data)
    if at == 0:
        if bytes(data[: len(mcap.MAGIC)]) != mcap.MAGIC:
            raise UnindexedError("no MCAP magic")
        at = len(mcap.MAGIC)
    while at + 9 <= size:
        opcode, length = _RECORD(data, at)
        end = at + 9 + length
        if end > size or opcode == mcap.DATA_END:
            break
        if opcode == mcap.MESSAGE_INDEX and length >= _INDEX_HEAD:
            number, count = _GROWING_INDEX(data, at + 9)
            if count != length - 6 or count % 16 or not count or not found.offsets:
                raise UnindexedError("message index")
            found.channels.append(number)
            found.lengths.append(count)
            entries.append(data[at + 15 : end])
        elif opcode == mcap.CHUNK and length >= _CHUNK_HEAD:
            start_ns, end_ns, unpacked = _CHUNK(data, at + 9)
            found.offsets.append(at)
            found.starts_ns.append(start_ns)
            found.ends_ns.append(end_ns)
            found.sizes.append(unpacked)
            found.firsts.append(len(found.channels))
        else:
            # Process the records between chunks.
            metadata = metadata_at(data, at) if opcode == mcap.METADATA else None
            if metadata is not None:
                note(metadata)
            elif opcode != mcap.HEADER:
                raise UnindexedError(f"record {opcode}")
        at = end
    found.entries = b"".join(entries)
    return found, at


def _is_whole(data: Buffer, records: _Records) -> bool:
    """Return whether the last chunk's index is complete: it may be being written."""
    chunk = chunk_at(data, records.offsets[-1])
    return chunk is not None and len(chunk) == sum(records.lengths[records.firsts[-1] :]) // 16


def count_messages(path: Path) -> dict[int, ChannelTally]:
    """Count a finished file's messages by channel, by their index.

    Raises UnindexedError where the index does not fit.
    """
    with open_buffer(path) as data:
        return _records(data, 0)[0].tallies()
