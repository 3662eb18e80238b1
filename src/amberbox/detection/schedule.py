"""The schedule of a periodic source: how far its messages are from where its period puts them.

A loop of second order follows phase and period slowly, so that a source whose clock runs a little
fast is in step, and one that goes on half a period later is not. A message that is missing, and one
that a busy computer delays, do not move the schedule.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from amberbox.core.clock import NS

_GAIN = 0.05  # of a message's deviation that moves the phase
_PERIOD_GAIN = 0.5 * _GAIN * _GAIN
_WEIGHT = 0.2  # of a message in the moving mean
_MOST_PERIODS = 20  # after so many without a message, the schedule begins anew
_MOST_CHANGE = 0.2  # of the learnt period
_LEAST_USUAL = 0.002
_MOST_USUAL = 0.2


class Schedule:
    """Follows the messages of one source; ``off`` is 0 in step, 1 half a period away from it."""

    __slots__ = ("_expected_ns", "_learnt_ns", "_period_ns", "off")

    def __init__(self, period_s: float) -> None:
        self._learnt_ns = self._period_ns = period_s * NS
        self._expected_ns: int | None = None
        self.off = 0.0

    def take(self, at_ns: int) -> float:
        """Add a message; return the moving mean of how far messages are off the schedule."""
        expected_ns = at_ns if self._expected_ns is None else self._expected_ns
        apart = (at_ns - expected_ns) / self._period_ns
        if not -_MOST_PERIODS < apart < _MOST_PERIODS:
            self._expected_ns = at_ns
            return self.off
        periods = round(apart)
        phase = apart - periods
        self.off += _WEIGHT * (0.5 - 0.5 * math.cos(2 * math.pi * phase) - self.off)
        moved = (periods + _GAIN * phase) * self._period_ns
        self._expected_ns = expected_ns + round(moved)
        period_ns = self._period_ns * (1 + _PERIOD_GAIN * phase)
        least_ns, most_ns = (self._learnt_ns * (1 + c) for c in (-_MOST_CHANGE, _MOST_CHANGE))
        self._period_ns = min(max(period_ns, least_ns), most_ns)
        return self.off

    def snapshot(self) -> list[float | int | None]:
        """Return the state as JSON."""
        return [self._expected_ns, self._period_ns, self.off]

    def resume(self, snapshot: Sequence[float | int | None]) -> None:
        """Continue from a snapshot; raises ValueError or TypeError for another one."""
        expected_ns, period_ns, off = snapshot
        if period_ns is None or off is None or not 0 <= off <= 1 or not 0 < period_ns < math.inf:
            raise ValueError("a schedule has a period above 0")
        self._expected_ns = None if expected_ns is None else int(expected_ns)
        self._period_ns, self.off = float(period_ns), float(off)


def usual_off(period_s: float, missions: Iterable[Sequence[int]]) -> float | None:
    """Return how far nominal messages (times in ns) are off schedule; None if they have none."""
    total, count = 0.0, 0
    for times_ns in missions:
        schedule = Schedule(period_s)
        total += sum(map(schedule.take, times_ns))
        count += len(times_ns)
    usual = max(total / max(count, 1), _LEAST_USUAL)
    return usual if count and usual <= _MOST_USUAL else None
