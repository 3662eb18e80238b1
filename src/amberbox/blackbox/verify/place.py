"""When was received what stands at some bytes of a journal file."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amberbox.blackbox.follow.read import describe
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.journal.scan import ChunkPlace, scan
from amberbox.blackbox.verify.findings import Finding, State

TROUBLE = (ValueError, KeyError, IndexError, TypeError, struct.error, OSError, OverflowError)
"""What a file that somebody tampered with may do to whoever reads it."""


@dataclass
class Places:
    """The chunks of a file, looked up when there is something to say about it."""

    path: Path
    name: str
    _chunks: Sequence[ChunkPlace] | None = None
    _clock: ClockTable = field(default_factory=ClockTable)

    def finding(
        self, state: State, text: str, from_byte: int, to_byte: int, chunk: int | None = None
    ) -> Finding:
        """Compose a finding about some bytes: the chunk that is hit first, and a time range."""
        if chunk is None:
            chunk = next((place.offset for place in self._inside(from_byte, to_byte)), None)
        from_ns, to_ns = self.times(from_byte, to_byte)
        return Finding(state, self.name, text, chunk, from_byte, to_byte, from_ns, to_ns)

    def times(self, from_byte: int, to_byte: int) -> tuple[int | None, int | None]:
        """Return when the chunks in a range were received, else when those around it were."""
        inside = self._inside(from_byte, to_byte)
        if inside:
            return self._received(min(p.start_ns for p in inside), max(p.end_ns for p in inside))
        before = [p.end_ns for p in self.chunks() if p.offset < from_byte]
        after = [p.start_ns for p in self.chunks() if p.offset >= to_byte]
        return self._received(before[-1] if before else None, after[0] if after else None)

    def end_ns(self, to_byte: int | None = None) -> int | None:
        """Return when the last chunk before a place was received."""
        ends = [p.end_ns for p in self.chunks() if to_byte is None or p.offset < to_byte]
        return self._received(ends[-1] if ends else None, None)[0]

    def start_ns(self) -> int | None:
        """Return when the first chunk was received."""
        starts = [place.start_ns for place in self.chunks()]
        return self._received(starts[0] if starts else None, None)[0]

    def chunks(self) -> Sequence[ChunkPlace]:
        """Return where the chunks are, in the order in which they stand."""
        if self._chunks is None:
            self._chunks = self._look()
        return self._chunks

    def _look(self) -> Sequence[ChunkPlace]:
        try:
            journal = describe(scan(self.path), self.name)
        except TROUBLE:
            return ()
        self._clock = ClockTable(journal.clock)
        return sorted(journal.places, key=lambda place: place.offset)

    def _inside(self, from_byte: int, to_byte: int) -> list[ChunkPlace]:
        return [place for place in self.chunks() if from_byte <= place.offset < to_byte]

    def _received(self, from_ns: int | None, to_ns: int | None) -> tuple[int | None, int | None]:
        known = [t for t in (from_ns, to_ns) if t is not None]
        corrected = iter(self._clock.received(np.array(known, np.int64)).tolist())
        return (
            None if from_ns is None else next(corrected),
            None if to_ns is None else next(corrected),
        )
