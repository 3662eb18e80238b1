"""Limits of nominal operation: rates and gaps of items; ranges, jumps, rest of variables."""

from __future__ import annotations

from dataclasses import dataclass

RATE_WINDOW_S = 5.0
RATE_WINDOW_PERIODS = 4.0


@dataclass(frozen=True, slots=True)
class VariableLimits:
    """What a variable did in nominal missions, without values that are not finite.

    ``jump`` is the greatest change between two rows. ``change_per_s`` is the greatest change within
    a second, None without a pair of rows for it. ``rest_s`` is the longest time without a change,
    None for a variable that hardly changes. A ``counter`` never falls: it has no range.
    """

    name: str
    low: float
    high: float
    jump: float
    change_per_s: float | None
    rest_s: float | None
    garbage: float
    """Share of values that were not finite, 0 to 1."""
    whole: bool
    """All its values are whole numbers."""
    counter: bool

    @property
    def width(self) -> float:
        """Return the width of its range; for one that is constant, what can be told apart."""
        spread = self.high - self.low
        least = 1.0 if self.whole else max(1e-3 * max(abs(self.low), abs(self.high)), 1e-9)
        return max(spread, least)


@dataclass(frozen=True, slots=True)
class ItemLimits:
    """How the messages of an item came in nominal missions, and what its variables did.

    ``low_hz`` and ``high_hz`` are the rates of the slowest and fastest window, of 5 s or four
    intervals.
    """

    item: str
    messages: int
    mean_hz: float
    low_hz: float
    high_hz: float
    longest_gap_s: float
    variables: tuple[VariableLimits, ...]

    @property
    def window_s(self) -> float:
        """Return the length of the window in which a rate is measured."""
        return max(RATE_WINDOW_S, RATE_WINDOW_PERIODS / self.mean_hz)
