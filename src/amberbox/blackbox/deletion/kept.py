"""The box's own records of a journal that goes before it has columns, copied to where they stay."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.follow.chain import previous_chain
from amberbox.blackbox.follow.read import JournalFile, files_of, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.store import Store
from amberbox.core.clock import SystemClock

WRITER = "kept"
_LEFT_OUT = (reserved.CLOCK, reserved.COUNTERS, reserved.RUN)
"""Clocks are in the copies' times, runs in the tombstone; counters go with what they count."""
_TIMES = ("from_ns", "to_ns")


@dataclass(frozen=True, slots=True)
class OwnRecord:
    """A record of the box's own; ``received_ns`` is corrected, and so are times in its values."""

    topic: str
    received_ns: int
    data: bytes


class KeptJournal:
    """Takes own records for good. A copy that was cut short is not made twice."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._writer: JournalWriter | None = None
        self._channels: dict[str, int] = {}

    def keep(self, journal: JournalFile) -> int:
        """Copy a journal's own records, durable when this returns; tell how many.

        Raises OSError when the disk does not take them.
        """
        records = list(own_records(journal))
        present = self._present(records) if records else set()
        new = [record for record in records if record not in present]
        if new:
            self._write(new)
        return len(new)

    def close(self) -> None:
        """Finish the file, if one was begun."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _present(self, records: list[OwnRecord]) -> set[OwnRecord]:
        first, last = records[0].received_ns, records[-1].received_ns
        found: set[OwnRecord] = set()
        for journal in files_of(self._store, WRITER):
            if journal.rows and journal.start_ns <= last and journal.end_ns >= first:
                found.update(own_records(journal))
        return found

    def _write(self, records: list[OwnRecord]) -> None:
        writer = self._opened()
        if writer.rotation_due(records[0].received_ns):
            writer.rotate()
        channels = [self._channel(writer, record.topic) for record in records]
        at_ns = [record.received_ns for record in records]
        writer.write(channels, at_ns, at_ns, [record.data for record in records])
        writer.mark_sync().wait()

    def _opened(self) -> JournalWriter:
        if self._writer is None:
            store, boot = self._store, SystemClock().boot_id()
            options = JournalOptions(
                store.folder(WRITER), store.id, WRITER, store.next_run(), boot, rotate_ns=1 << 62
            )
            self._channels = {}
            self._writer = JournalWriter(options, chain=previous_chain(store, WRITER))
        return self._writer

    def _channel(self, writer: JournalWriter, topic: str) -> int:
        if topic not in self._channels:
            marks = {"item": topic.replace("/", "_"), "source": reserved.SOURCE}
            self._channels[topic] = writer.channel(reserved.topic_of(topic), marks)
        return self._channels[topic]


def own_records(journal: JournalFile) -> Iterator[OwnRecord]:
    """Give a journal's own records that stay when the data around them go, in order."""
    wanted = {
        number: stream.topic.name
        for number, stream in journal.streams.items()
        if stream.source == reserved.SOURCE and stream.topic.name not in _LEFT_OUT
    }
    clock = ClockTable(journal.clock)
    for chunk in sound_chunks(journal) if wanted else ():
        yield from _of_chunk(chunk, wanted, clock)


def _of_chunk(chunk: Chunk, wanted: dict[int, str], clock: ClockTable) -> Iterator[OwnRecord]:
    rows = np.flatnonzero(np.isin(chunk.channel, list(wanted)))
    log_ns = chunk.log_ns[rows]
    received = clock.received(log_ns)
    for row, at_ns, offset_ns, data in zip(
        rows.tolist(), received.tolist(), (received - log_ns).tolist(), chunk.messages(rows),
        strict=True,
    ):  # fmt: skip
        topic = wanted[int(chunk.channel[row])]
        if topic == reserved.GAP:
            data = _corrected(data, offset_ns)
        yield OwnRecord(topic, at_ns, data)


def _corrected(data: bytes, offset_ns: int) -> bytes:
    """Move the times of a gap, which are log times, as the record's own was moved."""
    if not offset_ns:
        return data
    values: dict[str, Any] = json.loads(data)
    moved = {n: values[n] + offset_ns for n in _TIMES if isinstance(values.get(n), int)}
    return msgspec.json.encode({**values, **moved}) if moved else data
