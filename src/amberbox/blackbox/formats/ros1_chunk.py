"""What is inside a chunk of a ROS 1 bag: unpacking it and reading its messages fast."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from struct import Struct
from typing import Any, NamedTuple

from amberbox.blackbox.formats.bytesource import MemoryBytes
from amberbox.blackbox.formats.recording import RecordedMessage
from amberbox.blackbox.formats.ros1_records import (
    CONNECTION,
    MESSAGE,
    Fields,
    Record,
    parse_fields,
    read_record,
    time_ns,
    u32,
    walk,
)

NS = 1_000_000_000


@dataclass
class ChunkContent:
    """Messages in the order of the chunk, connections it defines, ranges that are broken."""

    messages: list[RecordedMessage] = field(default_factory=list)
    connections: dict[int, Fields] = field(default_factory=dict)
    damage: list[tuple[int, int, str]] = field(default_factory=list)
    """(offset inside the unpacked chunk, length, reason)"""

    def add_damage(self, offset: int, length: int, reason: str) -> None:
        """Note a range that cannot be read."""
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


def _take(raw: bytes, record: Record, topic_of: Mapping[int, int], content: ChunkContent) -> int:
    """Take a record and, after a message, all that look like it; return where to go on."""
    if record.operation == CONNECTION:
        _add_connection(raw, record, content)
    if record.operation != MESSAGE:
        return record.end
    content.messages.append(_message_of(raw, record, topic_of))
    layout = _layout_of(raw, record)
    return record.end if layout is None else _read_run(raw, record.end, layout, topic_of, content)


class _Layout(NamedTuple):
    """The fixed bytes of a message header, as one writer writes all of them."""

    unpack: Callable[[bytes, int], tuple[bytes, int, bytes, int, bytes, int]]
    fixed: tuple[bytes, bytes, bytes]
    conn_first: bool
    size: int


def _layout_of(raw: bytes, record: Record) -> _Layout | None:
    """Learn a header's layout; None if it has more fields than the usual three."""
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
    """Read messages as long as their headers have this layout; return where the run ends.

    A message that is followed by no record is left to ``walk``: its length may be wrong.
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


def _message_of(raw: bytes, record: Record, topic_of: Mapping[int, int]) -> RecordedMessage:
    topic = topic_of.get(u32(record.fields[b"conn"]), -1)
    data = raw[record.data_offset : record.end]
    return RecordedMessage(topic, time_ns(record.fields[b"time"]), None, data)


def _add_connection(raw: bytes, record: Record, content: ChunkContent) -> None:
    fields = parse_fields(raw[record.data_offset : record.end])
    if fields is None:
        content.add_damage(record.offset, record.end - record.offset, "unreadable connection")
    else:
        merged = {**fields, b"topic": record.fields[b"topic"]}
        content.connections[u32(record.fields[b"conn"])] = merged
