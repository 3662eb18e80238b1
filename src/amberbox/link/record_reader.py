"""The link's reader of a robot's record: reach of journals, raw rows, live values.

The reach is how far a writer's journals go and how much of them survives a power cut. Live values
are the latest of the watched variables and are never stored by the link. Events of the link itself
are written into the record by the retention service.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.columns.arrays import element
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.journal.tail import JournalHead, read_head
from amberbox.blackbox.signing.signatures import LOCKS
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.journal_reader import journal_file
from amberbox.blackbox.store.store import Store, is_locked, request_event, run_and_number
from amberbox.blackbox.store.tail import Delivery, WriterTail, follow
from amberbox.core.errors import AmberboxError
from amberbox.core.files import sync_file
from amberbox.core.types import Batch, IntArray, Ragged, WriterCursor
from amberbox.link import limits
from amberbox.link.frames import START, JournalPosition, LinkRow, RunEnd, WriterReach


class ReachReader:
    """Reads how far the journals of a store reach; a closed run is read once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._closed: dict[tuple[str, int], RunEnd] = {}

    def state(self) -> dict[str, WriterReach]:
        """Return the reach of each writer whose rows are sent over the link."""
        return {w: self.of(w) for w in limits.WRITERS if self._store.folder(w).is_dir()}

    def of(self, writer: str) -> WriterReach:
        """Return the reach of a writer's journals."""
        lock = LOCKS.get(writer, writer)
        alive = is_locked(self._store, lock)  # before the files, which may grow until it is free
        head = read_head(self._store.folder(writer))
        last = {run_and_number(path)[0]: path for path in self._store.journal_files(writer)}
        alive = alive or is_locked(self._store, lock)  # the newest run may have begun in between
        runs = sorted(last)
        if not runs:
            at = START if head is None else JournalPosition(head.run, head.next_seq)
            return WriterReach(at, at, at)
        stated = runs[-limits.RUNS_STATED :]
        ends = [self._closed_run(writer, run, last[run]) for run in stated[:-1]]
        newest, durable = self._newest(writer, stated[-1], last[stated[-1]], head, alive=alive)
        return WriterReach(
            _oldest(self._store, writer, runs[0]), JournalPosition(newest.run, newest.end_seq),
            JournalPosition(newest.run, durable), (*ends, newest),
        )  # fmt: skip

    def _newest(
        self, writer: str, run: int, path: Path, head: JournalHead | None, *, alive: bool
    ) -> tuple[RunEnd, int]:
        """Return the newest run and the end of its durable part."""
        if not alive:
            closed = self._closed_run(writer, run, path)
            return closed, closed.end_seq
        if head is not None and head.run == run and head.store_id == self._store.id:
            durable = min(head.durable_seq, head.next_seq)
            return RunEnd(run, _boot(path), _open_end(path, head), closed=False), durable
        return RunEnd(run, _boot(path), _end_of(path), closed=False), 0

    def _closed_run(self, writer: str, run: int, path: Path) -> RunEnd:
        """Return a closed run, and make its end durable first."""
        known = self._closed.get((writer, run))
        if known is None:
            with suppress(FileNotFoundError):
                sync_file(path)  # its stated end has to survive a power cut
            known = self._closed[writer, run] = RunEnd(run, _boot(path), _end_of(path))
        return known


def _boot(path: Path) -> str:
    return path.stem.split("-")[1]


def _open_end(path: Path, head: JournalHead) -> int:
    """Return the end of a run that is being written.

    The head is written after the file, sometimes only at a sync, and not at all by a killed writer.
    Rows are sent from the file, so an end before them would state that they were lost.
    """
    try:
        is_all = head.file == path.name and path.stat().st_size <= head.size
    except FileNotFoundError:
        is_all = True
    return head.next_seq if is_all else max(head.next_seq, _end_of(path))


def _end_of(path: Path) -> int:
    try:
        return journal_file(path, f"{path.parent.name}/{path.name}").end_seq
    except FileNotFoundError:  # deleted meanwhile: the next call returns the rest
        return 0


def _oldest(store: Store, writer: str, run: int) -> JournalPosition:
    path = store.journal_files(writer)[0]
    try:
        return JournalPosition(run, int(start_record(path).get("first_seq", 0)))
    except FileNotFoundError:
        return JournalPosition(run, 0)


# Items whose rows are sent over the link
ITEMS = frozenset(channel.replace("/", "_") for channel in limits.CHANNELS)


class RawRowTail(WriterTail):
    """Follows a writer's journals and returns their rows undecoded.

    Rows of journals that were deleted before being read are skipped; only their columns remain.
    ``too_large`` counts rows that fit in no frame; they arrive with their journal.
    """

    def __init__(self, store: Store, writer: str, start: JournalPosition) -> None:
        super().__init__(store, writer, ITEMS, WriterCursor(start.run, start.seq))
        self._found: list[LinkRow] = []
        self._stepping: Iterator[Delivery] | None = None
        self.too_large = 0

    @property
    def place(self) -> JournalPosition:
        """The position up to which all rows were returned."""
        return JournalPosition(self.run, self.seq)

    def pull(self, most: int) -> list[LinkRow]:
        """Read until there are at least ``most`` rows, or nothing new; return them in order."""
        if self._stepping is None:
            self._stepping = self.step()
        for _ in self._stepping:
            if len(self._found) >= most:
                break
        else:
            self._stepping = None
        found, self._found = self._found, []
        return sorted(found, key=lambda row: row.place)

    def _item_rows(
        self,
        item: str,
        rows: IntArray,
        chunk: Chunk,
        seq: IntArray,
        clock: ClockTable,
        streams: Any,
    ) -> Iterator[Delivery]:
        """Collect the raw rows of an item in a chunk; nothing is unrolled."""
        numbers, times = seq[rows].tolist(), chunk.log_ns[rows].tolist()
        channels = [streams[n].topic.name for n in chunk.channel[rows].tolist()]
        for number, at_ns, channel, data in zip(
            numbers, times, channels, chunk.messages(rows), strict=True
        ):
            if len(data) > limits.ROW_BYTES:
                self.too_large += 1
            elif channel in limits.CHANNELS:
                self._found.append(LinkRow(self.writer, self.run, number, channel, at_ns, data))
        if numbers:
            self.ahead[item] = numbers[-1] + 1
        yield from ()


Value = tuple[int, float | str | None]
_LOOKBACK_S = 0.5


class LiveValues:
    """Follows the items of the watched variables in a thread; only while any is watched."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._latest: dict[str, Value] = {}
        self._lock = threading.Lock()
        self._stop: threading.Event | None = None

    def watch(self, variables: Sequence[str]) -> None:
        """Watch these variables from now on, instead of earlier ones."""
        self.close()
        items = by_item(variables)
        if items:
            self._stop = threading.Event()
            threading.Thread(
                target=self._follow, args=(items, self._stop), name="link live", daemon=True
            ).start()

    def take(self) -> dict[str, Value]:
        """Return the latest value of each variable that has changed since the last call."""
        with self._lock:
            found, self._latest = self._latest, {}
        return found

    def close(self) -> None:
        """Stop watching."""
        if self._stop is not None:
            self._stop.set()
            self._stop = None
        self.take()

    def _follow(self, items: Mapping[str, Sequence[str]], stop: threading.Event) -> None:
        try:
            for found in follow(self._store.path, items, None, _LOOKBACK_S, stop=stop):
                if stop.is_set():
                    return
                if isinstance(found, Batch):
                    values = dict(latest_values(found, items[found.item]))
                    with self._lock:
                        self._latest.update(values)
        except (AmberboxError, OSError):
            return  # the store is gone, which the link reports


def by_item(variables: Sequence[str]) -> dict[str, list[str]]:
    """Group addresses ``item.variable`` by item."""
    found: dict[str, list[str]] = {}
    for address in variables:
        item, dot, variable = address.partition(".")
        if dot:
            found.setdefault(item, []).append(variable)
    return found


def latest_values(batch: Batch, variables: Sequence[str]) -> Iterator[tuple[str, Value]]:
    """Yield the last value of each variable of a batch, or element of a list (``ranges[90]``), with
    its receive time.
    """
    at_ns = int(batch.received_ns[-1])
    for variable in variables:
        name, _, index = variable.removesuffix("]").partition("[")
        column = batch.columns.get(name)
        if isinstance(column, Ragged) and index.isdecimal():
            column = element(column, int(index))
        if isinstance(column, np.ndarray) and column.ndim == 1 and len(column):
            yield f"{batch.item}.{variable}", (at_ns, _plain(column[-1]))


def _plain(value: Any) -> float | str | None:
    """Return a number, or a text of at most 200 characters; None for any other value."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, str):
        return value[:200]
    return float(value) if isinstance(value, (int, float)) else None


SOURCE = "link"


class LinkEvents:
    """Records events of the link, each once as long as its text stays the same."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._emitted: dict[str, str] = {}

    def emit(self, kind: str, text: str) -> None:
        """Record an event, unless the last one of its kind has the same text."""
        if self._emitted.get(kind) != text:
            self._emitted[kind] = text
            request_event(self._store, kind, text, SOURCE)

    def clear(self, kind: str) -> None:
        """Note that a condition has ended, so that its event may be recorded again."""
        self._emitted.pop(kind, None)
