"""One writer's journal as pieces: rows of one epoch, and up to when they reach."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.blackbox.follow.read import newest_first
from amberbox.blackbox.follow.tail import WriterTail
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.head import Head, read_head
from amberbox.blackbox.store import Store
from amberbox.core.names import identifier
from amberbox.core.types import Batch, WriterCursor
from amberbox.monitoring.watcher.epoch import Epoch, epoch_of
from amberbox.monitoring.watcher.start import WATCH, epoch_of_file

RUN = identifier(reserved.RUN)
CLOCK = identifier(reserved.CLOCK)
COUNTERS = identifier(reserved.COUNTERS)
_OWN = (RUN, CLOCK, COUNTERS)
_BACK_NS = 1_000_000_000
"""Where log time does not count from the computer's start, going back this far is a step."""


@dataclass(slots=True)
class Piece:
    """Rows of one epoch that were written together.

    ``end`` is run and sequence after them. ``last_ns`` is the log time of the last row that is
    of interest, ``counted_ns`` of the last counters: nothing that comes later lies before those.
    """

    epoch: Epoch
    batches: list[Batch]
    end: tuple[int, int]
    first_ns: int
    last_ns: int
    counted_ns: int | None


@dataclass(slots=True)
class WriterStream:
    """Reads one writer's journal piece by piece, and knows in which epoch it is."""

    store: Store
    writer: str
    items: Collection[str]
    start: WriterCursor
    epoch: Epoch | None = None
    last_ns: int | None = None
    drained: bool = True
    """The present step has nothing more to give."""
    _tail: WriterTail = field(init=False)
    _steps: Iterator[Any] = field(init=False)
    _at: tuple[int, int] = (0, 0)
    _open: list[Batch] = field(default_factory=list)
    _seen: Head | None = None

    def __post_init__(self) -> None:
        self._tail = WriterTail(self.store, self.writer, {*self.items, *_OWN}, self.start)
        self._steps = iter(())
        if self.epoch is None:
            self.epoch = _epoch_at(self.store, self.writer, self.start)

    def begin(self, *, at_once: bool) -> None:
        """Begin a step: look for what has come; without ``at_once`` only if the head says so."""
        head = read_head(self.store.folder(self.writer))
        if at_once or head is None or head != self._seen:
            self._steps, self.drained, self._seen = self._tail.step(), False, head
            self._at = self._place()

    def pull(self) -> Piece | None:
        """Read on until a piece is complete; None when the step has no more."""
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

    def _piece(self) -> Piece | None:
        """Make a piece of what has been read since the last one, if anything has."""
        batches, self._open = self._open, []
        if not batches:
            return None
        epoch = self._epoch_of(batches)
        ends = [(batch.item, int(batch.log_time_ns[-1])) for batch in batches]
        self.last_ns = max(end_ns for _, end_ns in ends)
        if epoch is None:  # what the watcher measured while it followed nobody
            return None
        counted = max((end_ns for item, end_ns in ends if item == COUNTERS), default=None)
        rows = [batch for batch in batches if batch.item in self.items]
        first_ns = min(int(batch.log_time_ns[0]) for batch in batches)
        end = batches[0].run, self._tail.seq
        return Piece(epoch, rows, end, first_ns, self.last_ns, counted)

    def _epoch_of(self, batches: list[Batch]) -> Epoch | None:
        named = {batch.item: batch for batch in batches}
        if self.writer == WATCH:
            if RUN in named:
                self.epoch = epoch_of(str(named[RUN].columns["input"][-1]))
            return self.epoch
        run = batches[0].run
        base_ns = _base_of(named[CLOCK]) if CLOCK in named else None
        if base_ns is not None:
            self.epoch = Epoch(run, base_ns)
        elif self.epoch is None or self.epoch.run != run:
            self.epoch = Epoch(run, 0)
        elif CLOCK in named and self._goes_back(batches):
            self.epoch = Epoch(run, self.epoch.base_ns + 1)
        return self.epoch

    def _goes_back(self, batches: list[Batch]) -> bool:
        first_ns = min(int(batch.log_time_ns[0]) for batch in batches)
        return self.last_ns is not None and first_ns < self.last_ns - _BACK_NS


def _base_of(clock: Batch) -> int | None:
    """Return log time minus the time since the computer's start, as clock records say it."""
    column = clock.columns.get("boot_ns")
    if column is None:
        return None
    known = ~np.ma.getmaskarray(column) if isinstance(column, np.ma.MaskedArray) else None
    places = np.arange(len(clock)) if known is None else np.flatnonzero(known)
    rows = [row for row in places.tolist() if column[row] is not None]
    return int(clock.log_time_ns[rows[-1]]) - int(column[rows[-1]]) if rows else None


def _epoch_at(store: Store, writer: str, at: WriterCursor) -> Epoch | None:
    """Return the epoch in which a position lies, if its file says so."""
    for journal in newest_first(store, writer):
        if (journal.run, journal.first_seq) <= (at.run, at.seq):
            return epoch_of_file(journal) if journal.run == at.run else None
    return None
