"""Noise from seeded streams, and plane geometry: angles, poses, quaternions.

Each part of the robot draws noise from a stream of its own, so what happens to one never changes
the noise of another.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
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


def wrap(angle_rad: float) -> float:
    """Bring an angle into (-pi, pi]."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    return math.atan2(math.sin(angle_rad), math.cos(angle_rad))


def clamp(value: float, limit: float) -> float:
    """Limit a value to [-limit, limit]."""
    if value > limit:
        return limit
    return value if value > -limit else -limit


@dataclass(slots=True)
class Pose2D:
    """A position and heading in the plane: metres and radians."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def advance(self, vx: float, vy: float, yaw_rate: float, dt: float) -> None:
        """Move with a twist given in the body's own frame."""
        middle = self.yaw + 0.5 * yaw_rate * dt
        cos, sin = math.cos(middle), math.sin(middle)
        self.x += (vx * cos - vy * sin) * dt
        self.y += (vx * sin + vy * cos) * dt
        self.yaw = wrap(self.yaw + yaw_rate * dt)


def pose_fields(x: float, y: float, z: float, yaw: float) -> dict[str, dict[str, float]]:
    """Write a pose as a message does."""
    return {
        "position": {"x": round(x, 5), "y": round(y, 5), "z": round(z, 3)},
        "orientation": turn_fields(yaw),
    }


def turn_fields(yaw: float) -> dict[str, float]:
    """Write a rotation about the vertical as a quaternion."""
    z, w = round(math.sin(yaw / 2), 7), round(math.cos(yaw / 2), 7)
    return {"x": 0.0, "y": 0.0, "z": z, "w": w}


def xyz_fields(x: float, y: float, z: float) -> dict[str, float]:
    """Write a vector as a message does, to five decimals."""
    return {"x": round(x, 5), "y": round(y, 5), "z": round(z, 5)}
