"""An MCAP file that is written in one go: chunks with indices, and a summary at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import BinaryIO

import zstandard

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.frame import Packed, Rows, chunk_slices, pack
from amberbox.blackbox.journal.mcap import Channel
from amberbox.blackbox.journal.summary import Summary
from amberbox.core.types import Schema, Topic

_LEVEL = 1


class McapFile:
    """Writes messages to an open file. Definitions stand in the first chunk that needs them."""

    def __init__(self, file: BinaryIO, profile: str) -> None:
        self._file = file
        self._zstd = zstandard.ZstdCompressor(level=_LEVEL, write_content_size=True)
        self._schemas: dict[Schema, int] = {}
        self._channels: list[Channel] = []
        self._summary = Summary()
        self._size = 0
        self._append(mcap.MAGIC + mcap.header(profile))

    def channel(self, topic: Topic, metadata: Mapping[str, str]) -> int:
        """Register a channel and return its number."""
        schema_id = 0
        if topic.schema is not None:
            schema_id = self._schemas.setdefault(topic.schema, len(self._schemas) + 1)
        number = len(self._channels)
        self._channels.append(
            Channel(number, schema_id, topic.name, topic.message_encoding, metadata)
        )
        return number

    def write(self, rows: Rows) -> None:
        """Write messages in their order."""
        for part in chunk_slices(rows.messages):
            packed = pack(rows.take(part), self._definitions, self._zstd)
            offset = self._size
            self._append(b"".join([packed.chunk, *packed.indices]))
            self._note(packed, offset)

    def close(self) -> None:
        """Write the end of the file; the file itself stays open."""
        for channel in self._channels:  # also those without a message
            self._define(channel)
        self._append(self._summary.encode(self._size))

    def _definitions(self, used: Sequence[int], _now_ns: int) -> bytes:
        new = [self._channels[n] for n in used if n not in self._summary.channels]
        return b"".join(self._define(channel) for channel in new)

    def _define(self, channel: Channel) -> bytes:
        records = []
        if channel.schema_id and channel.schema_id not in self._summary.schemas:
            schema = list(self._schemas)[channel.schema_id - 1]
            self._summary.schemas[channel.schema_id] = schema
            records.append(mcap.schema_record(channel.schema_id, schema))
        self._summary.channels[channel.id] = channel
        return b"".join([*records, mcap.channel_record(channel)])

    def _note(self, packed: Packed, offset: int) -> None:
        for number, count in zip(packed.channels, packed.counts, strict=True):
            self._summary.counts[number] += count
        self._summary.add_chunk(packed.indexed(offset))

    def _append(self, data: bytes) -> None:
        self._file.write(data)
        self._size += len(data)
