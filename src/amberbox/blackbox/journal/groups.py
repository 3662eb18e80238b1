"""Chunks of a file unpacked in groups: what costs time per chunk is paid per group.

A robot writes ten chunks a second, of some forty messages each. A group is read as one chunk, with
the same checks: each checksum holds, and the message indices cover the records without a hole.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import zstandard

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.buffer import Buffer
from amberbox.blackbox.journal.chunk import Chunk, decompress, lay_open, states_only
from amberbox.blackbox.journal.mcap import ChunkHead
from amberbox.blackbox.journal.scan import ChunkPlace
from amberbox.blackbox.journal.walk import chunk_at

_CHUNKS = 64
_BYTES = 4 << 20
_INDEX = struct.Struct("<QHI").unpack_from


def read_in_groups(data: Buffer, places: Iterable[ChunkPlace]) -> Iterator[Chunk | None]:
    """Give the chunks in order, many as one; None for one that does not hold.

    A joined chunk has no definitions.
    """
    for group in _groups(data, places):
        joined = _joined(data, [head for _, head in group if head is not None])
        if joined is not None and all(head is not None for _, head in group):
            yield joined
        else:
            yield from (chunk_at(data, place.offset) for place, _ in group)


def _groups(
    data: Buffer, places: Iterable[ChunkPlace]
) -> Iterator[list[tuple[ChunkPlace, ChunkHead | None]]]:
    group: list[tuple[ChunkPlace, ChunkHead | None]] = []
    size = 0
    for place in places:
        head = mcap.parse_chunk_head(data, place.offset)
        size += head.size if head is not None else 0
        if group and (size > _BYTES or len(group) == _CHUNKS):
            yield group
            group, size = [], head.size if head is not None else 0
        group.append((place, head))
    if group:
        yield group


def _joined(data: Buffer, heads: Sequence[ChunkHead]) -> Chunk | None:
    """Read chunks as one; None where one of them has to be looked at alone."""
    if len(heads) < 2:
        return None
    zstd = zstandard.ZstdDecompressor()
    bodies, entries, counts = list[bytes](), list[Buffer](), list[int]()
    for head in heads:
        body = decompress(head, data, zstd)
        if body is None:
            return None
        bodies.append(body)
        found = _entries(data, head.offset + head.length)
        entries += found
        counts.append(sum(map(len, found)) // 16)
    if not all(counts):
        return None
    offsets = np.frombuffer(b"".join(entries), "<i8")[1::2]
    bounds = np.cumsum([0, *map(len, bodies)])
    if int(offsets.min()) < 0 or bool((offsets >= np.repeat(np.diff(bounds), counts)).any()):
        return None
    starts = np.sort(offsets + np.repeat(bounds[:-1], counts))
    firsts = np.cumsum([0, *counts[:-1]])
    begins = (starts[firsts] - bounds[:-1]).tolist()
    if not all(states_only(body[:begin]) for body, begin in zip(bodies, begins, strict=True)):
        return None
    return lay_open(b"".join(bodies), starts, bounds[1:], firsts, heads[0].offset)


def _entries(data: Buffer, at: int) -> list[Buffer]:
    """Return the entries of the message index records that follow a chunk."""
    found, size = list[Buffer](), len(data)
    while at + 15 <= size and data[at] == mcap.MESSAGE_INDEX:
        length, _, count = _INDEX(data, at + 1)
        if length != count + 6 or count % 16 or at + 9 + length > size:
            return []
        found.append(data[at + 15 : at + 15 + count])
        at += 9 + length
    return found
