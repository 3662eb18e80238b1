"""Arrival of an item's messages before any filter: last time, rate, stalls of the recorder.

Messages received during a stall have late stamps or are lost, so that absence, rates and jumps are
no evidence for that time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.samples import Now, Samples, is_one
from amberbox.core.types import IntArray

SETTLES_NS = NS  # a backlog of a stall is taken in within its length, at most this
_MOST_STALLS = 256


class Stalls:
    """The stalls of an epoch in order of time (log time, nanoseconds); none overlaps another."""

    __slots__ = ("_ends", "_starts", "_sums")

    def __init__(self) -> None:
        self.clear()

    def __len__(self) -> int:
        return len(self._starts)

    def clear(self) -> None:
        """Forget all."""
        self._starts = np.zeros(0, np.int64)
        self._ends = np.zeros(0, np.int64)
        self._sums = np.zeros(1, np.int64)

    def add(self, from_ns: int, to_ns: int) -> None:
        """Add a stall; one that does not begin after those before is known already."""
        if to_ns > from_ns and (not len(self) or from_ns >= self._ends[-1]):
            self._starts = np.append(self._starts, from_ns)[-_MOST_STALLS:]
            self._ends = np.append(self._ends, to_ns)[-_MOST_STALLS:]
            self._sums = np.concatenate([[0], np.cumsum(self._ends - self._starts)])

    def snapshot(self) -> list[list[int]]:
        """Return the stalls, for ``add`` to restore."""
        return np.stack([self._starts, self._ends], axis=1).tolist()  # type: ignore[no-any-return]  # numpy says Any

    def next_after(self, time_ns: int) -> tuple[int, int] | None:
        """Return the first stall whose effects reach beyond a time, and when these are over."""
        found = None
        for place in range(len(self) - 1, -1, -1):
            from_ns, to_ns = int(self._starts[place]), int(self._ends[place])
            over_ns = to_ns + min(to_ns - from_ns, SETTLES_NS)
            if over_ns <= time_ns:
                break
            found = from_ns, over_ns
        return found

    def within_ns(self, since_ns: Any, until_ns: Any) -> Any:
        """Return for how long the recorder was held up between two times (or columns of them)."""
        return self._before_ns(until_ns) - self._before_ns(since_ns)

    def spoils(self, instants: IntArray, window_ns: int) -> Any:
        """Return at which instants a window holds a stall that is more than a tenth of it."""
        spoilt = np.zeros(len(instants), bool)
        first = int(self._ends.searchsorted(instants[0] - window_ns)) if len(instants) else 0
        for from_ns, to_ns in zip(self._starts[first:], self._ends[first:], strict=True):
            if 10 * (to_ns - from_ns) > window_ns:
                spoilt |= (instants > from_ns) & (instants <= to_ns + window_ns)
        return spoilt

    def _before_ns(self, time_ns: Any) -> Any:
        """Return for how long it was held up before a time."""
        place = self._starts.searchsorted(time_ns, "right")
        if not len(self):
            return self._sums[place]
        last = np.maximum(place - 1, 0)
        under_way = np.where(place > 0, np.maximum(self._ends[last] - time_ns, 0), 0)
        return self._sums[place] - under_way


COUNTED_NS = 3 * NS // 2  # recorders write counts once a second, or a little later
NONE_OPEN = 1 << 62  # start of a gap where none is open


@dataclass(slots=True, eq=False)
class Flow:
    """The arrival of an item's messages, as the recorder counted them before any filter.

    Without counts (a recording of another program), the rows themselves are used.
    """

    received: Samples = field(default_factory=Samples)
    """Messages received since the run began, by the time of the count."""
    last_ns: Samples = field(default_factory=Samples)
    """When the last one was received, by the time of the count."""
    rows: Samples = field(default_factory=Samples)
    """Rows recorded since the run began, by the time of each."""
    gap_from_ns: Samples = field(default_factory=Samples)
    """Since when its publishers are known to be lost, NONE_OPEN where they are not."""
    reasons: dict[int, str] = field(default_factory=dict)
    """Why they were lost, by since when."""
    stalls: Stalls = field(default_factory=Stalls)
    """When the recorder was held up: time that does not count for silence and rates."""
    began_ns: int | None = None
    """Beginning of the record of this item, if known; earlier messages cannot be known."""

    def last_received_ns(self, now: Now) -> Any:
        """Return when the last message known at ``now`` was received, ns; -1 before the first."""
        seen = _held(self.rows, now, self.rows.times_ns, -1)
        counted = _held(self.last_ns, now, self.last_ns.values, -1)
        return max(seen, counted) if is_one(now) else np.maximum(seen, counted)

    def age_s(self, now: Now) -> Any:
        """Return the time since the last message, seconds; infinite before the first."""
        last_ns = self.last_received_ns(now)
        stalled_ns = self.stalls.within_ns(last_ns, now) if len(self.stalls) else 0
        if is_one(now):
            return max(int(now - last_ns - stalled_ns), 0) / NS if last_ns >= 0 else np.inf
        ages = np.maximum(now - last_ns - stalled_ns, 0) / NS
        return np.where(last_ns >= 0, ages, np.inf)[()]

    def rate_hz(self, now: Now, seconds: float) -> Any:
        """Return messages received per second over the last ``seconds``, silence included.

        A shorter time is used if less is known; NaN before anything is known. If a robot is
        recorded faster than real time, counts are late, and the rows are used.
        """
        counted = _rate(self.received, now, seconds, self.stalls)
        kept = _rate(self.rows, now, seconds, self.stalls)
        if is_one(now):
            return kept if kept > counted or counted != counted else counted
        return np.fmax(counted, kept)[()]

    def received_ns(self, since_ns: int, until_ns: int) -> IntArray:
        """Return times (ns) at which messages surely came, from the last one by ``since_ns`` on.

        These are the times of rows, and of counts that show a message after the last row: one that
        a filter left out because its value had not changed.
        """
        rows, counts = self.rows.times_ns, self.last_ns.times_ns
        first, end = (int(rows.searchsorted(at, "right")) for at in (since_ns, until_ns))
        received = rows[max(first - 1, 0) : end]
        began = int(received[0]) if first else since_ns
        begin, stop = (int(counts.searchsorted(at, "right")) for at in (began, until_ns))
        if begin == stop:
            return received
        counts, newest = counts[begin:stop], self.last_ns.values[begin:stop]
        last = received.searchsorted(counts, "right") - 1
        row_ns = (
            np.where(last >= 0, received[last], -1) if len(received) else np.full(len(counts), -1)
        )
        left_out = (newest > row_ns) & (counts - newest <= COUNTED_NS)
        joined = np.sort(np.concatenate([received, counts[left_out]]))
        return joined[max(int(joined.searchsorted(since_ns, "right")) - 1, 0) :]

    def longest_gap_s(self, now_ns: int, seconds: float, received_ns: IntArray) -> float:
        """Return the longest time (s) between messages of the last ``seconds``, and since the last.

        ``received_ns`` are those that count, of ``received_ns()``. Counts come once a second: where
        a filter leaves messages out, what is missing between two counts is no gap.
        """
        start_ns = now_ns - round(seconds * NS)
        if not len(received_ns) or received_ns[0] > start_ns:
            received_ns = np.concatenate([[start_ns], received_ns])
        longest_ns = int(np.diff(np.append(received_ns, now_ns)).max())
        spared_ns = 2 * COUNTED_NS if self.is_filtered(now_ns) else 0
        return max(0, longest_ns - spared_ns) / NS

    def is_filtered(self, now_ns: int) -> bool:
        """Return whether a recent count shows a message after the last row."""
        last = int(self.last_ns.last(now_ns))
        if last < 0 or now_ns - self.last_ns.times_ns[last] > 2 * COUNTED_NS:
            return False
        row_ns = _held(self.rows, now_ns, self.rows.times_ns, -1)
        return bool(self.last_ns.values[last] > row_ns)

    def reaches_back(self, now: Now, seconds: float) -> Any:
        """Return whether a message had already been received ``seconds`` ago."""
        before = now - round(seconds * NS)
        return (self.received.last(before) >= 0) | (self.rows.last(before) >= 0)

    def listened(self, now: Now, seconds: float) -> Any:
        """Return whether the source has listened for ``seconds``, with messages or without."""
        if self.began_ns is None:
            return self.reaches_back(now, seconds)
        return now - self.began_ns >= round(seconds * NS)

    def lost(self, now: Now) -> Any:
        """Return whether a publisher is known to be lost, and no message was received since for a
        second.

        Of several publishers of an item one may be lost while the others continue.
        """
        since_ns = _held(self.gap_from_ns, now, self.gap_from_ns.values, NONE_OPEN)
        happened = (since_ns != NONE_OPEN) & (since_ns <= now - NS)
        return happened & (self.last_received_ns(now) <= since_ns)


def _held(samples: Samples, now: Now, values: NDArray[Any], missing: int) -> Any:
    """Return the value of the last sample at ``now``, or ``missing`` before the first."""
    if not len(samples):
        return missing if is_one(now) else np.full(np.shape(now), missing, np.int64)
    last = samples.last(now)
    if is_one(now):
        return int(values[last]) if last >= 0 else missing
    return np.where(last >= 0, values[last], missing)


def _rate(counts: Samples, now: Now, seconds: float, stalls: Stalls) -> Any:
    """Return how much a count has grown per second; NaN where it is not known."""
    if not len(counts):
        return np.nan if is_one(now) else np.full(np.shape(now), np.nan)
    before = now - round(seconds * NS)
    if is_one(now):
        return _rate_at(counts, int(now), int(before), stalls)
    first, last = np.maximum(counts.last(before), 0), counts.last(now)
    began = np.maximum(before, counts.times_ns[first])
    elapsed_s = (now - began - stalls.within_ns(began, now)) / NS
    grown = (counts.values[last] - counts.values[first]).astype(np.float64)
    known = (last >= 0) & (elapsed_s > 0)
    return np.where(known, grown / np.where(known, elapsed_s, 1.0), np.nan)


def _rate_at(counts: Samples, now: int, before: int, stalls: Stalls) -> float:
    """Return the same for one instant, without the cost of arrays."""
    first, last = max(int(counts.last(before)), 0), int(counts.last(now))
    began = max(before, int(counts.times_ns[first]))
    elapsed_ns = now - began - (int(stalls.within_ns(began, now)) if len(stalls) else 0)
    if last < 0 or elapsed_ns <= 0:
        return np.nan
    return float(counts.values[last] - counts.values[first]) / (elapsed_ns / NS)
