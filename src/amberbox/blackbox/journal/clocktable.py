"""Corrected time of receipt: log time plus what the clock channel says about the wall clock."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.types import IntArray

ClockPoints: TypeAlias = tuple[tuple[int, int], ...]
"""Pairs of log time and wall time minus log time, in order of log time; ns."""

STEP_NS = 50_000_000
"""A larger change of the offset from one point to the next is a step, a smaller one a slew."""

TOLERANCE_NS = 500_000
"""Points are left out as long as the offset stays this close to what was recorded."""

_LONGEST_SLEW_NS = STEP_NS - 10_000_000


class ClockReading(NamedTuple):
    """One record of the clock channel: two clocks and whether the wall clock was synchronised."""

    log_ns: int
    offset_ns: int
    synchronised: bool | None = None
    boot_ns: int | None = None


class Piece(NamedTuple):
    """From ``log_ns`` on the offset is ``offset_ns`` plus ``rate`` times the time since then."""

    log_ns: int
    offset_ns: int
    rate: float


@dataclass(frozen=True, slots=True)
class ClockTable:
    """Offsets of the wall clock against log time.

    Between two points the offset goes evenly from one to the other, at a step it jumps. With
    ``held`` it stays as it was until the next point: what was known at the time.
    """

    points: Sequence[tuple[int, int]] = ()
    held: bool = False

    def received(self, log_ns: IntArray) -> IntArray:
        """Correct log times; they never run backwards but at a step."""
        if not self.points or not any(offset for _, offset in self.points):
            return log_ns
        times, offsets, rates = self._columns()
        place = np.maximum(np.searchsorted(times, log_ns, "right") - 1, 0)
        since = np.maximum(log_ns - times[place], 0)
        corrected: IntArray = (
            log_ns + offsets[place] + np.rint(since * rates[place]).astype(np.int64)
        )
        return corrected

    def at(self, log_ns: int) -> int:
        """Correct one log time."""
        return int(self.received(np.array([log_ns], np.int64))[0])

    def pieces(self) -> list[Piece]:
        """Return the stretches over which the offset changes evenly, in order."""
        columns = (column.tolist() for column in self._columns())
        return [Piece(*piece) for piece in zip(*columns, strict=True)]

    def bounds(self) -> tuple[int, int]:
        """Smallest and largest offset: by so much log time may differ from received."""
        offsets = [offset for _, offset in self.points] or [0]
        return min(offsets), max(offsets)

    def _columns(self) -> tuple[IntArray, IntArray, NDArray[np.float64]]:
        times, offsets = np.array(self.points or ((0, 0),), np.int64).T
        rates = np.zeros(len(times))
        if not self.held and len(times) > 1:
            lasted, change = np.diff(times), np.diff(offsets)
            even = (np.abs(change) <= STEP_NS) & (lasted > 0)
            rates[:-1][even] = np.maximum(change[even] / lasted[even], -1.0)
        return times, offsets, rates


def held_points(readings: Iterable[ClockReading]) -> ClockPoints:
    """Return what the offset was known to be at any time, for a table that holds."""
    points: list[tuple[int, int]] = []
    for reading in readings:
        if not points or points[-1][1] != reading.offset_ns:
            points.append((reading.log_ns, reading.offset_ns))
    return tuple(points)


def simplified(points: Sequence[tuple[int, int]], tolerance_ns: int = TOLERANCE_NS) -> ClockPoints:
    """Leave out points that lie on the line between others; steps stay as they are."""
    if len(points) < 3:
        return tuple(points)
    return tuple(points[index] for index in _kept(points, tolerance_ns))


def _kept(points: Sequence[tuple[int, int]], tolerance_ns: int) -> Iterator[int]:
    """Choose points so that every other one is near the line between its neighbours."""
    start = 0
    while start < len(points) - 1:
        yield start
        start = _reach(points, start, tolerance_ns)
    yield start


def _reach(points: Sequence[tuple[int, int]], start: int, tolerance_ns: int) -> int:
    """Return the furthest point that one line from ``start`` may go to.

    It has to lie in the cone that the points between leave open.
    """
    low, high = -np.inf, np.inf
    t0, o0 = points[start]
    for end in range(start + 1, len(points)):
        (before, after), change = (points[end - 1][1], points[end][1]), points[end][1] - o0
        lasted = max(points[end][0] - t0, 1)
        outside = not low <= change / lasted <= high or abs(change) > _LONGEST_SLEW_NS
        if end > start + 1 and (outside or abs(after - before) > STEP_NS):
            return end - 1
        if abs(after - before) > STEP_NS:
            return end
        low = max(low, (change - tolerance_ns) / lasted)
        high = min(high, (change + tolerance_ns) / lasted)
    return len(points) - 1
