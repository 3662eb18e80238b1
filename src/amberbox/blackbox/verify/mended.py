"""Tell what a disk did from what a person did: mend what checksums vouch for, and hash again.

A block of a journal holds compressed messages with a checksum, and bytes around them that follow
from the messages (indices, lengths, links of the chain). When the messages hold, everything else
can be written anew. If the result has the hash that the chain states, the messages are proven and
only the frame was hit; if it has not, somebody changed messages and repaired their checksums.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import zstandard

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.buffer import Buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.frame import CHUNK_BYTES
from amberbox.blackbox.journal.writer import COMPRESSION_LEVEL


def mended(
    data: Buffer, leads: Sequence[bytes], chunks: Sequence[Chunk], end: bytes, digest: str
) -> bytes | None:
    """Write a block anew from its sound chunks; None if no attempt has the ``digest``.

    ``leads`` are what may stand before the first chunk, ``end`` what stands after the last one.
    """
    for body in (_as_stored(data, chunks), _packed_again(chunks)):
        for lead in leads:
            block = lead + body + end
            if hashlib.sha256(block).hexdigest() == digest:
                return block
    return None


def first_difference(data: Buffer, start: int, block: bytes) -> int:
    """Return the offset of the first byte that is not as it was."""
    is_now = np.frombuffer(data[start : start + len(block)], np.uint8)
    was = np.frombuffer(block, np.uint8)[: len(is_now)]
    different = np.flatnonzero(is_now != was)
    return start + (int(different[0]) if len(different) else len(was))


def _as_stored(data: Buffer, chunks: Sequence[Chunk]) -> bytes:
    """Keep the compressed bytes as they are."""
    parts = []
    for chunk in chunks:
        head = mcap.parse_chunk_head(data, chunk.offset)
        assert head is not None  # the chunk was opened by it
        packed = bytes(data[head.data_offset : head.data_offset + head.data_length])
        parts.append(_framed(chunk, packed))
    return b"".join(parts)


def _packed_again(chunks: Sequence[Chunk]) -> bytes:
    """Compress again: a few bits of compressed data do not change what comes out."""
    zstd = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_content_size=True)
    return b"".join(_framed(c, zstd.compress(c.body) if _is_packed(c) else c.body) for c in chunks)


def _is_packed(chunk: Chunk) -> bool:
    return len(chunk) > 1 or len(chunk.body) <= CHUNK_BYTES


def _framed(chunk: Chunk, packed: bytes) -> bytes:
    """Frame one chunk and its indices as the journal's writer does."""
    times = int(chunk.log_ns.min()), int(chunk.log_ns.max())
    kind = "zstd" if _is_packed(chunk) else ""
    record = mcap.chunk_record(*times, len(chunk.body), zlib.crc32(chunk.body), kind, packed)
    return record + b"".join(_indices(chunk))


def _indices(chunk: Chunk) -> Iterator[bytes]:
    for channel in np.unique(chunk.channel).tolist():
        rows = chunk.rows_of(channel)
        entries = np.empty((len(rows), 2), np.int64)
        entries[:, 0] = chunk.log_ns[rows]
        entries[:, 1] = chunk.starts[rows] - mcap.MESSAGE_HEAD
        yield mcap.message_index_record(channel, entries.tobytes())


def without_one_bit(content: bytes, holds: Callable[[bytes], bool]) -> bytes | None:
    """Turn each bit of some bytes until they hold; None if more than one bit was flipped."""
    tried = bytearray(content)
    for place in range(len(tried)):
        for bit in range(8):
            tried[place] ^= 1 << bit
            if holds(bytes(tried)):
                return bytes(tried)
            tried[place] ^= 1 << bit
    return None
