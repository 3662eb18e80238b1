"""Messages framed as an MCAP chunk with its indices, column-wise instead of one by one."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.mcap import MESSAGE_HEAD
from amberbox.blackbox.journal.summary import IndexedChunk
from amberbox.core.types import IntArray

CHUNK_BYTES = 1 << 20
"""Larger writes are split into chunks of about this size; a larger message has its own."""

Define = Callable[[Sequence[int], int], bytes]
"""Gives the schema and channel records that a chunk of these channels begins with."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Messages as parallel columns, in the order in which they are to stand."""

    channels: NDArray[np.uint16]
    sequence: IntArray
    log_ns: IntArray
    publish_ns: IntArray
    messages: Sequence[bytes]

    def take(self, part: slice) -> Rows:
        """Return some of the rows."""
        return Rows(
            self.channels[part],
            self.sequence[part],
            self.log_ns[part],
            self.publish_ns[part],
            self.messages[part],
        )


@dataclass(frozen=True, slots=True)
class Packed:
    """A chunk record and its message index records, with what the summary says of them."""

    chunk: bytes
    indices: Sequence[bytes]
    channels: Sequence[int]
    counts: Sequence[int]
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    size: int

    def indexed(self, offset: int) -> IndexedChunk:
        """Describe the chunk for the summary of a file where it stands at ``offset``."""
        after = offset + len(self.chunk)
        return IndexedChunk(
            self.start_ns,
            self.end_ns,
            offset,
            len(self.chunk),
            _index_offsets(self.channels, self.counts, after),
            sum(map(len, self.indices)),
            self.compression,
            self.compressed_size,
            self.size,
        )


def chunk_slices(messages: Sequence[bytes]) -> list[slice]:
    """Split messages into chunks of about ``CHUNK_BYTES``; larger messages stand alone."""
    lengths = np.fromiter(map(len, messages), np.int64, len(messages))
    ends = np.cumsum(lengths)
    if not len(ends) or int(ends[-1]) <= CHUNK_BYTES:
        return [slice(0, len(ends))] if len(ends) else []
    slices, start = [], 0
    while start < len(lengths):
        base = int(ends[start] - lengths[start])
        stop = max(start + 1, int(np.searchsorted(ends, base + CHUNK_BYTES, "right")))
        slices.append(slice(start, stop))
        start = stop
    return slices


def pack(rows: Rows, define: Define, zstd: zstandard.ZstdCompressor) -> Packed:
    """Frame and compress one chunk; a message larger than a chunk stays as it is."""
    order = np.argsort(rows.channels, kind="stable")
    grouped = rows.channels[order]
    firsts = np.flatnonzero(np.concatenate(([True], grouped[1:] != grouped[:-1])))
    used = grouped[firsts].tolist()
    start_ns, end_ns = int(rows.log_ns.min()), int(rows.log_ns.max())
    body, starts = _frame(define(used, end_ns), rows)
    compression = "zstd" if len(order) > 1 or len(body) <= CHUNK_BYTES else ""
    data = zstd.compress(body) if compression else bytes(body)
    chunk = mcap.chunk_record(start_ns, end_ns, len(body), zlib.crc32(body), compression, data)
    entries = np.empty((len(order), 2), np.int64)
    entries[:, 0], entries[:, 1] = rows.log_ns[order], starts[order]
    bounds = [*(firsts * 16).tolist(), len(order) * 16]
    raw = entries.tobytes()
    indices = [
        mcap.message_index_record(channel, raw[a:b])
        for channel, a, b in zip(used, bounds[:-1], bounds[1:], strict=True)
    ]
    counts = (np.diff(bounds) // 16).tolist()
    return Packed(chunk, indices, used, counts, start_ns, end_ns, compression, len(data), len(body))


def _frame(prefix: bytes, rows: Rows) -> tuple[bytearray, IntArray]:
    """Lay messages out behind the definitions, their 31-byte heads written column-wise."""
    lengths = np.fromiter(map(len, rows.messages), np.int64, len(rows.messages))
    body = bytearray(MESSAGE_HEAD).join([prefix, *rows.messages])
    starts = np.empty(len(lengths), np.int64)
    starts[0] = len(prefix)
    np.cumsum(lengths[:-1] + MESSAGE_HEAD, out=starts[1:])
    starts[1:] += len(prefix)
    u1, u2, u4, u8 = _overlapping_views(body)
    u1[starts] = mcap.MESSAGE
    u8[starts + 1] = lengths + (MESSAGE_HEAD - 9)
    u2[starts + 9] = rows.channels
    u4[starts + 11] = rows.sequence & 0xFFFFFFFF
    u8[starts + 15] = rows.log_ns
    u8[starts + 23] = rows.publish_ns
    return body, starts


def _overlapping_views(
    body: bytearray,
) -> tuple[NDArray[np.uint8], NDArray[np.uint16], NDArray[np.uint32], NDArray[np.uint64]]:
    """View bytes as numbers that begin at every byte, for column-wise writing."""
    size = len(body)
    return (
        np.ndarray((size,), "<u1", body, 0, (1,)),
        np.ndarray((size - 1,), "<u2", body, 0, (1,)),
        np.ndarray((size - 3,), "<u4", body, 0, (1,)),
        np.ndarray((size - 7,), "<u8", body, 0, (1,)),
    )


def _index_offsets(used: Sequence[int], counts: Sequence[int], start: int) -> list[tuple[int, int]]:
    offsets = []
    for channel, count in zip(used, counts, strict=True):
        offsets.append((channel, start))
        start += 15 + 16 * count
    return offsets
