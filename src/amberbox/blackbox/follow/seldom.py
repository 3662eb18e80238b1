"""Records of a channel that is seldom written to: only what holds any is read, and read once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.follow.newest import Written, records_of
from amberbox.blackbox.journal.buffer import Buffer, open_buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.summary import Summary, read_summary
from amberbox.blackbox.journal.walk import Walk, chunk_at
from amberbox.blackbox.store import Store


class SeldomChannel:
    """Reads all records of one channel of a writer's journal, and what is added to them."""

    def __init__(self, store: Store, writer: str, channel: str) -> None:
        self._store = store
        self._writer = writer
        self._channel = channel
        self._read_to: dict[Path, int] = {}

    def step(self) -> list[Written]:
        """Return what is new since the last step, in order; at first everything there is."""
        found: list[Written] = []
        for path in self._store.journal_files(self._writer):
            with suppress(FileNotFoundError):  # deleted meanwhile
                found += self._of_file(path)
        return found

    def _of_file(self, path: Path) -> list[Written]:
        at = self._read_to.get(path, 0)
        if at == path.stat().st_size:
            return []
        with open_buffer(path) as data:
            summary = None if at else read_summary(data)
            if summary is None:
                chunks = self._grown(data, path, at)
            else:
                chunks = self._indexed(data, summary)
                self._read_to[path] = len(data)
            return list(records_of(chunks, {self._channel}))

    def _indexed(self, data: Buffer, summary: Summary) -> Iterator[Chunk]:
        """Give the chunks of a finished file that hold the channel, by its index."""
        numbers = {n for n, c in summary.channels.items() if c.topic == self._channel}
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
