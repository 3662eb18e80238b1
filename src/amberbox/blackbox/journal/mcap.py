"""MCAP records as bytes: what the journal writes and the scanner reads (see docs/format.md)."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from amberbox.core.types import Schema

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "amberbox"
START_METADATA = "amberbox/start"
CHAIN_METADATA = "amberbox/chain"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F

MESSAGE_HEAD = 31
"""Bytes before a message's data: opcode 1, length 8, channel 2, sequence 4, two times of 8."""

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
RECORD_HEAD = _RECORD.size


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel record; ``metadata`` says item, run and marks in files of ours."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Where a chunk lies in its file and what its head says."""

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
    """Frame one record."""
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


def channel_record(channel: Channel) -> bytes:
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


class Fields:
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
        inner = Fields(self.bytes())
        values = {}
        while inner.at < len(inner.data):
            key = inner.text()
            values[key] = inner.text()
        return values


@lru_cache(maxsize=1024)
def parse_schema(content: bytes) -> tuple[int, Schema]:
    """Read a schema record's content."""
    fields = Fields(content)
    schema_id = fields.number("H")
    return schema_id, Schema(fields.text(), fields.text(), fields.bytes())


@lru_cache(maxsize=4096)
def parse_channel(content: bytes) -> Channel:
    """Read a channel record's content; chunks repeat theirs, so that what was read is kept."""
    fields = Fields(content)
    return Channel(
        fields.number("H"), fields.number("H"), fields.text(), fields.text(), fields.text_map()
    )


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Read a metadata record's content."""
    fields = Fields(content)
    return fields.text(), fields.text_map()


def pairs(values: Sequence[tuple[int, int]], kinds: str) -> bytes:
    """Encode a map of two numbers, such as message counts per channel."""
    return sized(b"".join(struct.pack("<" + kinds, *pair) for pair in values))
