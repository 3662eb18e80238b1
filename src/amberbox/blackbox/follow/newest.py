"""The newest records of the box's own in a journal, read from its end back and no further."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.walk import Walk
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS

_FIRST_BYTES = 1 << 18
_MORE = 8
_FILES = 4
"""How many files are looked into at most: a writer that was just started has said nothing yet."""


@dataclass(frozen=True, slots=True)
class Written:
    """One record: what it says, and when it was written in log time and wall time."""

    log_ns: int
    wall_ns: int
    channel: str
    values: Mapping[str, Any]


def newest_records(
    store: Store, writer: str, channels: Collection[str], lookback_s: float
) -> list[Written]:
    """Return the records of the last ``lookback_s`` before the newest of them, in order.

    Empty where the writer has written none lately.
    """
    found: list[Written] = []
    for path in reversed(store.journal_files(writer)[-_FILES:]):
        with suppress(FileNotFoundError):  # deleted meanwhile
            found = [*_of_file(path, channels, lookback_s), *found]
        if found and _reaches(found, lookback_s):
            break
    start_ns = found[-1].log_ns - round(lookback_s * NS) if found else 0
    return [record for record in found if record.log_ns >= start_ns]


def _reaches(found: list[Written], lookback_s: float) -> bool:
    return found[-1].log_ns - found[0].log_ns >= lookback_s * NS


def _of_file(path: Path, channels: Collection[str], lookback_s: float) -> list[Written]:
    """Read a file's end, more and more of it until that is enough."""
    with open_buffer(path) as data:
        size = _FIRST_BYTES
        while True:
            at = max(len(data) - size, 0)
            walk = Walk(data, at=at, trusted=at)
            chunks = (found for found in walk if isinstance(found, Chunk))
            records = list(records_of(chunks, channels))
            if not at or (records and _reaches(records, lookback_s)):
                return records
            size *= _MORE


def records_of(chunks: Iterable[Chunk], channels: Collection[str]) -> Iterator[Written]:
    """Give the records of some of the box's own channels in chunks that follow each other."""
    wanted = {*channels, reserved.CLOCK}
    offset_ns = 0
    for log_ns, channel, message in (found for c in chunks for found in _messages(c, wanted)):
        values = msgspec.json.decode(message)
        if channel == reserved.CLOCK:
            offset_ns = int(values["offset_ns"])
        else:
            yield Written(log_ns, log_ns + offset_ns, channel, values)


def _messages(chunk: Chunk, channels: Collection[str]) -> Iterator[tuple[int, str, bytes]]:
    topics = {n: c.topic for n, c in chunk.channels.items() if c.topic in channels}
    rows = np.flatnonzero(np.isin(chunk.channel, list(topics)))
    numbers, times = chunk.channel[rows].tolist(), chunk.log_ns[rows].tolist()
    for number, log_ns, message in zip(numbers, times, chunk.messages(rows), strict=True):
        yield log_ns, topics[number], message
