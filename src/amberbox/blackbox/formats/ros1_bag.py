"""ROS 1 bags (format 2.0), finished or not, plain, bz2 or lz4; broken ones as far as they go.

The bag's own index is not needed: the records are walked one after the other, so that a bag whose
recorder was killed reads like any other. A record is ``<u32 header length> <header> <u32 data
length> <data>``; a header is a row of ``<u32 length> name=value`` fields
(http://wiki.ros.org/Bags/Format/2.0).
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

import numpy as np

from amberbox.blackbox.formats._recording import (
    ByteSource,
    FileBytes,
    MemoryBytes,
    ReadableRange,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicTable,
    compression_of,
    unpack,
)
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
_ANY = frozenset(range(MESSAGE, CONNECTION + 1))

# per operation: the fields a header must have, and their lengths (0: any)
_REQUIRED: Mapping[int, Mapping[bytes, int]] = {
    MESSAGE: {b"conn": 4, b"time": 8},
    BAG_HEADER: {b"index_pos": 8, b"conn_count": 4, b"chunk_count": 4},
    INDEX: {b"ver": 4, b"conn": 4, b"count": 4},
    CHUNK: {b"compression": 0, b"size": 4},
    CHUNK_INFO: {b"ver": 4, b"chunk_pos": 8, b"start_time": 8, b"end_time": 8, b"count": 4},
    CONNECTION: {b"conn": 4, b"topic": 0},
}
_MAX_HEADER = 1 << 16
_LOOK_BACK = 256  # bytes between a record's start and its "op=" field in all known writers
_BLOCK = 1 << 20
_OPERATION = re.compile(rb"op=[\x02-\x07]")

HeaderFields = Mapping[bytes, bytes]
OnDamage = Callable[[int, int, str], None]  # called with offset, length and reason


class BagRecord(NamedTuple):
    """A record's header fields and the offset of its data; ``end`` may be beyond the end of the
    file.
    """

    offset: int
    operation: int
    fields: HeaderFields
    data_offset: int
    data_length: int

    @property
    def end(self) -> int:
        return self.data_offset + self.data_length


def parse_fields(header: bytes) -> dict[bytes, bytes] | None:
    """Split a header into its fields; None if it is not one."""
    fields: dict[bytes, bytes] = {}
    offset = 0
    while offset < len(header):
        if offset + 4 > len(header):
            return None
        length = int.from_bytes(header[offset : offset + 4], "little")
        field = header[offset + 4 : offset + 4 + length]
        name, equals, value = field.partition(b"=")
        if len(field) < length or not equals:
            return None
        fields[name] = value
        offset += 4 + length
    return fields


def read_record(source: ByteSource, offset: int) -> BagRecord | None:
    """Read the header of the record that starts at ``offset``; None if none does."""
    head = source.read(offset, 256)
    try:
        (length,) = struct.unpack_from("<I", head)
        if length > _MAX_HEADER:
            return None
        if len(head) < length + 8:
            head = source.read(offset, length + 8)
        (data_length,) = struct.unpack_from("<I", head, length + 4)
    except struct.error:
        return None
    fields = parse_fields(head[4 : 4 + length])
    if fields is None or not _is_valid(fields):
        return None
    return BagRecord(offset, fields[b"op"][0], fields, offset + length + 8, data_length)


def _is_valid(fields: HeaderFields) -> bool:
    operation = fields.get(b"op", b"")
    required = _REQUIRED.get(operation[0]) if len(operation) == 1 else None
    if required is None:
        return False
    return all(
        name in fields and (not length or len(fields[name]) == length)
        for name, length in required.items()
    )


def find_record(source: ByteSource, offset: int, operations: Container[int] = _ANY) -> int:
    """Find the next place at or after ``offset`` where a record starts; the end if none does."""
    block_start = offset
    while block_start < source.size:
        block = source.read(block_start, _BLOCK + _LOOK_BACK)
        for match in _OPERATION.finditer(block):
            if block[match.end() - 1] in operations:
                found = _record_around(source, offset, block_start + match.start())
                if found is not None:
                    return found
        block_start += _BLOCK
    return source.size


def _record_around(source: ByteSource, low: int, field_at: int) -> int | None:
    """Find the record that fits the file and whose header holds the field at ``field_at``."""
    for start in range(max(low, field_at - _LOOK_BACK), field_at - 7):
        record = read_record(source, start)
        if record is None or record.data_offset <= field_at:
            continue
        if record.end <= source.size or record.operation == CHUNK:
            return start
    return None


def walk(source: ByteSource, offset: int, on_damage: OnDamage) -> Iterator[BagRecord]:
    """Yield all records from ``offset`` on; anything else is reported and skipped.

    The length of a record that is not followed by another is not trusted: if a record starts
    inside, the first one ends there. A chunk that claims more bytes than there are ends with the
    file at the latest; other records that are cut short are reported and left out.
    """
    while offset < source.size:
        record = read_record(source, offset)
        if record is not None and not _is_followed(source, record):
            record = _shorten(source, record, on_damage)
        if record is None:
            found = find_record(source, offset + 1)
            on_damage(offset, found - offset, "no record can be read here")
            offset = found
            continue
        yield record
        offset = record.end


def _is_followed(source: ByteSource, record: BagRecord) -> bool:
    """Return whether a record ends where the next one starts, or with the file."""
    return record.end == source.size or read_record(source, record.end) is not None


def _shorten(source: ByteSource, record: BagRecord, on_damage: OnDamage) -> BagRecord | None:
    """End a record where the next one starts; None if it is cut short."""
    is_chunk = record.operation == CHUNK
    end = find_record(source, record.data_offset, (CHUNK, INDEX) if is_chunk else _ANY)
    if record.end <= end and record.end <= source.size:
        return record  # the next one is damaged
    if end == source.size and not is_chunk:
        return None
    more = record.end - end
    cut, wrong = f"chunk cut short, {more} bytes are missing", f"claims {more} bytes too many"
    on_damage(record.offset, end - record.offset, cut if is_chunk else wrong)
    return record._replace(data_length=end - record.data_offset)


def u32(value: bytes) -> int:
    """Read a little-endian unsigned 32-bit field."""
    return int.from_bytes(value, "little")


def time_ns(value: bytes) -> int:
    """Read a time field: seconds and nanoseconds, 32 bits each."""
    seconds, nanoseconds = struct.unpack_from("<II", value)
    return int(seconds) * NS + int(nanoseconds)


@dataclass
class ChunkContent:
    """Messages in the order of the chunk, connections it defines, ranges that are broken."""

    messages: list[RecordedMessage] = field(default_factory=list)
    connections: dict[int, HeaderFields] = field(default_factory=dict)
    # (offset inside the unpacked chunk, length, reason)
    damage: list[tuple[int, int, str]] = field(default_factory=list)

    def add_damage(self, offset: int, length: int, reason: str) -> None:
        """Add a range that cannot be read."""
        self.damage.append((offset, length, reason))


def read_chunk(raw: bytes, topic_of: Mapping[int, int]) -> ChunkContent:
    """Read an unpacked chunk; ``topic_of`` gives the topic index of a connection number.

    Messages of connections that are not in it get the topic index -1.
    """
    content = ChunkContent()
    source, offset = MemoryBytes(raw), 0
    while offset < len(raw):
        record = next(walk(source, offset, content.add_damage), None)
        if record is None:
            break
        offset = _take(raw, record, topic_of, content)
    return content


def _take(raw: bytes, record: BagRecord, topic_of: Mapping[int, int], content: ChunkContent) -> int:
    """Read a record and, after a message, all with the same header layout; return the end."""
    if record.operation == CONNECTION:
        fields = parse_fields(raw[record.data_offset : record.end])
        if fields is None:
            content.add_damage(record.offset, record.end - record.offset, "unreadable connection")
        else:
            merged = {**fields, b"topic": record.fields[b"topic"]}
            content.connections[u32(record.fields[b"conn"])] = merged
    if record.operation != MESSAGE:
        return record.end
    content.messages.append(_message_of(raw, record, topic_of))
    layout = _layout_of(raw, record)
    return record.end if layout is None else _read_run(raw, record.end, layout, topic_of, content)


class _Layout(NamedTuple):
    """The fixed bytes of a message header, the same in all messages of one writer."""

    unpack: Callable[[bytes, int], tuple[bytes, int, bytes, int, bytes, int]]
    fixed: tuple[bytes, bytes, bytes]
    conn_first: bool
    size: int


def _layout_of(raw: bytes, record: BagRecord) -> _Layout | None:
    """Return a header's layout; None if it has more fields than the usual three."""
    head = raw[record.offset : record.data_offset]
    conn_at, time_at = head.find(b"conn=") + 5, head.find(b"time=") + 5
    if len(record.fields) != 3:
        return None
    conn_first = conn_at < time_at
    first, second = sorted([(conn_at, "I", 4), (time_at, "Q", 8)])
    after_first, after_second = first[0] + first[2], second[0] + second[2]
    lengths = first[0], second[0] - after_first, len(head) - 4 - after_second
    text = f"<{lengths[0]}s{first[1]}{lengths[1]}s{second[1]}{lengths[2]}sI"
    unpack: Any = Struct(text).unpack_from
    k0, _, k1, _, k2, _ = unpack(raw, record.offset)
    return _Layout(unpack, (k0, k1, k2), conn_first, len(head))


def _read_run(
    raw: bytes,
    offset: int,
    layout: _Layout,
    topic_of: Mapping[int, int],
    content: ChunkContent,
) -> int:
    """Read messages as long as their headers have this layout; return the end of the run.

    A message that is not followed by another record is left to ``walk``: its length may be wrong.
    """
    unpack, (k0, k1, k2), conn_first, size = layout
    new, append, size_of_raw = tuple.__new__, content.messages.append, len(raw)
    last = start = offset
    while offset <= size_of_raw - size:
        c0, first, c1, second, c2, length = unpack(raw, offset)
        end = offset + size + length
        if c0 != k0 or c1 != k1 or c2 != k2 or end > size_of_raw:
            break
        conn, time = (first, second) if conn_first else (second, first)
        stamp = (time & 0xFFFFFFFF) * NS + (time >> 32)
        data = raw[offset + size : end]
        append(new(RecordedMessage, (topic_of.get(conn, -1), stamp, None, data)))
        last, offset = offset, end
    if start < offset < size_of_raw and read_record(MemoryBytes(raw), offset) is None:
        content.messages.pop()
        return last
    return offset


def _message_of(raw: bytes, record: BagRecord, topic_of: Mapping[int, int]) -> RecordedMessage:
    topic = topic_of.get(u32(record.fields[b"conn"]), -1)
    data = raw[record.data_offset : record.end]
    return RecordedMessage(topic, time_ns(record.fields[b"time"]), None, data)


MAGIC = b"#ROSBAG V2.0\n"
_SMALLEST_CHUNK = 64
_LOOSE = "none"  # messages outside of any chunk read like those of an uncompressed one


@dataclass
class _Chunk:
    """Place, time range and expected message counts of a chunk."""

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
        """Extend the range of time (ns)."""
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)


class _Bag:
    """A bag while it is scanned and read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = FileBytes(path)
        self.report = RecordingReport("ROS 1 bag")
        self.chunks: list[_Chunk] = []
        self.connections: dict[int, HeaderFields] = {}
        self.topics: list[Topic] = []
        self.topic_of: dict[int, int] = {}
        self.index_at: int | None = None
        self.chunk_count = 0

    def damaged(self, offset: int, length: int, reason: str) -> None:
        self.report.add_damage(RecordingDamage(self.path.name, offset, length, reason))

    def _skipped(self, offset: int, length: int, reason: str) -> None:
        # some writers leave a few zero bytes before the index, where no record has room
        is_padding = length < _SMALLEST_CHUNK and offset + length == self.index_at
        if is_padding and not any(self.file.read(offset, length)):
            self.report.add_note(f"{length} unused bytes before the index")
        else:
            self.damaged(offset, length, reason)

    def scan(self) -> None:
        """Find chunks and connections; read a chunk only where the index is incomplete."""
        for record in walk(self.file, len(MAGIC), self._skipped):
            self._note(record)
        self._check_complete()
        for chunk in self.chunks:
            if chunk.start_ns is None or not self.connections.keys() >= chunk.expected.keys():
                content = self._read(chunk, {})
                for number, fields in content.connections.items():
                    self.connections.setdefault(number, fields)
                times = [message.log_time_ns for message in content.messages]
                if times:
                    chunk.covers(min(times), max(times))
        self.chunks = [chunk for chunk in self.chunks if chunk.start_ns is not None]
        places = [
            ReadableRange(c.offset, c.data_offset + c.data_length, c.start_ns or 0, c.end_ns)
            for c in self.chunks
        ]
        self.report.damage = [damage.between(places) for damage in self.report.damage]
        table = TopicTable()
        for number, fields in sorted(self.connections.items()):
            self.topic_of[number] = table.add(_topic_of(fields))
        self.topics = table.topics

    def _note(self, record: BagRecord) -> None:
        if record.operation == CHUNK:
            compression = record.fields[b"compression"].decode(errors="replace")
            size = u32(record.fields[b"size"])
            place = record.offset, record.data_offset, record.data_length
            self.chunks.append(_Chunk(*place, compression, size))
        elif record.operation == INDEX and self.chunks:
            self._note_index(record, self.chunks[-1])
        elif record.operation == CONNECTION:
            fields = parse_fields(self.file.read(record.data_offset, record.data_length))
            if fields is None:
                self.damaged(record.offset, record.end - record.offset, "unreadable connection")
            else:
                number = u32(record.fields[b"conn"])
                self.connections[number] = {**fields, b"topic": record.fields[b"topic"]}
        elif record.operation == MESSAGE:
            self._note_loose(record)
        elif record.operation == BAG_HEADER:
            encryptor = record.fields.get(b"encryptor", b"").decode(errors="replace")
            if encryptor not in ("", "rosbag/NoEncryptor"):
                raise AmberboxError(
                    f"{self.path} is encrypted ({encryptor})",
                    "decrypt it first: rosbag decompress with the key at hand",
                )
            self.index_at = int.from_bytes(record.fields[b"index_pos"], "little")
            self.chunk_count = u32(record.fields[b"chunk_count"])
            if not self.index_at:
                self.report.add_note("the bag was never closed; it has no index")

    def _check_complete(self) -> None:
        """Report the parts that the bag's header states and the file lacks."""
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

    def _note_index(self, record: BagRecord, chunk: _Chunk) -> None:
        data = self.file.read(record.data_offset, record.data_length)
        count = u32(record.fields[b"count"])
        if not count or len(data) != 12 * count or chunk.is_loose:
            return
        entries = np.frombuffer(data, "<u4").reshape(-1, 3).astype(np.int64)
        times = entries[:, 0] * NS + entries[:, 1]
        chunk.covers(int(times.min()), int(times.max()))
        chunk.expected[u32(record.fields[b"conn"])] += count

    def _note_loose(self, record: BagRecord) -> None:
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

    def _read(self, chunk: _Chunk, topic_of: Mapping[int, int]) -> ChunkContent:
        data = self.file.read(chunk.data_offset, chunk.data_length)
        raw, problem = unpack(chunk.compression, data, chunk.unpacked_size)
        if not raw and (seen := compression_of(data)) != chunk.compression:
            raw, _ = unpack(seen, data, chunk.unpacked_size)
        if problem:
            self.damaged(chunk.offset, self._length(chunk), f"chunk {problem}")
        content = read_chunk(raw, topic_of)
        for offset, length, reason in content.damage:
            if chunk.compression == "none":
                self.damaged(chunk.data_offset + offset, length, reason)
            else:
                where = f"bytes {offset} to {offset + length} of the unpacked chunk"
                self.damaged(chunk.offset, self._length(chunk), f"{where}: {reason}")
        return content

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


def _topic_of(fields: HeaderFields) -> Topic:
    text = {name: fields.get(name, b"").decode(errors="replace") for name in (b"topic", b"type")}
    schema = Schema(text[b"type"], "ros1msg", fields.get(b"message_definition", b""))
    return Topic(text[b"topic"], "ros1", schema, fields.get(b"latching") == b"1")


def open_ros1_bag(path: Path) -> RecordingReader:
    """Open a ROS 1 bag; raises AmberboxError where nothing at all can be read."""
    bag = _Bag(path)
    try:
        bag.scan()
    except BaseException:
        bag.file.close()
        raise
    parts = [
        RecordingPart(
            chunk.start_ns or 0, chunk.end_ns, chunk.data_length, partial(bag.load, chunk)
        )
        for chunk in bag.chunks
    ]
    return RecordingReader(path, bag.topics, parts, bag.report, bag.file.close)
