"""The moving base: a body on four wheel units, and the odometry computed from them."""

from __future__ import annotations

import math
from collections.abc import Callable

from amberbox.sim.geometry import Pose2D, pose_fields
from amberbox.sim.noise import Noise
from amberbox.sim.topics import WHEELS
from amberbox.sim.wheel_unit import TRAIL_M, WHEEL_DISTANCE_M, WHEEL_RADIUS_M, WheelUnit

Twist = tuple[float, float, float]
Motion = tuple[float, float, float]
BODY_KG, CART_KG = 130.0, 80.0
_ROLLING_FRICTION = 0.015
_PLAUSIBLE_RATE = 60.0
_PIVOTS = {"front_left": (0.3, 0.2), "front_right": (0.3, -0.2)} | {
    "rear_left": (-0.3, 0.2),
    "rear_right": (-0.3, -0.2),
}
_LEVER2 = sum(x * x + y * y for x, y in _PIVOTS.values())


class Base:
    """The body's true motion; nothing in here is published as it is.

    Knob (nominal value): ``sway_m_s2`` (0) how hard a loose load jerks the body while it moves.
    """

    def __init__(self, make_noise: Callable[[str], Noise], start: Pose2D) -> None:
        self.units = {
            name: WheelUnit(*_PIVOTS[name], make_noise(f"wheel_{name}")) for name in WHEELS
        }
        self.sway_m_s2 = 0.0
        self.pose = start
        self.twist: Twist = (0.0, 0.0, 0.0)
        self.acceleration = (0.0, 0.0)
        self.has_cart = False
        self._sway_phase = 0.0

    @property
    def power_w(self) -> float:
        """Electrical power that the eight drives draw."""
        return sum(unit.power_w for unit in self.units.values())

    def step(self, dt: float, command: Twist) -> None:
        """Advance the body by ``dt`` with a wanted twist (vx, vy, yaw rate)."""
        vx, vy, yaw_rate = self.twist
        force_x = force_y = moment = 0.0
        for unit in self.units.values():
            x, y = unit.x, unit.y
            wanted = command[0] - command[2] * y, command[1] + command[2] * x
            true = vx - yaw_rate * y, vy + yaw_rate * x
            push_x, push_y = unit.step(dt, wanted, true, yaw_rate)
            force_x += push_x
            force_y += push_y
            moment += x * push_y - y * push_x
        self._move(dt, force_x, force_y, moment)

    def halt(self) -> None:
        """Stand still at once, as against a wall."""
        self.twist = (0.0, 0.0, 0.0)

    def _move(self, dt: float, force_x: float, force_y: float, moment: float) -> None:
        vx, vy, yaw_rate = self.twist
        mass = BODY_KG + (CART_KG if self.has_cart else 0.0)
        inertia = 0.1 * mass
        resistance = _ROLLING_FRICTION * mass * 9.81 * math.tanh(vx / 0.05)
        accel_x = (force_x - resistance) / mass + self._sway(dt, vx)
        accel_y = force_y / mass
        self.pose.advance(vx, vy, yaw_rate, dt)
        self.twist = (
            vx + (accel_x + yaw_rate * vy) * dt,
            vy + (accel_y - yaw_rate * vx) * dt,
            (yaw_rate + moment / inertia * dt) * (1.0 - 0.5 * dt),
        )
        self.acceleration = (accel_x, accel_y)
        for unit in self.units.values():
            unit.feel(self.acceleration, self.twist[2])

    def _sway(self, dt: float, vx: float) -> float:
        self._sway_phase += dt * 2 * math.pi * 1.7
        return self.sway_m_s2 * math.sin(self._sway_phase) * math.tanh(abs(vx) / 0.1)


class Odometry:
    """Pose and twist as the base controller computes them from what the fieldbus brings."""

    def __init__(self, start: Pose2D) -> None:
        self.pose = Pose2D(start.x, start.y, start.yaw)
        self.twist: Twist = (0.0, 0.0, 0.0)
        self._last = dict.fromkeys(WHEELS, (0.0, 0.0, 0.0))

    def step(self, dt: float, motions: dict[str, Motion]) -> None:
        """Advance by ``dt``; a value that no wheel can have is replaced by the last good one."""
        vx = vy = turning = 0.0
        for name, motion in motions.items():
            if max(abs(motion[0]), abs(motion[1]), abs(motion[2])) < _PLAUSIBLE_RATE:
                self._last[name] = motion
            x, y = _PIVOTS[name]
            unit_x, unit_y = pivot_velocity(self._last[name])
            vx += unit_x
            vy += unit_y
            turning += x * unit_y - y * unit_x
        self.twist = (vx / 4, vy / 4, turning / _LEVER2)
        self.pose.advance(*self.twist, dt)

    def fields(self) -> dict[str, object]:
        """Return the body of an odometry message."""
        vx, vy, yaw_rate = self.twist
        return {
            "child_frame_id": "base_link",
            "pose": pose_fields(self.pose.x, self.pose.y, 0.0, self.pose.yaw),
            "twist": twist_fields(vx, vy, yaw_rate),
        }


def pivot_velocity(motion: Motion) -> tuple[float, float]:
    """Return the velocity of a unit's pivot point (body frame) from wheel rates and angle."""
    rate_1, rate_2, angle = motion
    ahead = WHEEL_RADIUS_M * (rate_1 - rate_2) / 2
    sideways = -TRAIL_M * WHEEL_RADIUS_M * (rate_1 + rate_2) / WHEEL_DISTANCE_M
    cos, sin = math.cos(angle), math.sin(angle)
    return ahead * cos - sideways * sin, ahead * sin + sideways * cos


def twist_fields(vx: float, vy: float, yaw_rate: float) -> dict[str, dict[str, float]]:
    """Write a plane twist as a message does."""
    return {
        "linear": {"x": round(vx, 5), "y": round(vy, 5), "z": 0.0},
        "angular": {"x": 0.0, "y": 0.0, "z": round(yaw_rate, 5)},
    }
