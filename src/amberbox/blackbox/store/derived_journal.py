"""A derived journal: the one way to write conclusions (events, missions, statuses) into a store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import msgspec
import numpy as np

from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter, SyncMark
from amberbox.blackbox.store.journal_reader import newest_first, sound_chunks
from amberbox.blackbox.store.store import Store
from amberbox.core.clock import Clock, LogClock, RunClock, SystemClock
from amberbox.core.types import Cursor, Schema, Topic
from amberbox.core.version import __version__


@dataclass(frozen=True, slots=True)
class EncodedRecord:
    """A record on a reserved channel, as JSON."""

    topic: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ItemMessage:
    """A message of a data item that the owner of the journal has measured itself."""

    topic: str
    item: str
    source: str
    values: Mapping[str, Any]


DerivedMessage: TypeAlias = EncodedRecord | ItemMessage


@dataclass(slots=True)
class DerivedStreams:
    """Channels of one run; those of items get another one where their schema has to widen."""

    _own: dict[str, int] = field(default_factory=dict)
    _channels: dict[str, int] = field(default_factory=dict)
    _schemas: dict[str, Schema] = field(default_factory=dict)

    def begin(self) -> None:
        """Begin a run: no channel is known to its writer yet."""
        self._own.clear()
        self._channels.clear()

    def placed(self, writer: JournalWriter, message: DerivedMessage) -> tuple[int, bytes]:
        """Return channel and bytes of a message."""
        if isinstance(message, EncodedRecord):
            return self.own_channel(writer, message.topic), message.data
        data = msgspec.json.encode(message.values)
        return self._channel(writer, message, data), data

    def own_channel(self, writer: JournalWriter, topic: str) -> int:
        """Return the channel of the box's own records of a topic."""
        if topic not in self._own:
            marks = {"item": topic.replace("/", "_"), "source": channels.SOURCE}
            self._own[topic] = writer.channel(channels.topic_of(topic), marks)
        return self._own[topic]

    def _channel(self, writer: JournalWriter, row: ItemMessage, data: bytes) -> int:
        before = self._schemas.get(row.item)
        schema, _ = widen_schema(before, [data], "json", row.topic)
        if schema is not before or row.item not in self._channels:
            self._schemas[row.item] = schema
            marks = {"item": row.item, "source": row.source}
            self._channels[row.item] = writer.channel(Topic(row.topic, "json", schema), marks)
        return self._channels[row.item]


SYNC_S = 1.0  # appended records are durable after this long at the latest


class SyncThread:
    """Flushes written data, one flush at a time; call ``flush_if_due`` after each write."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._thread: threading.Thread | None = None
        self._due_s = 0.0
        self._is_urgent = False
        self._failure: OSError | None = None

    def flush_if_due(self, mark: Callable[[], SyncMark], *, urgent: bool) -> None:
        """Begin to flush if it is time, or urgent, and no flush is under way.

        ``mark`` closes a link of the journal's chain; it is called where a flush begins. Raises
        OSError when the flush before failed.
        """
        self._is_urgent = self._is_urgent or urgent
        if self._thread is not None and self._thread.is_alive():
            return
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        if self._is_urgent or self._clock() >= self._due_s:
            self._is_urgent, self._due_s = False, self._clock() + SYNC_S
            self._thread = threading.Thread(target=self._flush, args=(mark(),), daemon=True)
            self._thread.start()

    def _flush(self, mark: SyncMark) -> None:
        try:
            mark.wait()
        except OSError as error:
            self._failure = error

    def finish(self) -> None:
        """Wait for the flush that is under way."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None


ChannelValues = tuple[str, Mapping[str, Any]]  # reserved channel and values of one record


@dataclass(frozen=True, slots=True)
class ReaderProgress:
    """The position of a reader of other journals, and the state it needs to resume."""

    cursor: Cursor
    reader: str = ""
    state: str = ""


class DerivedJournal:
    """Appends records of the box's own to a writer's journal, durable when ``write`` returns.

    ``append`` does not wait until it is durable. The first write begins a run and its file. One
    owner, who holds the store's lock; any thread. ``first`` returns the records at the start of
    each file.
    """

    def __init__(
        self,
        store: Store,
        writer: str,
        *,
        robot: str = "",
        config_hash: str = "",
        clock: Clock | None = None,
        chain: Callable[[], str] | None = None,
        first: Callable[[], Sequence[DerivedMessage]] = tuple,
    ) -> None:
        self._store = store
        self._writer_name = writer
        self._about = {"robot": robot, "config_hash": config_hash, "input": ""}
        self.clock = clock or SystemClock()
        self._log: LogClock = RunClock(self.clock)
        self._chain = chain
        self._each_file = first
        self._writer: JournalWriter | None = None
        self._streams = DerivedStreams()
        self._sync = SyncThread()
        self._last_ns = 0
        self._published_seq = 0
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """Return the log time (ns) of a record that is written now."""
        return self._log.now_ns()

    def begin_run(self, log: LogClock, of: str) -> None:
        """Begin a run with the next write, on another axis of log time; ``of`` is its input."""
        with self._lock:
            self._finish()
            self._log = log
            self._about["input"] = of

    def write(
        self, records: Sequence[ChannelValues], progress: ReaderProgress | None = None
    ) -> None:
        """Write records, and the reading positions they are derived from, as one chunk.

        Raises OSError when writing fails.
        """
        with self._lock:
            self._write([*map(_own, records), *_progress_records(progress)])
            assert self._writer is not None
            self._sync.finish()
            self._writer.mark_sync().wait()
            self._publish(self._writer)

    def append(
        self,
        rows: Sequence[DerivedMessage],
        progress: Sequence[ReaderProgress] = (),
        *,
        urgent: bool = False,
    ) -> None:
        """Write rows as ``write`` does, without waiting for the disk.

        They are durable after a second, or with ``urgent`` as soon as the disk can. Raises OSError
        when an earlier write did not reach the disk.
        """
        with self._lock:
            self._write(
                [*rows, *(message for entry in progress for message in _progress_records(entry))]
            )
            assert self._writer is not None
            self._sync.flush_if_due(self._writer.mark_sync, urgent=urgent)
            self._publish(self._writer)

    def keep_up(self) -> None:
        """Flush and publish what was appended, and finish a file that is old enough.

        For a writer that may append nothing for hours; it does not wait for the disk. Raises
        OSError when an earlier write did not reach the disk.
        """
        with self._lock:
            writer = self._writer
            if writer is None:
                return
            if writer.durable_seq < writer.next_seq:
                self._sync.flush_if_due(writer.mark_sync, urgent=True)
            if self._published_seq < writer.durable_seq:
                self._publish(writer)
            if writer.rotation_due(self._log.now_ns()):
                writer.rotate()

    def _publish(self, writer: JournalWriter) -> None:
        self._published_seq = writer.durable_seq
        writer.publish_head(self._last_ns)

    def _write(self, messages: Sequence[DerivedMessage]) -> None:
        writer = self._opened()
        if writer.rotation_due(self._log.now_ns()):
            writer.rotate()
        now_ns = self._last_ns = self._log.now_ns()
        clock = EncodedRecord(channels.CLOCK, self._clock_record(now_ns))
        first: list[DerivedMessage] = (
            [clock] if writer.path is not None else self._first(writer, clock)
        )
        rows = [self._streams.placed(writer, message) for message in (*first, *messages)]
        at_ns = [now_ns] * len(rows)
        writer.write([channel for channel, _ in rows], at_ns, at_ns, [data for _, data in rows])

    def _first(self, writer: JournalWriter, clock: EncodedRecord) -> list[DerivedMessage]:
        """Return the messages at the start of a file."""
        about = {
            "writer": self._writer_name,
            "run": writer.options.run,
            "store_id": self._store.id,
            "boot_id": self.clock.boot_id(),
            "version": __version__,
            "items": "{}",
            **self._about,
        }
        return [EncodedRecord(channels.RUN, msgspec.json.encode(about)), clock, *self._each_file()]

    def close(self) -> None:
        """Finish the file, if one was begun."""
        with self._lock:
            self._finish()

    def _finish(self) -> None:
        self._sync.finish()
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _opened(self) -> JournalWriter:
        if self._writer is None:
            options = JournalOptions(
                self._store.folder(self._writer_name), self._store.id, self._writer_name,
                self._store.next_run(), self.clock.boot_id(),
            )  # fmt: skip
            chain = {} if self._chain is None else {"chain": self._chain()}
            self._writer = JournalWriter(options, **chain)
            self._published_seq = 0
            self._streams.begin()
        return self._writer

    def _clock_record(self, at_ns: int) -> bytes:
        return msgspec.json.encode({
            "offset_ns": self._log.offset_ns(),
            "synchronised": self._log.synchronised(),
            "boot_ns": self._log.boot_ns(at_ns),
        })  # fmt: skip


def _own(record: ChannelValues) -> EncodedRecord:
    topic, values = record
    return EncodedRecord(topic, msgspec.json.encode(values))


def _progress_records(progress: ReaderProgress | None) -> Iterator[EncodedRecord]:
    """Yield the record of a reader's position."""
    if progress is not None:
        values = {"cursor": progress.cursor.to_json(), "reader": progress.reader}
        yield _own((channels.CURSOR, {**values, "state": progress.state}))


def event(kind: str, text: str, source: str = "", **details: Any) -> ChannelValues:
    """Return an event in the form that the recorder writes."""
    encoded = msgspec.json.encode(details, enc_hook=str).decode()
    return channels.EVENT, {"kind": kind, "text": text, "source": source, "details": encoded}


def last_progress(store: Store, writer: str, reader: str = "") -> ReaderProgress | None:
    """Return the last position of a reader that the writer recorded; None if there is none."""
    for journal in newest_first(store, writer):
        numbers = [n for n, s in journal.streams.items() if s.topic.name == channels.CURSOR]
        newest = None
        for chunk in sound_chunks(journal) if numbers else ():
            for message in chunk.messages(np.flatnonzero(np.isin(chunk.channel, numbers))):
                values = msgspec.json.decode(message)
                newest = values if values.get("reader", "") == reader else newest
        if newest is not None:
            cursor = Cursor.from_json(newest["cursor"])
            return ReaderProgress(cursor, reader, newest.get("state", ""))
    return None
