"""A journal of conclusions: what the keeper (or the watcher) writes down, in the one format."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec
import numpy as np

from amberbox import __version__
from amberbox.blackbox.follow.read import newest_first, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.keeper.ownstreams import Message, Own, Streams
from amberbox.blackbox.keeper.syncthread import SyncThread
from amberbox.blackbox.store import Store
from amberbox.core.clock import Clock, RunClock, SystemClock
from amberbox.core.types import Cursor

Record = tuple[str, Mapping[str, Any]]
"""Reserved channel and values of one record."""


class LogClock(Protocol):
    """What stamps the records: a RunClock, or the log time of the recorder that is followed."""

    def now_ns(self) -> int:
        """Log time now."""

    def boot_ns(self, log_ns: int) -> int | None:
        """Time since the computer's start at a log time; None if it does not count from there."""

    def offset_ns(self) -> int:
        """Wall minus log time."""

    def synchronised(self) -> bool | None:
        """Tell whether the wall clock is disciplined; None if nobody can know."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a reader of other journals has come, and what it has to know when it goes on."""

    cursor: Cursor
    reader: str = ""
    state: str = ""


class OwnJournal:
    """Appends records of the box's own to a writer's journal, durable when ``write`` returns.

    ``append`` does not wait for that. The first write begins a run and its file. One owner, who
    holds the store's lock; any thread. ``first`` gives what each file begins with.
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
        first: Callable[[], Sequence[Message]] = tuple,
    ) -> None:
        self._store = store
        self._writer_name = writer
        self._about = {"robot": robot, "config_hash": config_hash, "input": ""}
        self.clock = clock or SystemClock()
        self._log: LogClock = RunClock(self.clock)
        self._chain = chain
        self._each_file = first
        self._writer: JournalWriter | None = None
        self._streams = Streams()
        self._sync = SyncThread()
        self._last_ns = 0
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """Log time of a record that is written now."""
        return self._log.now_ns()

    def begin_run(self, log: LogClock, of: str) -> None:
        """Begin a run with the next write, on another axis of log time; ``of`` is its input."""
        with self._lock:
            self._finish()
            self._log = log
            self._about["input"] = of

    def write(self, records: Sequence[Record], progress: Progress | None = None) -> None:
        """Write records, and how far others had been read for them, as one chunk.

        Raises OSError when the disk does not take them.
        """
        with self._lock:
            self._write([*map(_own, records), *_said(progress)])
            assert self._writer is not None
            self._sync.finish()
            self._writer.mark_sync().wait()
            self._writer.publish_head(self._last_ns)

    def append(
        self, rows: Sequence[Message], progress: Sequence[Progress] = (), *, urgent: bool = False
    ) -> None:
        """Write rows as ``write`` does, without waiting for the disk.

        They are durable after a second, or with ``urgent`` as soon as the disk can. Raises OSError
        when an earlier write did not reach the disk.
        """
        with self._lock:
            self._write([*rows, *(message for entry in progress for message in _said(entry))])
            assert self._writer is not None
            self._sync.see_to(self._writer.mark_sync, urgent=urgent)
            self._writer.publish_head(self._last_ns)

    def _write(self, messages: Sequence[Message]) -> None:
        writer = self._opened()
        if writer.rotation_due(self._log.now_ns()):
            writer.rotate()
        now_ns = self._last_ns = self._log.now_ns()
        clock = Own(reserved.CLOCK, self._clock_record(now_ns))
        first: list[Message] = [clock] if writer.path is not None else self._first(writer, clock)
        rows = [self._streams.placed(writer, message) for message in (*first, *messages)]
        at_ns = [now_ns] * len(rows)
        writer.write([channel for channel, _ in rows], at_ns, at_ns, [data for _, data in rows])

    def _first(self, writer: JournalWriter, clock: Own) -> list[Message]:
        """Return what a file begins with."""
        return [self._about_run(writer), clock, *self._each_file()]

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
            self._streams.begin()
        return self._writer

    def _about_run(self, writer: JournalWriter) -> Own:
        about = {
            "writer": self._writer_name,
            "run": writer.options.run,
            "store_id": self._store.id,
            "boot_id": self.clock.boot_id(),
            "version": __version__,
            "items": "{}",
            **self._about,
        }
        return Own(reserved.RUN, msgspec.json.encode(about))

    def _clock_record(self, at_ns: int) -> bytes:
        return msgspec.json.encode({
            "offset_ns": self._log.offset_ns(),
            "synchronised": self._log.synchronised(),
            "boot_ns": self._log.boot_ns(at_ns),
        })  # fmt: skip


def _own(record: Record) -> Own:
    topic, values = record
    return Own(topic, msgspec.json.encode(values))


def _said(progress: Progress | None) -> Iterator[Own]:
    """Give the record that says how far a reader has come."""
    if progress is not None:
        values = {"cursor": progress.cursor.to_json(), "reader": progress.reader}
        yield _own((reserved.CURSOR, {**values, "state": progress.state}))


def event(kind: str, text: str, source: str = "", **details: Any) -> Record:
    """Compose an event as the recorder writes them."""
    encoded = msgspec.json.encode(details, enc_hook=str).decode()
    return reserved.EVENT, {"kind": kind, "text": text, "source": source, "details": encoded}


def last_progress(store: Store, writer: str, reader: str = "") -> Progress | None:
    """Return how far a reader had come when the writer wrote it down last; None if it never did."""
    for journal in newest_first(store, writer):
        numbers = [n for n, s in journal.streams.items() if s.topic.name == reserved.CURSOR]
        newest = None
        for chunk in sound_chunks(journal) if numbers else ():
            for message in chunk.messages(np.flatnonzero(np.isin(chunk.channel, numbers))):
                values = msgspec.json.decode(message)
                newest = values if values.get("reader", "") == reader else newest
        if newest is not None:
            cursor = Cursor.from_json(newest["cursor"])
            return Progress(cursor, reader, newest.get("state", ""))
    return None
