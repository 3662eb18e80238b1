"""Read a record as it grows, run by run, on one axis of time for all its journals.

The axis is log time. If the clock was set within a run, the axis continues without a step, so that
durations stay right.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.tail import JournalHead, read_head
from amberbox.blackbox.store.incident import LogMoment
from amberbox.blackbox.store.store import Store, is_locked
from amberbox.blackbox.store.tail import RECORDED, WriterTail, position_at
from amberbox.core.clock import NS
from amberbox.core.names import identifier
from amberbox.core.types import Batch, Cursor, IntArray

WATCH = "watch"
_RUN = identifier(channels.RUN)
_BACK_NS = NS // 20
# A recorder writes once a second at least: a file that begins later than this after the one
# before has another clock, and so has one that begins before its end
_ON_NS = 2 * NS
_MARGIN_NS = NS


@dataclass(slots=True)
class RunTimeAxis:
    """Log times of one run as times that never step."""

    starts: list[int] = field(default_factory=list)
    shifts: list[int] = field(default_factory=list)
    _at: dict[str, tuple[int, int]] = field(default_factory=dict)

    def begin(self, log_ns: int, last_ns: int | None) -> None:
        """Begin a file by its first log time (ns), and the last one before it."""
        if not self.starts:
            self.starts, self.shifts = [log_ns], [0]
        elif last_ns is not None and not -_BACK_NS <= log_ns - last_ns <= _ON_NS:
            self.starts.append(log_ns)
            self.shifts.append(last_ns + self.shifts[-1] - log_ns)

    def times(self, writer: str, log_ns: IntArray, late_ns: int = 0) -> IntArray:
        """Return the times of a writer's rows.

        Its log time goes back at a step only, or by ``late_ns`` where messages come late.
        """
        first = int(log_ns[0])
        place, last = self._at.get(writer, (0, first))
        if first < last - _MARGIN_NS - late_ns:
            place += 1
        while place + 1 < len(self.starts) and not self._fits(place, first):
            place += 1
        place = min(place, len(self.starts) - 1)
        self._at[writer] = (place, int(log_ns[-1]))
        times: IntArray = log_ns + self.shifts[place]
        return times

    def _fits(self, place: int, log_ns: int) -> bool:
        end_ns = self.starts[place + 1] + self.shifts[place + 1] - self.shifts[place]
        return self.starts[place] - _MARGIN_NS <= log_ns <= end_ns + _MARGIN_NS

    def time_of(self, log_ns: int) -> int:
        """Return the time of a log time of the newest stretch that it can be of."""
        for start_ns, shift_ns in zip(reversed(self.starts), reversed(self.shifts), strict=True):
            if log_ns >= start_ns - _MARGIN_NS:
                return log_ns + shift_ns
        return log_ns

    def log_of(self, time_ns: int) -> int:
        """Return the log time of a time."""
        for start_ns, shift_ns in zip(reversed(self.starts), reversed(self.shifts), strict=True):
            if time_ns >= start_ns + shift_ns:
                return time_ns - shift_ns
        return time_ns


@dataclass(slots=True)
class RunSlice:
    """New rows of one run: batches with their times, and up to when they are complete."""

    run: int
    axis: RunTimeAxis
    batches: list[tuple[Batch, IntArray]] = field(default_factory=list)
    until_ns: int = 0
    known: int = 1
    """Number of sections of log time that had begun at the reading position."""
    watched_ns: int | None = None
    """Time up to which the watcher has written its findings; None if no watcher runs."""

    def left_ns(self, log_ns: int) -> int:
        """Return the time of the log time at which the reading was left."""
        return log_ns + (self.axis.shifts[self.known - 1] if self.axis.shifts else 0)

    def moment(self, time_ns: int) -> LogMoment:
        """Return the moment of the record at a time of the axis."""
        return LogMoment(self.run, self.axis.log_of(time_ns))

    def reach(self, log_ns: int | None) -> None:
        """Record that the run is complete up to a log time, the newest of it."""
        if log_ns is not None:
            self.until_ns = max(self.until_ns, self.axis.time_of(log_ns))


class LiveReader:
    """Reads some items of a store from a cursor on; ``step`` returns new rows, run by run.

    Only the recorder's runs count; rows of other writers (``watch``) are returned with the present
    run.
    """

    def __init__(
        self, store: Store, items: Collection[str], cursor: Cursor | None, lookback_s: float
    ) -> None:
        self._store = store
        self._items = {*items, _RUN}
        self._from = cursor.writers if cursor and cursor.store_id == store.id else {}
        self._lookback_s = lookback_s
        self._tails: dict[str, WriterTail] = {}
        self._part: RunSlice | None = None

    def step(self) -> list[RunSlice]:
        """Return the new rows by run; the last part is of the present run."""
        for writer in (*RECORDED, WATCH):
            if writer not in self._tails and self._store.folder(writer).is_dir():
                start = position_at(self._store, writer, self._from.get(writer), self._lookback_s)
                self._tails[writer] = WriterTail(self._store, writer, self._items, start)
        if "main" not in self._tails:
            return []
        watched = read_head(self._store.folder(WATCH))
        parts = list(self._main(self._tails["main"]))
        for writer, tail in self._tails.items():
            if writer != "main" and parts:
                _sort_in(parts, writer, tail)
        if parts:
            parts[-1].watched_ns = self._watched_ns(parts[-1], watched)
        for part in parts[:-1]:  # rows of other journals up to the end of a run count, too
            part.until_ns = max([part.until_ns, *(int(times[-1]) for _, times in part.batches)])
        return parts

    def _watched_ns(self, part: RunSlice, head: JournalHead | None) -> int | None:
        """Return up to when (ns) the watcher's rows were read, by its head before that."""
        if WATCH not in self._tails or head is None or not is_locked(self._store, WATCH):
            return None
        return part.axis.time_of(head.watermark_ns)

    def cursor(self) -> Cursor:
        """Return the cursor of the reading position."""
        return Cursor(self._store.id, {w: tail.position() for w, tail in self._tails.items()})

    def _main(self, tail: WriterTail) -> Iterator[RunSlice]:
        """Read the main journal, which states when runs and stretches of log time begin."""
        head = read_head(self._store.folder("main"))
        part = self._part
        known = 0 if part is None else len(part.axis.starts)
        if part is None and tail.run:  # read on amid a run, which need have nothing of ours here
            part = self._part = RunSlice(tail.run, RunTimeAxis())
        if part is not None:
            part.batches = []
        for delivery in tail.step():
            if not isinstance(delivery, Batch):
                continue
            if part is None or part.run != delivery.run:
                if part is not None:
                    part.reach(tail.last_ns)
                    yield part
                part = self._part = RunSlice(delivery.run, RunTimeAxis())
            self._take(part, delivery, tail.last_ns, tail.late_ns)
        if part is not None:
            if not known or len(part.axis.starts) == known or tail.seq == _next_seq(head):
                part.reach(_complete_ns(part, head, tail))
            yield part

    def _take(self, part: RunSlice, batch: Batch, last_ns: int | None, late_ns: int) -> None:
        first_ns = int(batch.log_time_ns[0])
        part.axis.begin(first_ns, last_ns if batch.item == _RUN else None)
        left = self._from.get("main")
        if left is not None and (batch.run, int(batch.seq[0])) < (left.run, left.seq):
            part.known = len(part.axis.starts)
        times_ns = part.axis.times("main", batch.log_time_ns, late_ns)
        if batch.item != _RUN:
            part.batches.append((batch, times_ns))


def _complete_ns(part: RunSlice, head: JournalHead | None, tail: WriterTail) -> int | None:
    """Return the log time up to which all journals of a run are written and read.

    Where the recorder has written more since ``head`` was read, this is the position in the head:
    rows of other journals at the newest times may still come.
    """
    if head is None or head.run != part.run or head.next_seq > tail.seq:
        return tail.complete_ns
    if head.next_seq < tail.seq:
        return head.watermark_ns
    return max(head.watermark_ns, tail.complete_ns or 0)


def _next_seq(head: JournalHead | None) -> int | None:
    return None if head is None else head.next_seq


def _sort_in(parts: list[RunSlice], writer: str, tail: WriterTail) -> None:
    """Add the batches of another journal to the runs that they belong to."""
    by_run = {part.run: part for part in parts}
    for delivery in tail.step():
        if not isinstance(delivery, Batch) or delivery.item == _RUN or not parts:
            continue
        part = parts[-1] if writer == WATCH else by_run.get(delivery.run)
        if part is not None:
            part.axis.begin(int(delivery.log_time_ns[0]), None)
            times_ns = part.axis.times(writer, delivery.log_time_ns, tail.late_ns)
            part.batches.append((delivery, times_ns))
