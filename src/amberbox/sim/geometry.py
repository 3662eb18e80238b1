"""Small plane geometry: angles, poses, quaternions."""

from __future__ import annotations

import math
from dataclasses import dataclass


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
    """Where something stands in the plane: metres and radians."""

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
