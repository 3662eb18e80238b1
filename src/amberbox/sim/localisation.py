"""Localisation: a pose estimate that scans hold to the map and odometry carries in between."""

from __future__ import annotations

import math
from typing import Any

from amberbox.sim.geometry import Pose2D, pose_fields, wrap
from amberbox.sim.laser import BEAMS, Laser
from amberbox.sim.noise import Noise

_GAIN = 0.25
_STEP_S = 0.1


class Localisation:
    """Keeps the error of the estimate and its covariance, as a particle filter would have them.

    Between corrections the error grows by what odometry gets wrong; a scan that agrees with the
    map takes a share of it away. Knobs (nominal value): ``matching`` (1) share of the
    correction that takes place, ``shift_m`` (0) sideways error that the filter believes in.
    """

    def __init__(self, noise: Noise) -> None:
        self._noise = noise
        self.matching = 1.0
        self.shift_m = 0.0
        self.error = Pose2D()
        self.variance = [0.002, 0.002, 0.0005]
        self.estimate = Pose2D()
        self.score = 1.0
        self._before: tuple[Pose2D, Pose2D] | None = None

    def step(self, true: Pose2D, odometry: Pose2D, lasers: list[Laser], now_ns: int) -> None:
        """Advance by one cycle (0.1 s)."""
        moved = self._carry(true, odometry)
        agreements = [laser.agreement(now_ns) for laser in lasers]
        self.score = sum(agreements) / len(agreements)
        gain = _GAIN * self.matching * self.score**2
        self._correct(gain, sum(laser.yaw_rad for laser in lasers) / len(lasers))
        self._spread(moved, gain)
        self._estimate(true)

    def reset(self) -> None:
        """Start again from a pose that a person gave."""
        self.error = Pose2D()
        self._before = None

    def fields(self) -> dict[str, Any]:
        """Return the body of a ``localisation`` message."""
        covariance = [0.0] * 36
        for index, variance in zip((0, 7, 35), self.variance, strict=True):
            covariance[index] = round(variance, 7)
        draw = self._noise.normal
        estimate = self.estimate
        score = min(1.0, max(0.0, self.score + draw(0.01)))
        return {
            "pose": pose_fields(estimate.x, estimate.y, 0.0, estimate.yaw),
            "covariance": covariance,
            "match_score": round(score, 4),
            "beams_used": round(2 * BEAMS * score),
        }

    def _carry(self, true: Pose2D, odometry: Pose2D) -> float:
        """Add what odometry got wrong since the last cycle; return the way it says was driven."""
        now = Pose2D(true.x, true.y, true.yaw), Pose2D(odometry.x, odometry.y, odometry.yaw)
        before, self._before = self._before or now, now
        ahead, left, turned = _relative(before[1], now[1])
        true_ahead, true_left, true_turned = _relative(before[0], now[0])
        yaw = true.yaw + self.error.yaw
        off_ahead, off_left = ahead - true_ahead, left - true_left
        self.error.x += off_ahead * math.cos(yaw) - off_left * math.sin(yaw)
        self.error.y += off_ahead * math.sin(yaw) + off_left * math.cos(yaw)
        self.error.yaw = wrap(self.error.yaw + turned - true_turned)
        return math.hypot(ahead, left) + 0.3 * abs(turned)

    def _correct(self, gain: float, laser_yaw: float) -> None:
        draw = self._noise.normal
        error = self.error
        error.x += -gain * error.x + draw(0.006)
        error.y += -gain * error.y + draw(0.006)
        error.yaw += -gain * (error.yaw + laser_yaw) + draw(0.002)

    def _spread(self, moved: float, gain: float) -> None:
        grow = (0.002 * moved, 0.002 * moved, 0.0005 * moved)
        floor = (0.0016, 0.0016, 0.0004)
        for index in range(3):
            ideal = floor[index] / max(0.05, self.score * min(1.0, self.matching + 0.05))
            variance = self.variance[index] + grow[index] + 0.02 * _STEP_S * floor[index]
            variance -= gain * max(0.0, variance - ideal)
            variance *= 1.0 + self._noise.normal(0.02)
            self.variance[index] = min(4.0, max(0.3 * floor[index], variance))

    def _estimate(self, true: Pose2D) -> None:
        error, yaw = self.error, true.yaw
        self.estimate = Pose2D(
            true.x + error.x - self.shift_m * math.sin(yaw),
            true.y + error.y + self.shift_m * math.cos(yaw),
            wrap(yaw + error.yaw),
        )


def _relative(before: Pose2D, now: Pose2D) -> tuple[float, float, float]:
    """Return the motion between two poses, seen from the first."""
    dx, dy = now.x - before.x, now.y - before.y
    cos, sin = math.cos(before.yaw), math.sin(before.yaw)
    return dx * cos + dy * sin, dy * cos - dx * sin, wrap(now.yaw - before.yaw)
