"""Navigation: follows waypoints on the estimated pose and slows down before obstacles."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amberbox.sim.geometry import Pose2D, clamp, wrap
from amberbox.sim.laser import BEAMS, FIELD_RAD, Scan
from amberbox.sim.world import Point

CYCLE_S = 0.1
MAX_SPEED, MAX_YAW_RATE = 0.8, 0.7
_ACCELERATION, _YAW_ACCELERATION = 0.5, 1.5
_LOOKAHEAD_M = 0.7
_ARRIVED_M = 0.15
_HALF_WIDTH_M = 0.36
_STOP_AT_M = 0.35
_OLD_SCAN_NS = 1_000_000_000
_ANGLES = np.linspace(-FIELD_RAD / 2, FIELD_RAD / 2, BEAMS)
_AHEAD, _ASIDE = np.cos(_ANGLES), np.sin(_ANGLES)
_MIDDLE = np.abs(_ANGLES) < math.radians(80)


class Navigation:
    """Path, command and what holds the robot up, one cycle of 0.1 s after the other."""

    def __init__(self) -> None:
        self.command = (0.0, 0.0, 0.0)
        self.path: list[Point] = []
        self.free_m = 10.0
        self.has_scan = True
        self._from: Point = (0.0, 0.0)

    @property
    def is_idle(self) -> bool:
        """Whether there is nowhere to go."""
        return not self.path

    def go(self, pose: Pose2D, path: list[Point]) -> None:
        """Take a new path from where the robot is."""
        self._from = (pose.x, pose.y)
        self.path = list(path)

    def stop(self) -> None:
        """Forget the path and stand still."""
        self.path = []
        self.command = (0.0, 0.0, 0.0)

    def distance_to_goal(self, pose: Pose2D) -> float:
        """Return the way that is left, metres."""
        points = [(pose.x, pose.y), *self.path]
        return math.fsum(math.dist(a, b) for a, b in pairwise(points))

    def look(self, scan: Scan | None, now_ns: int) -> None:
        """Take the newest front scan; an old one counts as none."""
        self.has_scan = scan is not None and now_ns - scan.stamp_ns < _OLD_SCAN_NS
        if scan is not None and self.has_scan:
            self.free_m = free_ahead(scan.ranges)

    def step(self, pose: Pose2D) -> None:
        """Compute the next command."""
        self._pass_waypoint(pose)
        if not self.path:
            self._ramp(0.0, 0.0)
            return
        target = self._target(pose)
        error = wrap(math.atan2(target[1] - pose.y, target[0] - pose.x) - pose.yaw)
        turn = clamp(1.6 * error, MAX_YAW_RATE)
        speed = 0.0 if abs(error) > 0.5 else self._speed(pose) * math.cos(error) ** 2
        self._ramp(speed, turn if self.has_scan else 0.0)

    def _pass_waypoint(self, pose: Pose2D) -> None:
        if self.path and self._remaining(pose) < _ARRIVED_M:
            self._from = self.path.pop(0)

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
        """Return the point of the segment that lies a little ahead."""
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
        obstacle = max(0.0, 0.8 * (self.free_m - _STOP_AT_M))
        return min(MAX_SPEED, slow_down, obstacle)

    def _ramp(self, speed: float, turn: float) -> None:
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
