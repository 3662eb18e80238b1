"""Corrected time of receipt: log time plus what the clock channel says about the wall clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amberbox.core.types import IntArray


@dataclass(frozen=True, slots=True)
class ClockTable:
    """Offsets of the wall clock against log time, each valid from its log time on."""

    points: Sequence[tuple[int, int]] = ()

    def received(self, log_ns: IntArray) -> IntArray:
        """Correct log times."""
        if not self.points or not any(offset for _, offset in self.points):
            return log_ns
        times, offsets = np.array(self.points, np.int64).T
        place = np.maximum(np.searchsorted(times, log_ns, "right") - 1, 0)
        corrected: IntArray = log_ns + offsets[place]
        return corrected

    def bounds(self) -> tuple[int, int]:
        """Smallest and largest offset: by so much log time may differ from received."""
        offsets = [offset for _, offset in self.points] or [0]
        return min(offsets), max(offsets)
