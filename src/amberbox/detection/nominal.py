"""Nominal p-values: how rare a score is in nominal operation."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

POINTS = 64
_TAIL_SHARE = 0.02
_LEAST_TAIL = 5
_LEAST_SCALE, _MOST_SCALE = 0.1, 0.25


@dataclass(frozen=True, slots=True)
class NominalDistribution:
    """The survival function of nominal scores: empirical, with an exponential tail beyond them.

    The tail is one in the logarithm of the score, of the mean excess of the greatest 2 %, within
    bounds. ``levels`` are logarithms of scores in order, the more the greater they are;
    ``survival`` are the shares that reach them.
    """

    levels: tuple[float, ...]
    survival: tuple[float, ...]
    scale: float
    count: int

    @classmethod
    def of(cls, scores: Sequence[float] | NDArray[np.float64]) -> Self:
        """Learn from nominal scores, at least one."""
        ordered = np.sort(_compressed(np.asarray(scores, np.float64)))
        count = len(ordered)
        tail = min(count, max(_LEAST_TAIL, math.ceil(_TAIL_SHARE * count)))
        excess = float(np.mean(ordered[count - tail :]) - ordered[count - tail])
        scale = min(max(excess, _LEAST_SCALE), _MOST_SCALE)
        evenly = np.linspace(0, count - 1, POINTS // 2)
        from_top = count - np.geomspace(1, count, POINTS // 2)
        levels = np.unique(ordered[np.concatenate((evenly, from_top)).astype(int)])
        reached = count - np.searchsorted(ordered, levels, "left")
        return cls(tuple(levels.tolist()), tuple((reached / count).tolist()), scale, count)

    def p_value(self, score: float) -> float:
        """Return the share of nominal scores that are as great, from 1 down to 0."""
        level = _compressed_one(score)
        place = bisect_right(self.levels, level) - 1
        if place < 0:
            return 1.0
        if place < len(self.levels) - 1:
            low, high = self.levels[place], self.levels[place + 1]
            part = (level - low) / (high - low)
            return self.survival[place] + part * (self.survival[place + 1] - self.survival[place])
        return self.survival[-1] * math.exp(-(level - self.levels[-1]) / self.scale)

    def score_at(self, p_value: float) -> float:
        """Return the score that has this p-value."""
        if p_value >= self.survival[-1]:
            rising = self.survival[::-1]
            return _expanded(float(np.interp(p_value, rising, self.levels[::-1])))
        return _expanded(self.levels[-1] - self.scale * math.log(p_value / self.survival[-1]))

    def numbers(self) -> NDArray[np.float64]:
        """Return it as numbers of the same count for any distribution, for ``from_numbers``."""
        row = np.full(2 * POINTS + 2, np.nan)
        row[0], row[1] = self.scale, self.count
        row[2 : 2 + len(self.levels)] = self.levels
        row[2 + POINTS : 2 + POINTS + len(self.survival)] = self.survival
        return row

    @classmethod
    def from_numbers(cls, row: NDArray[Any]) -> Self:
        """Read what ``numbers`` returned; raise ValueError if it is no distribution."""
        if row.shape != (2 * POINTS + 2,) or row.dtype != np.float64:
            raise ValueError("a distribution has another number of levels")
        used = int(np.isfinite(row[2 : 2 + POINTS]).sum())
        levels, survival = row[2 : 2 + used], row[2 + POINTS : 2 + POINTS + used]
        rises = bool((np.diff(levels) > 0).all() and (np.diff(survival) <= 0).all())
        within = bool(used) and bool((survival > 0).all() and (survival <= 1).all())
        if not (rises and within and np.isfinite(row[:2]).all() and row[0] > 0 and row[1] >= 1):
            raise ValueError("a distribution does not fall from 1 to 0")
        parts = tuple(levels.tolist()), tuple(survival.tolist())
        return cls(*parts, float(row[0]), int(row[1]))


def _compressed(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sign(s) log(1 + |s|): mission scores may be negative."""
    return np.sign(scores) * np.log1p(np.abs(scores))


def _compressed_one(score: float) -> float:
    return math.copysign(math.log1p(abs(score)), score)


def _expanded(level: float) -> float:
    return math.copysign(math.expm1(min(abs(level), 700.0)), level)
