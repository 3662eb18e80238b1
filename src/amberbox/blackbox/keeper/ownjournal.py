"""A journal of conclusions: what the keeper (or the watcher) writes down, in the one format."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from amberbox import __version__
from amberbox.blackbox.follow.read import newest_first, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.store import Store
from amberbox.core.clock import Clock, RunClock, SystemClock
from amberbox.core.types import Cursor

Record = tuple[str, Mapping[str, Any]]
"""Reserved channel and values of one record."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a reader of other journals has come, and what it has to know when it goes on."""

    cursor: Cursor
    reader: str = ""
    state: str = ""


class OwnJournal:
    """Appends records of the box's own to a writer's journal, durable when ``write`` returns.

    The first write begins a run and its file. One owner, who holds the store's lock; any thread.
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
    ) -> None:
        self._store = store
        self._writer_name = writer
        self._about = {"robot": robot, "config_hash": config_hash}
        self._clock = clock or SystemClock()
        self._log = RunClock(self._clock)
        self._chain = chain
        self._writer: JournalWriter | None = None
        self._channels: dict[str, int] = {}
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """Log time of a record that is written now."""
        return self._log.now_ns()

    def write(self, records: Sequence[Record], progress: Progress | None = None) -> None:
        """Write records, and how far others had been read for them, as one chunk.

        Raises OSError when the disk does not take them.
        """
        with self._lock:
            self._write(records, progress)

    def _write(self, records: Sequence[Record], progress: Progress | None) -> None:
        writer = self._opened()
        rows = [(topic, msgspec.json.encode(values)) for topic, values in records]
        if progress is not None:
            values = {"cursor": progress.cursor.to_json(), "reader": progress.reader}
            values["state"] = progress.state
            rows.append((reserved.CURSOR, msgspec.json.encode(values)))
        if writer.rotation_due(self._log.now_ns()):
            writer.rotate()
        now_ns = self._log.now_ns()
        clock = (reserved.CLOCK, self._clock_record(now_ns))
        rows[:0] = [clock] if writer.path is not None else [self._about_run(writer), clock]
        at_ns = [now_ns] * len(rows)
        channels = [self._channel(writer, topic) for topic, _ in rows]
        writer.write(channels, at_ns, at_ns, [data for _, data in rows])
        writer.mark_sync().wait()
        writer.publish_head(at_ns[0])

    def close(self) -> None:
        """Finish the file, if one was begun."""
        with self._lock:
            if self._writer is not None:
                self._writer.close()
                self._writer = None

    def _opened(self) -> JournalWriter:
        if self._writer is None:
            options = JournalOptions(
                self._store.folder(self._writer_name), self._store.id, self._writer_name,
                self._store.next_run(), self._clock.boot_id(),
            )  # fmt: skip
            chain = {} if self._chain is None else {"chain": self._chain()}
            self._writer, self._channels = JournalWriter(options, **chain), {}
        return self._writer

    def _about_run(self, writer: JournalWriter) -> tuple[str, bytes]:
        about = {
            "writer": self._writer_name,
            "run": writer.options.run,
            "store_id": self._store.id,
            "boot_id": self._clock.boot_id(),
            "version": __version__,
            "items": "{}",
            "input": "",
            **self._about,
        }
        return reserved.RUN, msgspec.json.encode(about)

    def _clock_record(self, at_ns: int) -> bytes:
        return msgspec.json.encode({
            "offset_ns": self._log.offset_ns(),
            "synchronised": self._log.synchronised(),
            "boot_ns": self._log.boot_ns(at_ns),
        })  # fmt: skip

    def _channel(self, writer: JournalWriter, topic: str) -> int:
        if topic not in self._channels:
            marks = {"item": topic.replace("/", "_"), "source": reserved.SOURCE}
            self._channels[topic] = writer.channel(reserved.topic_of(topic), marks)
        return self._channels[topic]


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
