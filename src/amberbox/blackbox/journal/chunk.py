"""A chunk of an MCAP file in memory: decompressed, checked, its messages as parallel arrays."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.mcap import MESSAGE_HEAD, ChunkHead, McapChannel
from amberbox.core.types import IntArray, Schema

Buffer: TypeAlias = "bytes | memoryview"


@contextmanager
def open_buffer(path: Path) -> Iterator[Buffer]:
    """Map a file into memory; an empty file gives empty bytes."""
    with path.open("rb") as file:
        if file.seek(0, 2) == 0:
            yield b""
            return
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    view = memoryview(mapped)
    try:
        yield view
    finally:
        with suppress(BufferError):  # an exception may still hold a slice of it
            view.release()
            mapped.close()


MAX_CHUNK_BYTES = 1 << 30  # largest uncompressed size of a chunk: a file may claim any size
_KEPT_BYTES = 1 << 14


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Messages of one chunk as parallel arrays, with the definitions it carries."""

    offset: int
    end: int
    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_ns: IntArray
    publish_ns: IntArray
    starts: IntArray
    ends: IntArray
    body: bytes
    schemas: Mapping[int, Schema]
    channels: Mapping[int, McapChannel]

    def __len__(self) -> int:
        return len(self.channel)

    def rows_of(self, channel: int) -> IntArray:
        """Return the row numbers of one channel."""
        return np.flatnonzero(self.channel == channel)

    def messages(self, rows: IntArray) -> list[bytes]:
        """Return the message bytes of some rows."""
        body = self.body
        spans = zip(self.starts[rows].tolist(), self.ends[rows].tolist(), strict=True)
        return [body[a:b] for a, b in spans]


def decompress(
    head: ChunkHead, data: bytes | memoryview, zstd: zstandard.ZstdDecompressor | None = None
) -> bytes | None:
    """Return a chunk's records if decompression, size and CRC agree, else None."""
    if head.data_offset + head.data_length > len(data):
        return None
    if head.compression and head.size > MAX_CHUNK_BYTES:
        return None
    packed = data[head.data_offset : head.data_offset + head.data_length]
    body = _unpack(head.compression, packed, head.size, zstd)
    if body is None or len(body) != head.size:
        return None
    if head.crc and zlib.crc32(body) != head.crc:
        return None
    return body


def _unpack(
    compression: str,
    packed: bytes | memoryview,
    size: int,
    zstd: zstandard.ZstdDecompressor | None,
) -> bytes | None:
    if compression == "":
        return bytes(packed)
    if compression == "zstd":
        return _unpack_zstd(packed, size, zstd or zstandard.ZstdDecompressor())
    if compression == "lz4":
        return _unpack_lz4(bytes(packed), size)
    return None


def _unpack_zstd(
    packed: bytes | memoryview, size: int, zstd: zstandard.ZstdDecompressor
) -> bytes | None:
    """Unpack at most ``size`` bytes: zstd allocates the size that a frame claims unchecked."""
    try:
        if zstandard.frame_content_size(packed) not in (size, -1):
            return None
        return zstd.decompress(packed, max_output_size=size)
    except zstandard.ZstdError:
        return None


def _unpack_lz4(packed: bytes, size: int) -> bytes | None:
    """Unpack at most ``size + 1`` bytes."""
    import lz4.frame  # type: ignore[import-untyped]  # it ships no types; only others use it

    unpacker, body = lz4.frame.LZ4FrameDecompressor(), b""
    try:
        body = bytes(unpacker.decompress(packed, max_length=size + 1))
    except (RuntimeError, ValueError, EOFError):
        return None
    return body if unpacker.eof else None


def open_chunk(body: bytes, offset: int, end: int, offsets: IntArray | None = None) -> Chunk | None:
    """Parse a chunk's records; None if their lengths do not fit together.

    ``offsets`` are the message offsets its indices state. They are used only if they cover the
    records without a hole, otherwise the records are walked one by one.
    """
    try:
        schemas, channels, at = _stated(body, offsets)
        starts = _believe(body, at, offsets)
        if starts is None:
            starts = _walk(body, at, schemas, channels)
    except (ValueError, struct.error, IndexError):
        return None
    return _columns(body, starts, offset, end, schemas, channels)


def _stated(
    body: bytes, offsets: IntArray | None
) -> tuple[dict[int, Schema], dict[int, McapChannel], int]:
    """Read the definitions that a chunk begins with; chunks repeat theirs, so they are cached."""
    end = int(offsets.min()) if offsets is not None and len(offsets) else 0
    if not 0 < end <= _KEPT_BYTES:
        return _definitions(body)
    try:
        schemas, channels, at = _kept(body[:end])
    except (ValueError, struct.error):  # the offsets are wrong, the rest need not be
        return _definitions(body)
    return (dict(schemas), dict(channels), at) if at == end else _definitions(body)


@lru_cache(maxsize=256)
def _kept(head: bytes) -> tuple[dict[int, Schema], dict[int, McapChannel], int]:
    return _definitions(head)


def is_definitions_only(head: bytes) -> bool:
    """Return whether bytes are schema and channel records and nothing else."""
    try:
        return (_kept if len(head) <= _KEPT_BYTES else _definitions)(head)[2] == len(head)
    except (ValueError, struct.error, IndexError):
        return False


def open_joined_chunks(
    bodies: bytes, starts: IntArray, bounds: IntArray, firsts: IntArray, offset: int
) -> Chunk | None:
    """Parse the messages of concatenated chunks; None if their records do not fit together.

    ``starts`` are the message offsets in order, ``bounds`` where the chunks end, ``firsts`` the
    row that each chunk begins with.
    """
    if int(starts[-1]) + MESSAGE_HEAD > len(bodies):
        return None
    ends = starts + 9 + _take(bodies, "<u8", 7, starts + 1).astype(np.int64)
    expected = np.append(starts[1:], 0)
    expected[np.append(firsts[1:], len(starts)) - 1] = bounds
    sound = np.frombuffer(bodies, np.uint8)[starts] == mcap.MESSAGE
    if not (np.array_equal(ends, expected) and bool(sound.all())):
        return None
    return _columns(bodies, starts, offset, offset, {}, {})


def _definitions(body: bytes) -> tuple[dict[int, Schema], dict[int, McapChannel], int]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, McapChannel] = {}
    at = 0
    while at < len(body) and body[at] in (mcap.SCHEMA, mcap.CHANNEL):
        at = _define(body, at, schemas, channels)
    return schemas, channels, at


def _define(
    body: bytes, at: int, schemas: dict[int, Schema], channels: dict[int, McapChannel]
) -> int:
    (length,) = struct.unpack_from("<Q", body, at + 1)
    content = body[at + 9 : at + 9 + length]
    if body[at] == mcap.SCHEMA:
        number, schema = mcap.parse_schema(content)
        schemas[number] = schema
    else:
        channel = mcap.parse_channel(content)
        channels[channel.id] = channel
    return at + 9 + int(length)


def _believe(body: bytes, at: int, offsets: IntArray | None) -> IntArray | None:
    """Return the stated offsets if each message begins where the one before ends, else None."""
    if offsets is None or not len(offsets):
        return None
    starts = np.sort(offsets)
    if int(starts[0]) != at or int(starts[-1]) + MESSAGE_HEAD > len(body):
        return None
    ends = starts + 9 + overlapping_numbers(body, "<u8", 7)[starts + 1].astype(np.int64)
    whole = np.array_equal(ends[:-1], starts[1:]) and int(ends[-1]) == len(body)
    opcodes = np.frombuffer(body, np.uint8)[starts]
    return starts if whole and bool((opcodes == mcap.MESSAGE).all()) else None


def _walk(
    body: bytes, at: int, schemas: dict[int, Schema], channels: dict[int, McapChannel]
) -> IntArray:
    """Return the message offsets, record by record, as files of other writers need it."""
    starts, size = [], len(body)
    while at < size:
        opcode, length = struct.unpack_from("<BQ", body, at)
        if at + 9 + length > size:
            raise ValueError("a record is longer than its chunk")
        if opcode == mcap.MESSAGE:
            if length < MESSAGE_HEAD - 9:
                raise ValueError("a message record is too short")
            starts.append(at)
        elif opcode in (mcap.SCHEMA, mcap.CHANNEL):
            _define(body, at, schemas, channels)
        at += 9 + length
    return np.array(starts, np.int64)


def _columns(
    body: bytes,
    starts: IntArray,
    offset: int,
    end: int,
    schemas: Mapping[int, Schema],
    channels: Mapping[int, McapChannel],
) -> Chunk:
    lengths = _take(body, "<u8", 7, starts + 1).astype(np.int64)
    return Chunk(
        offset=offset,
        end=end,
        channel=_take(body, "<u2", 1, starts + 9),
        sequence=_take(body, "<u4", 3, starts + 11),
        log_ns=_take(body, "<u8", 7, starts + 15).astype(np.int64),
        publish_ns=_take(body, "<u8", 7, starts + 23).astype(np.int64),
        starts=starts + MESSAGE_HEAD,
        ends=starts + 9 + lengths,
        body=body,
        schemas=schemas,
        channels=channels,
    )


def overlapping_numbers(body: bytes | bytearray, kind: str, tail: int) -> NDArray[Any]:
    """View bytes as numbers that begin at every byte; ``tail`` is their size less 1."""
    return np.ndarray((max(len(body) - tail, 0),), kind, body, 0, (1,))


def _take(body: bytes, kind: str, tail: int, at: IntArray) -> NDArray[Any]:
    if not len(at):
        return np.empty(0, kind)
    return overlapping_numbers(body, kind, tail)[at]


def decode_own_messages(
    chunk: Chunk, topics: Collection[str]
) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield log time, channel and values of the records on some of the reserved channels."""
    names = {n: c.topic for n, c in chunk.channels.items() if c.topic in topics}
    rows = np.flatnonzero(np.isin(chunk.channel, list(names)))
    numbers, times = chunk.channel[rows].tolist(), chunk.log_ns[rows].tolist()
    for number, log_ns, message in zip(numbers, times, chunk.messages(rows), strict=True):
        yield log_ns, names[number], msgspec.json.decode(message)


def sequences(chunk: Chunk, base: int) -> IntArray:
    """Widen the 32-bit sequence numbers of a chunk to positions at or after ``base``."""
    low = chunk.sequence.astype(np.int64)
    widened: IntArray = base + ((low - base) & 0xFFFFFFFF)
    return widened


def index_offsets(entries: Sequence[bytes | memoryview]) -> IntArray:
    """Collect the message offsets of the entries of message index records."""
    if not entries:
        return np.empty(0, np.int64)
    return np.frombuffer(b"".join(entries), "<i8")[1::2].astype(np.int64)
