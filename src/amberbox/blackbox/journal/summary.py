"""The end of a finished journal file: chunk index, statistics, footer."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.mcap import Channel
from amberbox.core.types import Schema

FOOTER_SIZE = 9 + 20 + len(mcap.MAGIC)
_DATA_END_SIZE = 13
_INDEX_HEAD = struct.Struct("<QQQQI")
_INDEX_MIDDLE = struct.Struct("<QI")
_INDEX_OFFSET = struct.Struct("<HQ")
_INDEX_SIZES = struct.Struct("<QQ")


class IndexedChunk(NamedTuple):
    """One chunk's entry in the chunk index."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    index_offsets: Sequence[tuple[int, int]]
    index_length: int
    compression: str
    compressed_size: int
    size: int

    def encode(self) -> bytes:
        """Encode the chunk index record."""
        content = (
            struct.pack("<QQQQ", self.start_ns, self.end_ns, self.offset, self.length)
            + mcap.pairs(self.index_offsets, "HQ")
            + struct.pack("<Q", self.index_length)
            + mcap.text(self.compression)
            + struct.pack("<QQ", self.compressed_size, self.size)
        )
        return mcap.record(mcap.CHUNK_INDEX, content)


@dataclass(slots=True)
class Summary:
    """What a file's end says about the rest of it."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[IndexedChunk] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    start_ns: int = 0
    end_ns: int = 0

    def add_chunk(self, chunk: IndexedChunk) -> None:
        """Take a chunk that has been written."""
        first = not self.chunks
        self.start_ns = chunk.start_ns if first else min(self.start_ns, chunk.start_ns)
        self.end_ns = max(self.end_ns, chunk.end_ns)
        self.chunks.append(chunk)

    def encode(self, start: int) -> bytes:
        """Encode data end, summary section, summary offsets and footer, to stand at ``start``."""
        data_end = mcap.record(mcap.DATA_END, struct.pack("<I", 0))
        groups = {
            mcap.SCHEMA: [mcap.schema_record(i, s) for i, s in self.schemas.items()],
            mcap.CHANNEL: [mcap.channel_record(c) for c in self.channels.values()],
            mcap.STATISTICS: [self._statistics()],
            mcap.CHUNK_INDEX: [chunk.encode() for chunk in self.chunks],
            mcap.METADATA_INDEX: [_metadata_index(*entry) for entry in self.metadata],
        }
        return data_end + _with_footer(start + len(data_end), groups)

    def _statistics(self) -> bytes:
        numbers = struct.pack(
            "<QHIIIIQQ",
            sum(self.counts.values()),
            len(self.schemas),
            len(self.channels),
            0,
            len(self.metadata),
            len(self.chunks),
            self.start_ns,
            self.end_ns,
        )
        return mcap.record(mcap.STATISTICS, numbers + mcap.pairs(sorted(self.counts.items()), "HQ"))


def _metadata_index(offset: int, length: int, name: str) -> bytes:
    return mcap.record(mcap.METADATA_INDEX, struct.pack("<QQ", offset, length) + mcap.text(name))


def _with_footer(start: int, groups: Mapping[int, Sequence[bytes]]) -> bytes:
    parts, offsets, at = [], [], start
    for opcode, records in groups.items():
        body = b"".join(records)
        if body:
            offsets.append(
                mcap.record(mcap.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, len(body)))
            )
            parts.append(body)
            at += len(body)
    section = b"".join(parts + offsets)
    footer = struct.pack("<BQQQ", mcap.FOOTER, 20, start, at)
    crc = zlib.crc32(section + footer)
    return section + footer + struct.pack("<I", crc) + mcap.MAGIC


def read_summary(data: bytes | memoryview) -> Summary | None:
    """Read the summary of a whole file in memory; None if it is unfinished or its end damaged."""
    if len(data) < FOOTER_SIZE or bytes(data[-8:]) != mcap.MAGIC:
        return None
    opcode, length, start, _, crc = struct.unpack_from("<BQQQI", data, len(data) - FOOTER_SIZE)
    end = len(data) - FOOTER_SIZE
    if opcode != mcap.FOOTER or length != 20 or not 0 < start <= end:
        return None
    if crc and zlib.crc32(data[start : end + 25]) != crc:
        return None
    try:
        return _parse(data, start, end)
    except (ValueError, struct.error):
        return None


def is_finished(data: bytes | memoryview) -> bool:
    """Tell whether a file has a sound end; the format lets it be without a summary."""
    if read_summary(data) is not None:
        return True
    if len(data) < FOOTER_SIZE or bytes(data[-8:]) != mcap.MAGIC:
        return False
    opcode, length, start = struct.unpack_from("<BQQ", data, len(data) - FOOTER_SIZE)
    return (opcode, length, start) == (mcap.FOOTER, 20, 0)


def ends_of_data(data: bytes | memoryview) -> tuple[int, int]:
    """Return where the DataEnd record and the footer of a finished file must lie."""
    footer = len(data) - FOOTER_SIZE
    _, _, start = struct.unpack_from("<BQQ", data, footer)
    return (start or footer) - _DATA_END_SIZE, footer


def _parse(data: bytes | memoryview, start: int, end: int) -> Summary:
    summary, at = Summary(), start
    while at < end:
        opcode, length = struct.unpack_from("<BQ", data, at)
        _take(summary, opcode, bytes(data[at + 9 : at + 9 + length]))
        at += 9 + length
    return summary


def _take(summary: Summary, opcode: int, content: bytes) -> None:
    if opcode == mcap.SCHEMA:
        schema_id, schema = mcap.parse_schema(content)
        summary.schemas[schema_id] = schema
    elif opcode == mcap.CHANNEL:
        channel = mcap.parse_channel(content)
        summary.channels[channel.id] = channel
    elif opcode == mcap.CHUNK_INDEX:
        summary.chunks.append(_chunk_index(content))
    elif opcode == mcap.STATISTICS:
        _statistics(summary, content)
    elif opcode == mcap.METADATA_INDEX:
        fields = mcap.Fields(content)
        summary.metadata.append((fields.number("Q"), fields.number("Q"), fields.text()))


def _chunk_index(content: bytes) -> IndexedChunk:
    start_ns, end_ns, offset, length, map_size = _INDEX_HEAD.unpack_from(content)
    at = _INDEX_HEAD.size + map_size
    index_length, name_size = _INDEX_MIDDLE.unpack_from(content, at)
    offsets = list(_INDEX_OFFSET.iter_unpack(content[_INDEX_HEAD.size : at]))
    at += _INDEX_MIDDLE.size
    compression = content[at : at + name_size].decode()
    compressed_size, size = _INDEX_SIZES.unpack_from(content, at + name_size)
    return IndexedChunk(
        start_ns, end_ns, offset, length, offsets, index_length, compression, compressed_size, size
    )


def _statistics(summary: Summary, content: bytes) -> None:
    fields = mcap.Fields(content)
    for kind in "QHIIII":
        fields.number(kind)
    summary.start_ns, summary.end_ns = fields.number("Q"), fields.number("Q")
    summary.counts = Counter(dict(struct.iter_unpack("<HQ", fields.bytes())))
