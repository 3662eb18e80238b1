"""Many small chunks read as one: unrolling pays by the row only where there are many rows."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.follow.read import BATCH_BYTES, BATCH_ROWS
from amberbox.blackbox.journal.chunk import Chunk, sequences
from amberbox.core.types import IntArray


@dataclass(slots=True)
class _Pile:
    """Chunks that follow each other without a hole."""

    chunks: list[Chunk] = field(default_factory=list)
    bodies: list[bytes] = field(default_factory=list)
    starts: list[IntArray] = field(default_factory=list)
    ends: list[IntArray] = field(default_factory=list)
    rows: int = 0
    size: int = 0
    end_seq: int = -1

    def add(self, chunk: Chunk, wanted: NDArray[np.bool_]) -> None:
        """Put a chunk on top, of its messages only those of the wanted channels."""
        keep = wanted[chunk.channel]
        lengths = np.where(keep, chunk.ends - chunk.starts, 0)
        ends = self.size + np.cumsum(lengths)
        self.bodies.extend(chunk.messages(np.flatnonzero(keep)))
        self.starts.append(ends - lengths)
        self.ends.append(ends)
        self.chunks.append(chunk)
        self.rows += int(keep.sum())
        self.size = int(ends[-1])

    @property
    def is_full(self) -> bool:
        return self.rows >= BATCH_ROWS or self.size >= BATCH_BYTES

    def joined(self) -> Chunk:
        """Make one chunk of them; the bytes of what nobody wants are left out."""
        if len(self.chunks) == 1:
            return self.chunks[0]
        first, last = self.chunks[0], self.chunks[-1]
        return Chunk(
            offset=first.offset,
            end=last.end,
            channel=np.concatenate([chunk.channel for chunk in self.chunks]),
            sequence=np.concatenate([chunk.sequence for chunk in self.chunks]),
            log_ns=np.concatenate([chunk.log_ns for chunk in self.chunks]),
            publish_ns=np.concatenate([chunk.publish_ns for chunk in self.chunks]),
            starts=np.concatenate(self.starts),
            ends=np.concatenate(self.ends),
            body=b"".join(self.bodies),
            schemas={number: s for chunk in self.chunks for number, s in chunk.schemas.items()},
            channels={number: c for chunk in self.chunks for number, c in chunk.channels.items()},
        )


def joined(chunks: Iterable[Chunk], first_seq: int, wanted: Collection[int]) -> Iterator[Chunk]:
    """Join chunks of one file until there are many rows of the wanted channels.

    A joined chunk has no hole in its sequence, and the messages of wanted channels only.
    """
    flags = np.zeros(1 << 16, bool)
    flags[list(wanted)] = True
    pile = _Pile()
    for chunk in chunks:
        seq = sequences(chunk, first_seq)
        if pile.chunks and (pile.is_full or int(seq[0]) != pile.end_seq):
            yield pile.joined()
            pile = _Pile()
        pile.add(chunk, flags)
        pile.end_seq = int(seq[-1]) + 1
    if pile.chunks:
        yield pile.joined()
