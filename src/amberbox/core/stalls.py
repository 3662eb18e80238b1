"""Stretches of a record in which the recorder itself was held up, as those who judge take them.

What was received then has late stamps or is lost, so absence, rates and jumps prove nothing there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.types import IntArray

SETTLES_NS = NS
"""What has piled up in a stall is taken in within as long again, but no longer than this."""
_MOST = 256
"""So many are remembered."""


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
        """Take a stall; one that does not begin after those before is known already."""
        if to_ns > from_ns and (not len(self) or from_ns >= self._ends[-1]):
            self._starts = np.append(self._starts, from_ns)[-_MOST:]
            self._ends = np.append(self._ends, to_ns)[-_MOST:]
            self._sums = np.concatenate([[0], np.cumsum(self._ends - self._starts)])

    def snapshot(self) -> list[list[int]]:
        """Return what ``add`` takes again."""
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
        """Tell at which instants a window holds a stall that is more than a tenth of it."""
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
