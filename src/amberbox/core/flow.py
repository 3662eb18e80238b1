"""How messages of an item have come, before any filter: when the last one did, and how often."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.samples import Now, Samples, is_one
from amberbox.core.stalls import Stalls
from amberbox.core.types import IntArray

COUNTED_NS = 3 * NS // 2
"""Recorders write what they counted once a second, or a little later."""
NONE_OPEN = 1 << 62
"""Stands for the beginning of a gap where none is open."""


@dataclass(slots=True, eq=False)
class Flow:
    """How messages of an item have come: as the recorder counted them, before any filter.

    Where nobody counted (another program's recording), the rows themselves are what is known.
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
    """When listening began, as far as the record tells; before it nobody could have heard it."""

    def last_received_ns(self, now: Now) -> Any:
        """Return when the last message known of at ``now`` was received; -1 before the first."""
        seen = _held(self.rows, now, self.rows.times_ns, -1)
        counted = _held(self.last_ns, now, self.last_ns.values, -1)
        return max(seen, counted) if is_one(now) else np.maximum(seen, counted)

    def age_s(self, now: Now) -> Any:
        """Return for how long nothing has been received; infinite before the first message."""
        last_ns = self.last_received_ns(now)
        stalled_ns = self.stalls.within_ns(last_ns, now) if len(self.stalls) else 0
        if is_one(now):
            return max(int(now - last_ns - stalled_ns), 0) / NS if last_ns >= 0 else np.inf
        ages = np.maximum(now - last_ns - stalled_ns, 0) / NS
        return np.where(last_ns >= 0, ages, np.inf)[()]

    def rate_hz(self, now: Now, seconds: float) -> Any:
        """Return messages received per second over the last ``seconds``, silence included.

        Less is looked at where less is known; NaN before anything is. Counts come late where a
        robot runs faster than the box writes: then the rows show more.
        """
        counted = _rate(self.received, now, seconds, self.stalls)
        kept = _rate(self.rows, now, seconds, self.stalls)
        if is_one(now):
            return kept if kept > counted or counted != counted else counted
        return np.fmax(counted, kept)[()]

    def heard_ns(self, since_ns: int, until_ns: int) -> IntArray:
        """Return when messages are known to have come, from the last time by ``since_ns`` on.

        These are the times of rows, and of counts that tell of a message after the last row: one
        that a filter left out, as it said nothing new.
        """
        rows, counts = self.rows.times_ns, self.last_ns.times_ns
        first, end = (int(rows.searchsorted(at, "right")) for at in (since_ns, until_ns))
        heard = rows[max(first - 1, 0) : end]
        began = int(heard[0]) if first else since_ns
        begin, stop = (int(counts.searchsorted(at, "right")) for at in (began, until_ns))
        if begin == stop:
            return heard
        counts, newest = counts[begin:stop], self.last_ns.values[begin:stop]
        last = heard.searchsorted(counts, "right") - 1
        row_ns = np.where(last >= 0, heard[last], -1) if len(heard) else np.full(len(counts), -1)
        left_out = (newest > row_ns) & (counts - newest <= COUNTED_NS)
        joined = np.sort(np.concatenate([heard, counts[left_out]]))
        return joined[max(int(joined.searchsorted(since_ns, "right")) - 1, 0) :]

    def longest_gap_s(self, now_ns: int, seconds: float, heard_ns: IntArray) -> float:
        """Return the longest time between messages of the last ``seconds``, and since the last.

        ``heard_ns`` are those that count, of ``heard_ns()``. Counts come once a second: where a
        filter leaves messages out, what is missing between two counts is no gap.
        """
        start_ns = now_ns - round(seconds * NS)
        if not len(heard_ns) or heard_ns[0] > start_ns:
            heard_ns = np.concatenate([[start_ns], heard_ns])
        longest_ns = int(np.diff(np.append(heard_ns, now_ns)).max())
        spared_ns = 2 * COUNTED_NS if self.is_filtered(now_ns) else 0
        return max(0, longest_ns - spared_ns) / NS

    def is_filtered(self, now_ns: int) -> bool:
        """Tell whether a count that is not old tells of a message after the last row."""
        last = int(self.last_ns.last(now_ns))
        if last < 0 or now_ns - self.last_ns.times_ns[last] > 2 * COUNTED_NS:
            return False
        row_ns = _held(self.rows, now_ns, self.rows.times_ns, -1)
        return bool(self.last_ns.values[last] > row_ns)

    def reaches_back(self, now: Now, seconds: float) -> Any:
        """Tell whether something had been heard of it ``seconds`` ago already."""
        before = now - round(seconds * NS)
        return (self.received.last(before) >= 0) | (self.rows.last(before) >= 0)

    def listened(self, now: Now, seconds: float) -> Any:
        """Tell whether it has been listened to for ``seconds``, heard or not."""
        if self.began_ns is None:
            return self.reaches_back(now, seconds)
        return now - self.began_ns >= round(seconds * NS)

    def lost(self, now: Now) -> Any:
        """Tell whether a publisher is known to be lost, and nothing has come since for a second.

        Of several publishers of an item one may be lost while the others go on.
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
    """Return how much a growing count has grown per second; NaN where nobody can know."""
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
