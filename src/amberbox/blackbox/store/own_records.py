"""The box's own records: the newest ones, or all new ones on some channels.

A journal is read backwards from its end, as far as needed; of old files only those with such
records.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.blackbox.journal import channels as journal_channels
from amberbox.blackbox.journal.chunk import Buffer, Chunk, decode_own_messages, open_buffer
from amberbox.blackbox.journal.mcap import McapSummary, read_summary
from amberbox.blackbox.journal.scan import JournalWalk, chunk_at
from amberbox.blackbox.journal.tail import FileTail
from amberbox.blackbox.store.store import Store
from amberbox.core.clock import NS

_FIRST_BYTES = 1 << 18
_MORE = 8
# How many files are read at most: a writer that was just started has written none yet
_FILES = 4


@dataclass(frozen=True, slots=True)
class WrittenRecord:
    """One record: its values, and when it was written in log time and wall time."""

    log_ns: int
    wall_ns: int
    channel: str
    values: Mapping[str, Any]


def newest_records(
    store: Store, writer: str, channels: Collection[str], lookback_s: float
) -> list[WrittenRecord]:
    """Return the records of the last ``lookback_s`` before the newest of them, in order.

    Empty where the writer has written none lately.
    """
    found: list[WrittenRecord] = []
    for path in reversed(store.journal_files(writer)[-_FILES:]):
        with suppress(FileNotFoundError):  # deleted meanwhile
            found = [*_of_file(path, channels, lookback_s), *found]
        if found and _reaches(found, lookback_s):
            break
    start_ns = found[-1].log_ns - round(lookback_s * NS) if found else 0
    return [record for record in found if record.log_ns >= start_ns]


def _reaches(found: list[WrittenRecord], lookback_s: float) -> bool:
    return found[-1].log_ns - found[0].log_ns >= lookback_s * NS


def _of_file(path: Path, channels: Collection[str], lookback_s: float) -> list[WrittenRecord]:
    """Read increasing parts of a file's end until there are enough records."""
    with open_buffer(path) as data:
        size = _FIRST_BYTES
        while True:
            at = max(len(data) - size, 0)
            walk = JournalWalk(data, at=at, trusted=at)
            chunks = (found for found in walk if isinstance(found, Chunk))
            records = list(records_of(chunks, channels))
            if not at or (records and _reaches(records, lookback_s)):
                return records
            size *= _MORE


def records_of(chunks: Iterable[Chunk], channels: Collection[str]) -> Iterator[WrittenRecord]:
    """Yield the records of some of the box's own channels in chunks that follow each other."""
    wanted = {*channels, journal_channels.CLOCK}
    offset_ns = 0
    for log_ns, channel, values in (
        found for c in chunks for found in decode_own_messages(c, wanted)
    ):
        if channel == journal_channels.CLOCK:
            offset_ns = int(values["offset_ns"])
        else:
            yield WrittenRecord(log_ns, log_ns + offset_ns, channel, values)


_END_BYTES = 1 << 20  # the last whole record of a file is searched in this many bytes at its end


class OwnRecords:
    """Reads all records of some channels of a writer's journal, and later added ones."""

    def __init__(self, store: Store, writer: str, channels: Collection[str]) -> None:
        self._store = store
        self._writer = writer
        self._channels = frozenset(channels)
        self._read_to: dict[Path, int] = {}

    def skip(self) -> None:
        """Skip all present records."""
        for path in self._store.journal_files(self._writer):
            with suppress(FileNotFoundError):  # deleted meanwhile
                self._read_to[path] = _end_of_records(path)

    def step(self) -> list[WrittenRecord]:
        """Return the records added since the last step, in order; at first all."""
        found: list[WrittenRecord] = []
        paths = self._store.journal_files(self._writer)
        self._read_to = {path: at for path, at in self._read_to.items() if path in paths}
        for path in paths:
            with suppress(FileNotFoundError):
                found += self._of_file(path)
        return found

    def _of_file(self, path: Path) -> list[WrittenRecord]:
        at, size = self._read_to.get(path, 0), path.stat().st_size
        if at == size:
            return []
        if at > size:  # another store's file has taken its place
            at = 0
        if not at:
            with open_buffer(path) as data:
                summary = read_summary(data)
                if summary is not None:
                    self._read_to[path] = len(data)
                    return list(records_of(self._indexed(data, summary), self._channels))
        tail = FileTail(path, at)
        found = list(records_of(tail.chunks(), self._channels))
        self._read_to[path] = tail.at
        return found

    def _indexed(self, data: Buffer, summary: McapSummary) -> Iterator[Chunk]:
        """Yield the chunks of a finished file that hold the channels, by its index."""
        numbers = {n for n, c in summary.channels.items() if c.topic in self._channels}
        for place in summary.chunks:
            held = {number for number, _ in place.index_offsets}
            chunk = chunk_at(data, place.offset) if held & numbers else None
            if chunk is not None:
                yield chunk


def _end_of_records(path: Path) -> int:
    """Return where the last record ends that is written whole."""
    with open_buffer(path) as data:
        if read_summary(data) is not None:
            return len(data)
        at = max(len(data) - _END_BYTES, 0)
        walk = JournalWalk(data, at=at, trusted=at)
        for _ in walk:
            pass
        return walk.trusted if walk.trusted > at else 0
