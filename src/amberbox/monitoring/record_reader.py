"""Read a record in order of time, live or replayed, from all writers' journals.

Reading begins early enough that the windows of modes can be filled again.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.tail import JournalHead, read_head
from amberbox.blackbox.store.journal_reader import JournalFile, newest_first, run_messages
from amberbox.blackbox.store.store import Store, is_locked
from amberbox.blackbox.store.tail import RECORDED, WriterTail, go_back
from amberbox.core.clock import NS
from amberbox.core.given_answers import ITEM as ANSWERS
from amberbox.core.names import identifier
from amberbox.core.types import Batch, WriterCursor
from amberbox.monitoring.watcher_journal import Checkpoint, RecordEpoch, epoch_of

WATCH = "watch"
WRITERS = (*RECORDED, WATCH)


def before_end(store: Store, lookback_s: float) -> dict[str, WriterCursor]:
    """Return positions ``lookback_s`` before the end of each journal, or at the start of
    its epoch.
    """
    found = {}
    for writer in WRITERS:
        newest = next(newest_first(store, writer), None)
        if newest is not None:
            end = WriterCursor(newest.run, newest.end_seq)
            from_ns = newest.end_ns - round(lookback_s * NS)
            files = _files_of(store, writer, end, epoch_of_file(newest))
            found[writer] = go_back(files, end, from_ns)
    return found


def before_checkpoint(store: Store, left: Checkpoint) -> dict[str, WriterCursor]:
    """Return positions ``lookback_s`` before a checkpoint, or at the start of its epoch."""
    if left.lookback_s <= 0:
        return dict(left.positions)
    from_ns = left.place.until_ns - round(left.lookback_s * NS)
    return {
        writer: go_back(_files_of(store, writer, at, left.place.epoch), at, from_ns)
        for writer, at in left.positions.items()
    }


def at_time(store: Store, writer: str, from_ns: int) -> WriterCursor:
    """Return the start of the newest file that begins by a log time; else of the oldest."""
    at = WriterCursor()
    for journal in newest_first(store, writer):
        at = WriterCursor(journal.run, journal.first_seq)
        if journal.start_ns <= from_ns:
            break
    return at


def _files_of(
    store: Store, writer: str, at: WriterCursor, epoch: RecordEpoch | None
) -> Iterator[JournalFile]:
    """Yield the files of an epoch that have rows before a position, newest first.

    The position may be in a later epoch already.
    """
    found = False
    for journal in newest_first(store, writer):
        if (journal.run, journal.first_seq) >= (at.run, at.seq):
            continue
        matches = epoch_of_file(journal) == epoch
        if (found and not matches) or _is_before(journal, epoch):
            return
        if matches:
            found = True
            yield journal


def _is_before(journal: JournalFile, epoch: RecordEpoch | None) -> bool:
    """Return whether the recorder's run that a file is of was before that of an epoch."""
    of = epoch_of_file(journal)
    return epoch is not None and of is not None and of.run < epoch.run


def epoch_of_file(journal: JournalFile) -> RecordEpoch | None:
    """Return the epoch of a file, None if the file does not record it."""
    if journal.writer == WATCH:
        return epoch_of(str(run_messages(journal).get("input", "")))
    for reading in journal.readings:
        if reading.boot_ns is not None:
            return RecordEpoch(journal.run, reading.log_ns - reading.boot_ns)
    return RecordEpoch(journal.run, 0)


def comes_later(store: Store, epoch: RecordEpoch, than: RecordEpoch) -> bool:
    """Return whether an epoch is later than another one, by the recorder's files."""
    if epoch.run != than.run:
        return epoch.run > than.run
    for journal in newest_first(store, "main"):
        of = epoch_of_file(journal)
        if of == epoch:
            return True
        if of == than or _is_before(journal, than):
            return False
    return False


RUN = identifier(channels.RUN)
CLOCK = identifier(channels.CLOCK)
COUNTERS = identifier(channels.COUNTERS)
_OWN = (RUN, CLOCK, COUNTERS)
_BACK_NS = 1_000_000_000  # a step back in log time that does not count from boot


@dataclass(slots=True)
class EpochRows:
    """Rows of one epoch that were written together.

    ``end`` is run and sequence after them. ``last_ns`` is the log time of the last relevant row.
    ``counted_ns`` is up to when the last counters state that the record is complete,
    ``complete_ns`` the same by the journal alone: later rows are never before it.
    """

    epoch: RecordEpoch
    batches: list[Batch]
    end: tuple[int, int]
    first_ns: int
    last_ns: int
    counted_ns: int | None
    complete_ns: int


@dataclass(slots=True)
class WriterStream:
    """Reads one writer's journal piece by piece, and keeps its present epoch."""

    store: Store
    writer: str
    items: Collection[str]
    start: WriterCursor
    epoch: RecordEpoch | None = None
    last_ns: int | None = None
    drained: bool = True
    """The present step has nothing more to give."""
    _tail: WriterTail = field(init=False)
    _steps: Iterator[Any] = field(init=False)
    _at: tuple[int, int] = (0, 0)
    _open: list[Batch] = field(default_factory=list)
    _seen: JournalHead | None = None

    def __post_init__(self) -> None:
        self._tail = WriterTail(self.store, self.writer, {*self.items, *_OWN}, self.start)
        self._steps = iter(())
        if self.epoch is None:
            self.epoch = _epoch_at(self.store, self.writer, self.start)

    def begin(self, *, at_once: bool) -> None:
        """Begin a step: check for new rows; without ``at_once`` only if the head has moved."""
        head = read_head(self.store.folder(self.writer))
        if at_once or head is None or head != self._seen:
            self._steps, self.drained, self._seen = self._tail.step(), False, head
            self._at = self._place()

    def pull(self) -> EpochRows | None:
        """Return the next complete piece; None when the step has no more."""
        while not self.drained:
            delivery = next(self._steps, None)
            piece = None
            if self._place() != self._at or delivery is None:
                piece = self._piece()
                self._at = self._place()
            if isinstance(delivery, Batch):
                self._open.append(delivery)
            self.drained = delivery is None
            if piece is not None:
                return piece
        return None

    def _place(self) -> tuple[int, int]:
        return self._tail.run, self._tail.seq

    def _piece(self) -> EpochRows | None:
        """Return a piece of the rows read since the last one; None without rows."""
        batches, self._open = self._open, []
        if not batches:
            return None
        epoch = self._epoch_of(batches)
        ends = [(batch.item, int(batch.log_time_ns[-1])) for batch in batches]
        self.last_ns = max(end_ns for _, end_ns in ends)
        if epoch is None:  # measured by the watcher while it followed no recorder
            return None
        counted = max((_counted_ns(b) for b in batches if b.item == COUNTERS), default=None)
        rows = [batch for batch in batches if batch.item in self.items]
        first_ns = min(int(batch.log_time_ns[0]) for batch in batches)
        end = batches[0].run, self._tail.seq
        complete_ns = self.last_ns - self._tail.late_ns
        return EpochRows(epoch, rows, end, first_ns, self.last_ns, counted, complete_ns)

    def _epoch_of(self, batches: list[Batch]) -> RecordEpoch | None:
        named = {batch.item: batch for batch in batches}
        if self.writer == WATCH:
            if RUN in named:
                self.epoch = epoch_of(str(named[RUN].columns["input"][-1]))
            return self.epoch
        run = batches[0].run
        base_ns = _base_of(named[CLOCK]) if CLOCK in named else None
        if base_ns is not None:
            self.epoch = RecordEpoch(run, base_ns)
        elif self.epoch is None or self.epoch.run != run:
            self.epoch = RecordEpoch(run, 0)
        elif CLOCK in named and self._goes_back(batches):
            self.epoch = RecordEpoch(run, self.epoch.base_ns + 1)
        return self.epoch

    def _goes_back(self, batches: list[Batch]) -> bool:
        first_ns = min(int(batch.log_time_ns[0]) for batch in batches)
        return self.last_ns is not None and first_ns < self.last_ns - _BACK_NS


def _counted_ns(counters: Batch) -> int:
    """Return the log time (ns) up to which the newest counters state that the record is complete.

    This is their own time unless they state another one, because messages may come late.
    """
    column = counters.columns.get("complete_ns")
    stated = None if column is None or np.ma.is_masked(column[-1]) else column[-1]
    return int(counters.log_time_ns[-1]) if stated is None else int(stated)


def _base_of(clock: Batch) -> int | None:
    """Return log time minus the time since boot (ns) by a clock record; None without one."""
    column = clock.columns.get("boot_ns")
    if column is None:
        return None
    known = ~np.ma.getmaskarray(column) if isinstance(column, np.ma.MaskedArray) else None
    places = np.arange(len(clock)) if known is None else np.flatnonzero(known)
    rows = [row for row in places.tolist() if column[row] is not None]
    return int(clock.log_time_ns[rows[-1]]) - int(column[rows[-1]]) if rows else None


def _epoch_at(store: Store, writer: str, at: WriterCursor) -> RecordEpoch | None:
    """Return the epoch of a position; None if its file does not record it."""
    for journal in newest_first(store, writer):
        if (journal.run, journal.first_seq) <= (at.run, at.seq):
            return epoch_of_file(journal) if journal.run == at.run else None
    return None


_MAIN = "main"
_SPAN_NS = NS  # least length of a block while there is more to read: each has its cost

Positions: TypeAlias = Mapping[str, WriterCursor]


@dataclass(frozen=True, slots=True)
class RecordBlock:
    """Rows of one epoch; all rows up to ``until_ns`` (log time) are in this or earlier blocks.

    ``batches`` may reach further. Times of an item never decrease from batch to batch.
    """

    epoch: RecordEpoch
    start_ns: int
    """When the reading of this epoch began."""
    batches: list[Batch]
    until_ns: int
    is_last: bool = False
    """The epoch ends with it."""


class RecordedItemsReader:
    """Reads items of a store from positions on; ``step`` yields the rows available now.

    ``probes`` are the items that the watcher itself has written, as it has people's answers.
    """

    def __init__(
        self,
        store: Store,
        items: Collection[str],
        probes: Collection[str] = (),
        start: Positions | None = None,
    ) -> None:
        self._store = store
        own = {*probes, *({ANSWERS} & {*items})}
        self._items = {**dict.fromkeys(RECORDED, frozenset(items) - {ANSWERS}), WATCH: own}
        self._start = start or {}
        self._given: dict[str, WriterCursor] = {}
        self._streams: dict[str, WriterStream] = {}
        self._waiting: dict[str, EpochRows] = {}
        self._reached: dict[str, int] = {}
        self._counted_ns: int | None = None
        self._start_ns = 0
        self._batches: list[Batch] = []
        self._later: dict[RecordEpoch, bool] = {}
        self._alive: bool | None = None
        self._written: tuple[int, int] | None = None
        self.epoch: RecordEpoch | None = None
        self.until_ns: int | None = None

    @property
    def is_recording(self) -> bool:
        """Return whether the record was being written when it was read last."""
        return bool(self._alive)

    def positions(self) -> dict[str, WriterCursor]:
        """Return where the rows of the present epoch yielded so far end, in each journal."""
        return {**self._start, **self._given}

    def last_ns(self) -> int:
        """Return the log time (ns) of the newest row read of the present epoch."""
        return max(self._reached.values(), default=0)

    def step(self) -> Iterator[RecordBlock]:
        """Read the newly written rows, block by block."""
        alive = is_locked(self._store, _MAIN)
        head = read_head(self._store.folder(_MAIN))  # before the journals: never too much
        if alive and head is None:
            return
        self._written = (None if head is None else (head.run, head.next_seq)) if alive else None
        self._begin(at_once=alive != self._alive)
        self._alive = alive
        self._release()
        yield from self._go_on()
        while (stream := self._behind()) is not None:
            piece = stream.pull()
            if piece is not None:
                self._sort_in(stream.writer, piece)
            yield from self._go_on()
        if self.epoch is not None:
            yield from self._block(self._complete_ns() if alive else self._end_ns())

    def _begin(self, *, at_once: bool) -> None:
        for writer, items in self._items.items():
            known = self._streams.get(writer)
            if known is None and items and self._store.folder(writer).is_dir():
                start = self._start.get(writer, WriterCursor())
                known = self._streams[writer] = WriterStream(self._store, writer, items, start)
                known.begin(at_once=True)
            elif known is not None:
                known.begin(at_once=at_once)

    def _behind(self) -> WriterStream | None:
        """Return the stream to read next: the one furthest behind, the main journal last.

        None when all streams are drained, or wait for another epoch.
        """
        free = {
            writer: stream
            for writer, stream in self._streams.items()
            if not stream.drained and writer not in self._waiting
        }
        main = free.pop(_MAIN, None)
        main_ns = None if main is None else self._reached.get(_MAIN, -1)
        for writer, stream in free.items():
            if self.epoch is None and main is not None:
                break
            if main_ns is None or self._reached.get(writer, -1) < main_ns:
                return stream
        return main

    def _go_on(self) -> Iterator[RecordBlock]:
        """Yield the blocks now complete, and enter the next epoch when this one is complete."""
        while self._waits_for_next():
            yield from self._block(self._end_ns(), is_last=True)
            self._later.clear()
            first = self._waiting[_MAIN]
            self.epoch, self._start_ns = first.epoch, first.first_ns
            self.until_ns = self._counted_ns = None
            self._batches, self._reached = [], {}
            self._release()
        until_ns = self._complete_ns()
        if until_ns is not None and until_ns - (self.until_ns or 0) >= _SPAN_NS:
            yield from self._block(until_ns)

    def _sort_in(self, writer: str, piece: EpochRows) -> None:
        """Add a piece, or keep it for the epoch that it belongs to."""
        if writer == _MAIN and self.epoch is None and self._is_written(piece):
            self.epoch, self._start_ns = piece.epoch, piece.first_ns
        if self._is_past(piece):
            return
        if piece.epoch != self.epoch or (writer == _MAIN and not self._is_written(piece)):
            self._waiting[writer] = piece
        else:
            self._accept(writer, piece)

    def _is_past(self, piece: EpochRows) -> bool:
        epoch = self.epoch
        if epoch is None or piece.epoch == epoch:
            return False
        if piece.epoch not in self._later:
            self._later[piece.epoch] = comes_later(self._store, piece.epoch, epoch)
        return not self._later[piece.epoch]

    def _is_written(self, piece: EpochRows) -> bool:
        """Return whether all that was written together with a piece can be read."""
        return self._written is None or piece.end <= self._written

    def _accept(self, writer: str, piece: EpochRows) -> None:
        self._batches += piece.batches
        self._given[writer] = WriterCursor(*piece.end)
        reached_ns = piece.last_ns if writer == _MAIN else piece.complete_ns
        self._reached[writer] = max(reached_ns, self._reached.get(writer, reached_ns))
        if writer == _MAIN and piece.counted_ns is not None:
            self._counted_ns = piece.counted_ns

    def _complete_ns(self) -> int | None:
        """Return the time (ns) up to which the rows of all writers are read; None if not known."""
        if self._counted_ns is None:
            return None
        others = [
            self._reached.get(writer, -1)
            for writer, stream in self._streams.items()
            if writer != _MAIN and not stream.drained and writer not in self._waiting
        ]
        return min([self._counted_ns, *others]) - 1

    def _end_ns(self) -> int | None:
        last_ns = self._reached.get(_MAIN)
        return None if last_ns is None else last_ns - 1

    def _block(self, until_ns: int | None, *, is_last: bool = False) -> Iterator[RecordBlock]:
        assert self.epoch is not None
        ahead = until_ns is not None and (self.until_ns is None or until_ns > self.until_ns)
        if ahead or (is_last and self.until_ns is not None):
            self.until_ns = until_ns if ahead else self.until_ns
            assert self.until_ns is not None
            batches, self._batches = self._batches, []
            yield RecordBlock(self.epoch, self._start_ns, batches, self.until_ns, is_last)

    def _waits_for_next(self) -> bool:
        """Return whether the recorder is in another epoch, and all other streams are done."""
        piece = self._waiting.get(_MAIN)
        if piece is None or piece.epoch == self.epoch or not self._is_written(piece):
            return False
        return all(
            stream.drained or writer in self._waiting for writer, stream in self._streams.items()
        )

    def _release(self) -> None:
        """Add the rows that were kept for later, the main journal's first."""
        kept, self._waiting = self._waiting, {}
        for writer in sorted(kept, key=lambda name: name != _MAIN):
            self._sort_in(writer, kept[writer])
