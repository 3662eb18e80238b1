"""The two baselines of a score: nominal missions of the fleet, and the mission itself.

Offsets between missions can be greater than what a fault causes, so that the same score may be
nominal in one mission and not in another. The mission baseline removes them; it is blind to a fault
that is there from the start, which the fleet baseline sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

from amberbox.core.clock import NS

Baseline: TypeAlias = Literal["fleet", "mission"]

WARM_UP_S = 10.0
ADAPTATION_S = 60.0
_LEAST_SCORES = 20
_OFFSET = 0.01  # below it, scores are alike
_LEAST_SPREAD = 0.1
_CLIP = 3.0


class MissionStandardisation:
    """Standardises the log of a score by its own past in the mission.

    It learns mean and variance during a warm-up of 10 s (at least 20 scores), and adapts slowly
    from then on. The mean moves by three standard deviations a minute at most, and what is further
    off does not change the variance, so that a fault is not learnt soon.
    """

    __slots__ = ("_count", "_last_ns", "_mean", "_start_ns", "_variance")

    def __init__(self) -> None:
        self._start_ns = self._last_ns = 0
        self._count = 0
        self._mean = self._variance = 0.0

    def standardise(self, at_ns: int, score: float) -> float | None:
        """Return the standardised score, None during the warm-up; times do not decrease."""
        value = math.log(score + _OFFSET)
        if not self._count:
            self._start_ns = at_ns
        if self._count < _LEAST_SCORES or at_ns - self._start_ns < WARM_UP_S * NS:
            self._warm_up(value)
            self._last_ns = at_ns
            return None
        spread = max(math.sqrt(self._variance), _LEAST_SPREAD)
        found = (value - self._mean) / spread
        step = min(max(found, -_CLIP), _CLIP) * spread
        weight = 1.0 - math.exp((self._last_ns - at_ns) / (ADAPTATION_S * NS))
        self._mean += weight * step
        if abs(found) < _CLIP:
            self._variance += weight * (step * step - self._variance)
        self._last_ns = at_ns
        return found

    def _warm_up(self, value: float) -> None:
        self._count += 1
        difference = value - self._mean
        self._mean += difference / self._count
        squares = self._variance * (self._count - 1)
        self._variance = (squares + difference * (value - self._mean)) / self._count

    def snapshot(self) -> list[float]:
        """Return its state as JSON."""
        return [self._start_ns, self._last_ns, self._count, self._mean, self._variance]

    def resume(self, snapshot: Sequence[float]) -> None:
        """Restore the state that ``snapshot`` returned."""
        start_ns, last_ns, count, mean, variance = snapshot
        self._start_ns, self._last_ns, self._count = int(start_ns), int(last_ns), int(count)
        self._mean, self._variance = float(mean), float(variance)
