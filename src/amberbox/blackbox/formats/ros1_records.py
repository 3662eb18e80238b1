"""The records of a ROS 1 bag (format 2.0), found again after damaged bytes.

A record is ``<u32 header length> <header> <u32 data length> <data>``; a header is a row of
``<u32 length> name=value`` fields (http://wiki.ros.org/Bags/Format/2.0).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Container, Iterator, Mapping
from typing import NamedTuple

from amberbox.blackbox.formats.bytesource import ByteSource

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

Fields = Mapping[bytes, bytes]
OnDamage = Callable[[int, int, str], None]
"""Called with offset, length and reason."""


class Record(NamedTuple):
    """A record's header fields and where its data stand; ``end`` may lie behind the file's."""

    offset: int
    operation: int
    fields: Fields
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


def read_record(source: ByteSource, offset: int) -> Record | None:
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
    return Record(offset, fields[b"op"][0], fields, offset + length + 8, data_length)


def _is_valid(fields: Fields) -> bool:
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
        if record is not None and record.data_offset > field_at and _fits(source, record):
            return start
    return None


def _fits(source: ByteSource, record: Record) -> bool:
    return record.end <= source.size or record.operation == CHUNK


def walk(source: ByteSource, offset: int, on_damage: OnDamage) -> Iterator[Record]:
    """Give all records from ``offset`` on; what is none is reported and skipped.

    The length of a record that is followed by no other one is not believed: if a record starts
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


def _is_followed(source: ByteSource, record: Record) -> bool:
    """Tell whether a record ends where the next one starts, or with the file."""
    return record.end == source.size or read_record(source, record.end) is not None


def _shorten(source: ByteSource, record: Record, on_damage: OnDamage) -> Record | None:
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
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
