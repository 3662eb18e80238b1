"""ROS 1 bags (format 2.0), finished or not, plain, bz2 or lz4; broken ones as far as they go.

The bag's own index is not needed: the records are walked one after the other, so that a bag whose
recorder was killed reads like any other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.blackbox.formats.compression import compression_of, unpack
from amberbox.blackbox.formats.recording import (
    Damage,
    Part,
    RecordedMessage,
    Recording,
    Report,
    Stretch,
    TopicTable,
)
from amberbox.blackbox.formats.ros1_chunk import (
    ChunkContent,
    read_chunk,
)
from amberbox.blackbox.formats.ros1_records import (
    BAG_HEADER,
    CHUNK,
    CONNECTION,
    INDEX,
    MESSAGE,
    Fields,
    Record,
    parse_fields,
    u32,
    walk,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

MAGIC = b"#ROSBAG V2.0\n"
_SMALLEST_CHUNK = 64
_LOOSE = "none"  # messages outside of any chunk read like those of an uncompressed one


@dataclass
class _Chunk:
    """A chunk's place and what the index records behind it say about it."""

    offset: int
    data_offset: int
    data_length: int
    compression: str
    unpacked_size: int
    is_loose: bool = False
    start_ns: int | None = None
    end_ns: int = 0
    expected: Counter[int] = field(default_factory=Counter)

    def covers(self, start_ns: int, end_ns: int) -> None:
        """Widen the range of time."""
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)


class _Bag:
    """A bag while it is scanned and read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = FileBytes(path)
        self.report = Report("ROS 1 bag")
        self.chunks: list[_Chunk] = []
        self.connections: dict[int, Fields] = {}
        self.topics: list[Topic] = []
        self.topic_of: dict[int, int] = {}
        self.index_at: int | None = None
        self.chunk_count = 0

    def damaged(self, offset: int, length: int, reason: str) -> None:
        self.report.add_damage(Damage(self.path.name, offset, length, reason))

    def _skipped(self, offset: int, length: int, reason: str) -> None:
        # some writers leave a few zero bytes before the index, where no record has room
        is_padding = length < _SMALLEST_CHUNK and offset + length == self.index_at
        if is_padding and not any(self.file.read(offset, length)):
            self.report.add_note(f"{length} unused bytes before the index")
        else:
            self.damaged(offset, length, reason)

    def scan(self) -> None:
        """Find chunks and connections; look into a chunk only where the index is incomplete."""
        for record in walk(self.file, len(MAGIC), self._skipped):
            self._note(record)
        self._check_complete()
        for chunk in self.chunks:
            if chunk.start_ns is None or not self.connections.keys() >= chunk.expected.keys():
                self._look_into(chunk)
        self.chunks = [chunk for chunk in self.chunks if chunk.start_ns is not None]
        places = [
            Stretch(c.offset, c.data_offset + c.data_length, c.start_ns or 0, c.end_ns)
            for c in self.chunks
        ]
        self.report.damage = [damage.between(places) for damage in self.report.damage]
        self._make_topics()

    def _note(self, record: Record) -> None:
        if record.operation == CHUNK:
            self.chunks.append(_chunk_at(record))
        elif record.operation == INDEX and self.chunks:
            self._note_index(record, self.chunks[-1])
        elif record.operation == CONNECTION:
            self._note_connection(record)
        elif record.operation == MESSAGE:
            self._note_loose(record)
        elif record.operation == BAG_HEADER:
            self._check_header(record.fields)

    def _check_header(self, fields: Fields) -> None:
        encryptor = fields.get(b"encryptor", b"").decode(errors="replace")
        if encryptor not in ("", "rosbag/NoEncryptor"):
            raise AmberboxError(
                f"{self.path} is encrypted ({encryptor})",
                "decrypt it first: rosbag decompress with the key at hand",
            )
        self.index_at = int.from_bytes(fields[b"index_pos"], "little")
        self.chunk_count = u32(fields[b"chunk_count"])
        if not self.index_at:
            self.report.add_note("the bag was never closed; it has no index")

    def _check_complete(self) -> None:
        """Compare what was found with what the bag's header promises."""
        size = self.file.size
        if self.index_at is None:
            self.damaged(len(MAGIC), size - len(MAGIC), "the bag's header is missing")
        elif self.index_at > size:
            self.damaged(size, self.index_at - size, "the file is cut short")
        found = sum(not chunk.is_loose for chunk in self.chunks)
        if found < self.chunk_count:
            self.damaged(
                0, size, f"{self.chunk_count - found} of {self.chunk_count} chunks missing"
            )

    def _note_index(self, record: Record, chunk: _Chunk) -> None:
        data = self.file.read(record.data_offset, record.data_length)
        count = u32(record.fields[b"count"])
        if not count or len(data) != 12 * count or chunk.is_loose:
            return
        entries = np.frombuffer(data, "<u4").reshape(-1, 3).astype(np.int64)
        times = entries[:, 0] * 1_000_000_000 + entries[:, 1]
        chunk.covers(int(times.min()), int(times.max()))
        chunk.expected[u32(record.fields[b"conn"])] += count

    def _note_connection(self, record: Record) -> None:
        fields = parse_fields(self.file.read(record.data_offset, record.data_length))
        if fields is None:
            self.damaged(record.offset, record.end - record.offset, "unreadable connection")
        else:
            number = u32(record.fields[b"conn"])
            self.connections[number] = {**fields, b"topic": record.fields[b"topic"]}

    def _note_loose(self, record: Record) -> None:
        last = self.chunks[-1] if self.chunks else None
        if (
            last is None
            or not last.is_loose
            or last.data_offset + last.data_length != record.offset
        ):
            length = record.end - record.offset
            chunk = _Chunk(record.offset, record.offset, length, _LOOSE, length, is_loose=True)
            self.chunks.append(chunk)
        else:
            last.data_length = last.unpacked_size = record.end - last.data_offset

    def _look_into(self, chunk: _Chunk) -> None:
        content = self._read(chunk, {})
        for number, fields in content.connections.items():
            self.connections.setdefault(number, fields)
        times = [message.log_time_ns for message in content.messages]
        if times:
            chunk.covers(min(times), max(times))

    def _make_topics(self) -> None:
        table = TopicTable()
        for number, fields in sorted(self.connections.items()):
            self.topic_of[number] = table.add(_topic_of(fields))
        self.topics = table.topics

    def _read(self, chunk: _Chunk, topic_of: Mapping[int, int]) -> ChunkContent:
        data = self.file.read(chunk.data_offset, chunk.data_length)
        raw, problem = unpack(chunk.compression, data, chunk.unpacked_size)
        if not raw and (seen := compression_of(data)) != chunk.compression:
            raw, _ = unpack(seen, data, chunk.unpacked_size)
        if problem:
            self.damaged(chunk.offset, self._length(chunk), f"chunk {problem}")
        content = read_chunk(raw, topic_of)
        for offset, length, reason in content.damage:
            self._damaged_inside(chunk, offset, length, reason)
        return content

    def _damaged_inside(self, chunk: _Chunk, offset: int, length: int, reason: str) -> None:
        if chunk.compression == "none":
            self.damaged(chunk.data_offset + offset, length, reason)
        else:
            where = f"bytes {offset} to {offset + length} of the unpacked chunk"
            self.damaged(chunk.offset, self._length(chunk), f"{where}: {reason}")

    def _length(self, chunk: _Chunk) -> int:
        return chunk.data_offset + chunk.data_length - chunk.offset

    def load(self, chunk: _Chunk) -> list[RecordedMessage]:
        """Read the messages of a chunk and compare their number with the index."""
        messages = self._read(chunk, self.topic_of).messages
        missing = chunk.expected.total() - len(messages)
        if missing > 0:
            self.damaged(chunk.offset, self._length(chunk), f"{missing} messages are missing")
        known = [message for message in messages if message.topic_index >= 0]
        if len(known) < len(messages):
            lost = len(messages) - len(known)
            reason = f"{lost} messages of unknown connections"
            self.damaged(chunk.offset, self._length(chunk), reason)
        return known


def _chunk_at(record: Record) -> _Chunk:
    compression = record.fields[b"compression"].decode(errors="replace")
    size = u32(record.fields[b"size"])
    return _Chunk(record.offset, record.data_offset, record.data_length, compression, size)


def _topic_of(fields: Fields) -> Topic:
    text = {name: fields.get(name, b"").decode(errors="replace") for name in (b"topic", b"type")}
    schema = Schema(text[b"type"], "ros1msg", fields.get(b"message_definition", b""))
    return Topic(text[b"topic"], "ros1", schema, fields.get(b"latching") == b"1")


def open_ros1_bag(path: Path) -> Recording:
    """Open a ROS 1 bag; raises AmberboxError where nothing at all can be read."""
    bag = _Bag(path)
    try:
        bag.scan()
    except BaseException:
        bag.file.close()
        raise
    parts = [
        Part(chunk.start_ns or 0, chunk.end_ns, chunk.data_length, partial(bag.load, chunk))
        for chunk in bag.chunks
    ]
    return Recording(path, bag.topics, parts, bag.report, bag.file.close)
