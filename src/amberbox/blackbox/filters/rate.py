"""Keep at most so many messages per second, by a schedule on the time of receipt.

The schedule is the generic cell rate algorithm (ITU-T I.371): each kept message moves the time at
which the next is due by one period, and a message may come a few periods before it is due. So a
stream at the limit keeps all its messages although they jitter, and the kept rate never exceeds
the limit by more than one burst of ``TOLERANCE_PERIODS + 1`` messages.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import UsageError
from amberbox.core.types import IntArray

# how many periods a message may be early; see docs/robot/filters.md for the simulation behind it
TOLERANCE_PERIODS = 10


class RateLimit:
    """The schedule of one topic."""

    __slots__ = ("_due_ns", "_horizon_ns", "_period_ns", "_tolerance_ns")

    def __init__(self, max_frequency: float, tolerance_periods: int = TOLERANCE_PERIODS) -> None:
        """Start a schedule for ``max_frequency`` messages per second (Hz)."""
        if not (max_frequency > 0 and math.isfinite(max_frequency)):
            raise UsageError(
                f"max_frequency is {max_frequency:g}, which is no limit",
                "give a number above 0 (Hz), or leave the key out to keep every message",
            )
        self._period_ns = math.ceil(1e9 / max_frequency)
        self._tolerance_ns = tolerance_periods * self._period_ns
        self._horizon_ns = self._tolerance_ns + self._period_ns
        self._due_ns = 0

    def accept(self, received_ns: int) -> bool:
        """Return whether to keep a message received now (nanoseconds of log time)."""
        early_ns = self._due_ns - received_ns
        if early_ns > self._tolerance_ns:
            if early_ns <= self._horizon_ns:
                return False
            early_ns = 0  # no schedule reaches this far: a new epoch of log time is earlier
        self._due_ns = received_ns + self._period_ns + (early_ns if early_ns > 0 else 0)
        return True

    def mask(self, received_ns: IntArray) -> NDArray[np.bool_]:
        """Return which messages of a batch to keep, in the order of their receipt."""
        accepted = map(self.accept, received_ns.tolist())
        return np.fromiter(accepted, dtype=np.bool_, count=len(received_ns))
