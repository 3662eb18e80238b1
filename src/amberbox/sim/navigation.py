"""Localisation and navigation: a pose from scans and odometry, and waypoints followed.

Scans hold the estimate to the map, odometry carries it in between; the robot slows down before
obstacles.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.sim.noise import Noise, Pose2D, clamp, pose_fields, wrap
from amberbox.sim.sensors import BEAMS, FIELD_RAD, Laser, Scan
from amberbox.sim.world import Point

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
        """Add the error of odometry since the last cycle; return the distance it measured, m."""
        now = Pose2D(true.x, true.y, true.yaw), Pose2D(odometry.x, odometry.y, odometry.yaw)
        before, self._before = self._before or now, now
        ahead, left, turned = relative_motion(before[1], now[1])
        true_ahead, true_left, true_turned = relative_motion(before[0], now[0])
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


def relative_motion(before: Pose2D, now: Pose2D) -> tuple[float, float, float]:
    """Return the motion between two poses, seen from the first."""
    dx, dy = now.x - before.x, now.y - before.y
    cos, sin = math.cos(before.yaw), math.sin(before.yaw)
    return dx * cos + dy * sin, dy * cos - dx * sin, wrap(now.yaw - before.yaw)


CYCLE_S = 0.1
MAX_SPEED, MAX_YAW_RATE = 0.8, 0.7
_ACCELERATION, _YAW_ACCELERATION = 0.5, 1.5
_LOOKAHEAD_M = 0.7
_ARRIVED_M = 0.15
_HALF_WIDTH_M = 0.36
STOP_AT_M = 0.35
OLD_SCAN_NS = 1_000_000_000
_ANGLES = np.linspace(-FIELD_RAD / 2, FIELD_RAD / 2, BEAMS)
_AHEAD, _ASIDE = np.cos(_ANGLES), np.sin(_ANGLES)
_MIDDLE = np.abs(_ANGLES) < math.radians(80)


class Navigation:
    """Path, command and obstacles of the robot, in cycles of 0.1 s."""

    def __init__(self) -> None:
        self.command = (0.0, 0.0, 0.0)
        self.path: list[Point] = []
        self.free_m = 10.0
        self.has_scan = True
        self._from: Point = (0.0, 0.0)

    @property
    def is_idle(self) -> bool:
        """Return whether there is no path to follow."""
        return not self.path

    def go(self, pose: Pose2D, path: list[Point]) -> None:
        """Set a new path from the robot's pose."""
        self._from = (pose.x, pose.y)
        self.path = list(path)

    def stop(self) -> None:
        """Drop the path and stop."""
        self.path = []
        self.command = (0.0, 0.0, 0.0)

    def distance_to_goal(self, pose: Pose2D) -> float:
        """Return the remaining distance, metres."""
        points = [(pose.x, pose.y), *self.path]
        return math.fsum(math.dist(a, b) for a, b in pairwise(points))

    def look(self, scan: Scan | None, now_ns: int) -> None:
        """Set the newest front scan; an old one counts as none."""
        self.has_scan = scan is not None and now_ns - scan.stamp_ns < OLD_SCAN_NS
        if scan is not None and self.has_scan:
            self.free_m = free_ahead(scan.ranges)

    def step(self, pose: Pose2D) -> None:
        """Compute the next command."""
        if self.path and self._remaining(pose) < _ARRIVED_M:
            self._from = self.path.pop(0)
        if not self.path:
            self.ramp(0.0, 0.0)
            return
        target = self._target(pose)
        error = wrap(math.atan2(target[1] - pose.y, target[0] - pose.x) - pose.yaw)
        turn = clamp(1.6 * error, MAX_YAW_RATE)
        speed = 0.0 if abs(error) > 0.5 else self._speed(pose) * math.cos(error) ** 2
        self.ramp(speed, turn if self.has_scan else 0.0)

    def _remaining(self, pose: Pose2D) -> float:
        """Return the way to the current waypoint, measured along the segment."""
        goal = self.path[0]
        length = math.dist(self._from, goal)
        if length < 0.3:
            return math.dist((pose.x, pose.y), goal)
        along = (goal[0] - pose.x) * (goal[0] - self._from[0])
        along += (goal[1] - pose.y) * (goal[1] - self._from[1])
        return along / length

    def _target(self, pose: Pose2D) -> Point:
        """Return a point of the segment slightly ahead of the robot."""
        goal = self.path[0]
        length = math.dist(self._from, goal)
        if length < 0.3:
            return goal
        left = max(0.0, self._remaining(pose) - _LOOKAHEAD_M)
        share = left / length
        return goal[0] + (self._from[0] - goal[0]) * share, goal[1] + (
            self._from[1] - goal[1]
        ) * share

    def _speed(self, pose: Pose2D) -> float:
        if not self.has_scan:
            return 0.0
        slow_down = 0.15 + 0.7 * max(0.0, self._remaining(pose) - _ARRIVED_M)
        obstacle = max(0.0, 0.8 * (self.free_m - STOP_AT_M))
        return min(MAX_SPEED, slow_down, obstacle)

    def ramp(self, speed: float, turn: float) -> None:
        """Change the command towards a wanted speed and turn rate, as fast as the base may."""
        last_speed, _, last_turn = self.command
        braking = 2.0 * _ACCELERATION if speed < last_speed else _ACCELERATION
        self.command = (
            last_speed + clamp(speed - last_speed, braking * CYCLE_S),
            0.0,
            last_turn + clamp(turn - last_turn, _YAW_ACCELERATION * CYCLE_S),
        )


def free_ahead(ranges: NDArray[np.float64]) -> float:
    """Return how far the robot's own width is free ahead of the front laser, metres."""
    in_way = _MIDDLE & (np.abs(ranges * _ASIDE) < _HALF_WIDTH_M) & (ranges > 0.02)
    distances = np.where(in_way, ranges * _AHEAD, 10.0)
    return float(np.partition(distances, 2)[2])  # two beams may err
