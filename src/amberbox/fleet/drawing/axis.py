"""Time along a drawing that is as wide as there is room: places in percent."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Axis:
    """What the drawing covers, in any unit (nanoseconds as a rule); ``to`` lies after ``start``."""

    start: float
    to: float

    def __post_init__(self) -> None:
        """Raise ValueError for an axis that covers nothing."""
        if not self.to > self.start:
            raise ValueError("an axis ends after it starts")

    def share(self, at: float) -> float:
        """Return where a time lies, from 0 to 1; what lies outside is moved to the edge."""
        return min(1.0, max(0.0, (at - self.start) / (self.to - self.start)))

    def place(self, at: float) -> str:
        """Return where a time lies, in percent."""
        return f"{100 * self.share(at):.3f}%"

    def length(self, start: float, to: float, least: float = 0.0) -> str:
        """Return how long a stretch is, in percent, at least ``least`` of the whole."""
        return f"{100 * max(least, self.share(to) - self.share(start)):.3f}%"

    def covers(self, start: float, to: float) -> bool:
        """Return whether some of a stretch lies on the axis."""
        return start <= self.to and to >= self.start
