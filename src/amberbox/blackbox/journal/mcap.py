"""MCAP records as bytes, for writing and scanning (see docs/reference/format.md).

The summary at the end of a finished file holds the chunk index, statistics and the footer.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from amberbox.core.types import Schema

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "amberbox"
START_METADATA = "amberbox/start"
CHAIN_METADATA = "amberbox/chain"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F

# bytes before a message's data: opcode 1, length 8, channel 2, sequence 4, two times of 8
MESSAGE_HEAD = 31

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
RECORD_HEAD = _RECORD.size


@dataclass(frozen=True, slots=True)
class McapChannel:
    """A channel record; in journals of ours ``metadata`` holds item, source and run."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Place of a chunk in its file, and the fields of its head."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_offset: int
    data_length: int


def record(opcode: int, content: bytes) -> bytes:
    """Return the bytes of one record."""
    return _RECORD.pack(opcode, len(content)) + content


def text(value: str) -> bytes:
    """Encode a string with its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def text_map(values: Mapping[str, str]) -> bytes:
    """Encode a map of strings."""
    return sized(b"".join(text(key) + text(value) for key, value in values.items()))


def sized(data: bytes) -> bytes:
    """Encode bytes with a 32-bit length."""
    return struct.pack("<I", len(data)) + data


def header(profile: str) -> bytes:
    """Encode the header record."""
    return record(HEADER, text(profile) + text(LIBRARY))


def schema_record(schema_id: int, schema: Schema) -> bytes:
    """Encode a schema record."""
    body = text(schema.name) + text(schema.encoding) + sized(schema.data)
    return record(SCHEMA, struct.pack("<H", schema_id) + body)


def channel_record(channel: McapChannel) -> bytes:
    """Encode a channel record."""
    body = text(channel.topic) + text(channel.message_encoding) + text_map(channel.metadata)
    return record(CHANNEL, struct.pack("<HH", channel.id, channel.schema_id) + body)


def metadata_record(name: str, values: Mapping[str, str]) -> bytes:
    """Encode a metadata record."""
    return record(METADATA, text(name) + text_map(values))


def chunk_record(
    start_ns: int, end_ns: int, size: int, crc: int, compression: str, data: bytes
) -> bytes:
    """Encode a chunk record around records that are already compressed."""
    head = _CHUNK.pack(start_ns, end_ns, size, crc) + text(compression)
    return b"".join(
        (
            _RECORD.pack(CHUNK, len(head) + 8 + len(data)),
            head,
            struct.pack("<Q", len(data)),
            data,
        )
    )


def message_index_record(channel: int, entries: bytes) -> bytes:
    """Encode a message index; ``entries`` are (log time, offset) pairs of 16 bytes."""
    return (
        _RECORD.pack(MESSAGE_INDEX, 6 + len(entries))
        + struct.pack("<HI", channel, len(entries))
        + entries
    )


def parse_chunk_head(buffer: bytes | memoryview, offset: int) -> ChunkHead | None:
    """Read a chunk's head at ``offset``; None if it does not fit together."""
    try:
        opcode, length = _RECORD.unpack_from(buffer, offset)
        start_ns, end_ns, size, crc = _CHUNK.unpack_from(buffer, offset + RECORD_HEAD)
        (name_length,) = struct.unpack_from("<I", buffer, offset + 37)
        if opcode != CHUNK or name_length > 16:
            return None
        name = bytes(buffer[offset + 41 : offset + 41 + name_length])
        (data_length,) = struct.unpack_from("<Q", buffer, offset + 41 + name_length)
        if length != 40 + name_length + data_length:
            return None
        compression = name.decode("ascii")
    except (struct.error, UnicodeDecodeError):
        return None
    data_offset = offset + 49 + name_length
    return ChunkHead(
        offset, RECORD_HEAD + length, start_ns, end_ns, size, crc, compression, data_offset,
        data_length,
    )  # fmt: skip


class RecordFields:
    """Reads the fields of one record's content in order."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def number(self, kind: str) -> int:
        """Read one little-endian number of a struct format character."""
        (value,) = struct.unpack_from("<" + kind, self.data, self.at)
        self.at += struct.calcsize("<" + kind)
        return int(value)

    def bytes(self) -> bytes:
        """Read bytes with a 32-bit length."""
        size = self.number("I")
        if self.at + size > len(self.data):
            raise ValueError("a length points past the end of its record")
        self.at += size
        return self.data[self.at - size : self.at]

    def text(self) -> str:
        """Read a string."""
        return self.bytes().decode()

    def text_map(self) -> dict[str, str]:
        """Read a map of strings."""
        inner = RecordFields(self.bytes())
        values = {}
        while inner.at < len(inner.data):
            key = inner.text()
            values[key] = inner.text()
        return values


@lru_cache(maxsize=1024)
def parse_schema(content: bytes) -> tuple[int, Schema]:
    """Read a schema record's content."""
    fields = RecordFields(content)
    schema_id = fields.number("H")
    return schema_id, Schema(fields.text(), fields.text(), fields.bytes())


@lru_cache(maxsize=4096)
def parse_channel(content: bytes) -> McapChannel:
    """Parse a channel record's content; results are cached, since chunks repeat their records."""
    fields = RecordFields(content)
    return McapChannel(
        fields.number("H"), fields.number("H"), fields.text(), fields.text(), fields.text_map()
    )


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Read a metadata record's content."""
    fields = RecordFields(content)
    return fields.text(), fields.text_map()


def pairs(values: Sequence[tuple[int, int]], kinds: str) -> bytes:
    """Encode a map of two numbers, such as message counts per channel."""
    return sized(b"".join(struct.pack("<" + kinds, *pair) for pair in values))


FOOTER_SIZE = 9 + 20 + len(MAGIC)
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
            + pairs(self.index_offsets, "HQ")
            + struct.pack("<Q", self.index_length)
            + text(self.compression)
            + struct.pack("<QQ", self.compressed_size, self.size)
        )
        return record(CHUNK_INDEX, content)


@dataclass(slots=True)
class McapSummary:
    """The summary section of an MCAP file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, McapChannel] = field(default_factory=dict)
    chunks: list[IndexedChunk] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    start_ns: int = 0
    end_ns: int = 0

    def add_chunk(self, chunk: IndexedChunk) -> None:
        """Add a chunk that has been written."""
        first = not self.chunks
        self.start_ns = chunk.start_ns if first else min(self.start_ns, chunk.start_ns)
        self.end_ns = max(self.end_ns, chunk.end_ns)
        self.chunks.append(chunk)

    def encode(self, start: int) -> bytes:
        """Encode data end, summary section, summary offsets and footer, for position ``start``."""
        data_end = record(DATA_END, struct.pack("<I", 0))
        groups = {
            SCHEMA: [schema_record(i, s) for i, s in self.schemas.items()],
            CHANNEL: [channel_record(c) for c in self.channels.values()],
            STATISTICS: [self._statistics()],
            CHUNK_INDEX: [chunk.encode() for chunk in self.chunks],
            METADATA_INDEX: [
                record(METADATA_INDEX, struct.pack("<QQ", offset, length) + text(name))
                for offset, length, name in self.metadata
            ],
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
        return record(STATISTICS, numbers + pairs(sorted(self.counts.items()), "HQ"))


def _with_footer(start: int, groups: Mapping[int, Sequence[bytes]]) -> bytes:
    parts, offsets, at = [], [], start
    for opcode, records in groups.items():
        body = b"".join(records)
        if body:
            offsets.append(record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, len(body))))
            parts.append(body)
            at += len(body)
    section = b"".join(parts + offsets)
    footer = struct.pack("<BQQQ", FOOTER, 20, start, at)
    crc = zlib.crc32(section + footer)
    return section + footer + struct.pack("<I", crc) + MAGIC


def read_summary(data: bytes | memoryview) -> McapSummary | None:
    """Read the summary of a whole file in memory; None if it is unfinished or its end damaged."""
    if len(data) < FOOTER_SIZE or bytes(data[-8:]) != MAGIC:
        return None
    opcode, length, start, _, crc = struct.unpack_from("<BQQQI", data, len(data) - FOOTER_SIZE)
    end = len(data) - FOOTER_SIZE
    if opcode != FOOTER or length != 20 or not 0 < start <= end:
        return None
    if crc and zlib.crc32(data[start : end + 25]) != crc:
        return None
    try:
        return _parse(data, start, end)
    except (ValueError, struct.error):
        return None


def is_finished(data: bytes | memoryview) -> bool:
    """Return whether a file has a valid footer; the format allows one without a summary."""
    if read_summary(data) is not None:
        return True
    if len(data) < FOOTER_SIZE or bytes(data[-8:]) != MAGIC:
        return False
    opcode, length, start = struct.unpack_from("<BQQ", data, len(data) - FOOTER_SIZE)
    return (opcode, length, start) == (FOOTER, 20, 0)


def ends_of_data(data: bytes | memoryview) -> tuple[int, int]:
    """Return the required offsets of the DataEnd record and the footer of a finished file."""
    footer = len(data) - FOOTER_SIZE
    _, _, start = struct.unpack_from("<BQQ", data, footer)
    return (start or footer) - _DATA_END_SIZE, footer


def _parse(data: bytes | memoryview, start: int, end: int) -> McapSummary:
    summary, at = McapSummary(), start
    while at < end:
        opcode, length = struct.unpack_from("<BQ", data, at)
        _take(summary, opcode, bytes(data[at + 9 : at + 9 + length]))
        at += 9 + length
    return summary


def _take(summary: McapSummary, opcode: int, content: bytes) -> None:
    if opcode == SCHEMA:
        schema_id, schema = parse_schema(content)
        summary.schemas[schema_id] = schema
    elif opcode == CHANNEL:
        channel = parse_channel(content)
        summary.channels[channel.id] = channel
    elif opcode == CHUNK_INDEX:
        summary.chunks.append(_chunk_index(content))
    elif opcode == STATISTICS:
        _statistics(summary, content)
    elif opcode == METADATA_INDEX:
        fields = RecordFields(content)
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


def _statistics(summary: McapSummary, content: bytes) -> None:
    fields = RecordFields(content)
    for kind in "QHIIII":
        fields.number(kind)
    summary.start_ns, summary.end_ns = fields.number("Q"), fields.number("Q")
    summary.counts = Counter(dict(struct.iter_unpack("<HQ", fields.bytes())))
