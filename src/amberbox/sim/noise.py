"""Noise from seeded streams: each part of the robot draws from one of its own.

Because no two parts share a stream, what happens to one never changes the noise of another.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_BLOCK = 2048  # single draws from numpy are slow, so they are taken in blocks


class Noise:
    """A stream of random numbers named after the part that uses it."""

    def __init__(self, seed: int, name: str) -> None:
        self._rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        self._normal: list[float] = []
        self._uniform: list[float] = []

    def normal(self, sigma: float) -> float:
        """Draw from a normal distribution with mean zero."""
        if not self._normal:
            self._normal = self._rng.standard_normal(_BLOCK).tolist()
        return sigma * self._normal.pop()

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Draw evenly from an interval."""
        if not self._uniform:
            self._uniform = self._rng.random(_BLOCK).tolist()
        return low + (high - low) * self._uniform.pop()

    def integer(self, low: int, high: int) -> int:
        """Draw an integer from ``low`` up to, not including, ``high``."""
        return low + int(self.uniform() * (high - low))

    def normals(self, count: int, sigma: float) -> NDArray[np.float64]:
        """Draw ``count`` normal numbers as an array."""
        return self._rng.standard_normal(count) * sigma

    def uniforms(self, count: int) -> NDArray[np.float64]:
        """Draw ``count`` even numbers from [0, 1) as an array."""
        return self._rng.random(count)

    def pick(self, choices: list[Any]) -> Any:
        """Choose one of a list."""
        return choices[self.integer(0, len(choices))]
