"""The box's own records on some channels as they come; of old files only what holds any is read."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.follow.newest import Written, records_of
from amberbox.blackbox.journal.buffer import Buffer, open_buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.summary import Summary, read_summary
from amberbox.blackbox.journal.walk import Walk, chunk_at
from amberbox.blackbox.store import Store

_END_BYTES = 1 << 20
"""The last whole record of a file is looked for in this much of its end."""


class OwnRecords:
    """Reads all records of some channels of a writer's journal, and what is added to them."""

    def __init__(self, store: Store, writer: str, channels: Collection[str]) -> None:
        self._store = store
        self._writer = writer
        self._channels = frozenset(channels)
        self._read_to: dict[Path, int] = {}

    def skip(self) -> None:
        """Pass over everything that is there."""
        for path in self._store.journal_files(self._writer):
            with suppress(FileNotFoundError):  # deleted meanwhile
                self._read_to[path] = _end_of_records(path)

    def step(self) -> list[Written]:
        """Return what is new since the last step, in order; at first everything there is."""
        found: list[Written] = []
        paths = self._store.journal_files(self._writer)
        self._read_to = {path: at for path, at in self._read_to.items() if path in paths}
        for path in paths:
            with suppress(FileNotFoundError):
                found += self._of_file(path)
        return found

    def _of_file(self, path: Path) -> list[Written]:
        at, size = self._read_to.get(path, 0), path.stat().st_size
        if at == size:
            return []
        if at > size:  # another store's file has taken its place
            at = 0
        with open_buffer(path) as data:
            summary = None if at else read_summary(data)
            if summary is None:
                chunks = self._grown(data, path, at)
            else:
                chunks = self._indexed(data, summary)
                self._read_to[path] = len(data)
            return list(records_of(chunks, self._channels))

    def _indexed(self, data: Buffer, summary: Summary) -> Iterator[Chunk]:
        """Give the chunks of a finished file that hold the channels, by its index."""
        numbers = {n for n, c in summary.channels.items() if c.topic in self._channels}
        for place in summary.chunks:
            held = {number for number, _ in place.index_offsets}
            chunk = chunk_at(data, place.offset) if held & numbers else None
            if chunk is not None:
                yield chunk

    def _grown(self, data: Buffer, path: Path, at: int) -> Iterator[Chunk]:
        """Give the chunks behind what was read last."""
        walk = Walk(data, at=at, trusted=at, grows=True)
        yield from (found for found in walk if isinstance(found, Chunk))
        self._read_to[path] = walk.at


def _end_of_records(path: Path) -> int:
    """Return where the last record ends that is written whole."""
    with open_buffer(path) as data:
        if read_summary(data) is not None:
            return len(data)
        at = max(len(data) - _END_BYTES, 0)
        walk = Walk(data, at=at, trusted=at)
        for _ in walk:
            pass
        return walk.trusted if walk.trusted > at else 0
