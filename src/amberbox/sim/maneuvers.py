"""Maneuvers of the commanded robot: a straight line, a turn on the spot, and the way to a place."""

from __future__ import annotations

import math

from amberbox.sim.navigation import STOP_AT_M, relative_motion
from amberbox.sim.noise import Noise, Pose2D, clamp, wrap
from amberbox.sim.world import CORRIDOR_Y, PLACES, HospitalPlace, Point, route

_BRAKING = 0.25  # m/s2 of the planned slowing down
_YAW_BRAKING = 0.6
_CREEP, _YAW_CREEP = 0.03, 0.05
_ARRIVED_M, _ARRIVED_RAD = 0.012, 0.012
_HOLD_HEADING = 1.6  # rad/s per rad
_HOLD_LINE = 0.5  # rad/s per m, at 1 m/s
_MAX_CORRECTION = 0.4
_OFF_THE_WAY_M, _MIDDLE_M = 0.3, 0.6

Wish = tuple[float, float]
"""Wanted speed ahead (m/s) and turn rate (rad/s)."""


class Straight:
    """A line from ``start`` along its heading; ``distance_m`` is negative for backwards."""

    def __init__(self, start: Pose2D, distance_m: float, speed: float) -> None:
        self._start = Pose2D(start.x, start.y, start.yaw)
        self._distance_m, self._speed = distance_m, speed
        self._sign = math.copysign(1.0, distance_m)
        self.travelled_m = 0.0

    @property
    def is_backward(self) -> bool:
        """Return whether the robot drives backwards."""
        return self._sign < 0

    @property
    def remaining_m(self) -> float:
        """Return how far it still has to go."""
        return max(0.0, abs(self._distance_m) - self.travelled_m * self._sign)

    def step(self, pose: Pose2D, free_m: float) -> Wish | None:
        """Return the wanted motion at a pose, given the free way; None when it has arrived."""
        self.travelled_m, left, turned = relative_motion(self._start, pose)
        if self.remaining_m < _ARRIVED_M:
            return None
        slow_down = max(_CREEP, math.sqrt(2.0 * _BRAKING * self.remaining_m) - _CREEP)
        obstacle = max(0.0, 0.8 * (free_m - STOP_AT_M))
        speed = min(self._speed, slow_down, obstacle)
        line = _HOLD_LINE / max(0.1, self._speed) * left * self._sign
        turn = clamp(-_HOLD_HEADING * turned - line, _MAX_CORRECTION) if speed > 0.0 else 0.0
        return self._sign * speed, turn


class Turn:
    """A turn on the spot; ``angle_rad`` is positive to the left and may exceed a full turn."""

    def __init__(self, start: Pose2D, angle_rad: float, rate: float) -> None:
        self._angle_rad, self._rate = angle_rad, rate
        self._last_yaw = start.yaw
        self.turned_rad = 0.0

    def step(self, pose: Pose2D) -> Wish | None:
        """Return the wanted motion at a pose; None when it has turned far enough."""
        self.turned_rad += wrap(pose.yaw - self._last_yaw)
        self._last_yaw = pose.yaw
        remaining = self._angle_rad - self.turned_rad
        if abs(remaining) < _ARRIVED_RAD:
            return None
        slow_down = max(_YAW_CREEP, math.sqrt(2.0 * _YAW_BRAKING * abs(remaining)) - _YAW_CREEP)
        return 0.0, math.copysign(min(self._rate, slow_down), remaining)


class DockingMarker:
    """The marker of the charging station as the robot sees it; each approach errs sideways.

    Knobs (nominal value): ``error_m`` (0) extra sigma of the sideways error, ``offset_m`` (0) how
    far the marker hangs beside its place.
    """

    def __init__(self, noise: Noise) -> None:
        self._noise = noise
        self.error_m = 0.0
        self.offset_m = 0.0

    def see(self) -> float:
        """Return how far the station seems to stand beside its place on the map, m."""
        return self.offset_m + self._noise.normal(_MARKER_SIGMA_M + self.error_m)


STATION = PLACES["charging_station"]
DOCKING_SPEED = 0.12
UNDOCKING_M = 1.4
_MARKER_SIGMA_M = 0.015
_CONTACT_ASIDE_M, _CONTACT_ALONG_M, _CONTACT_RAD = 0.03, 0.12, 0.12
_APPROACH_M = 1.0


def approach_point() -> Point:
    """Return where the approach to the charging station begins."""
    return STATION.spot[0], STATION.spot[1] + _APPROACH_M


def final_approach(pose: Pose2D, marker_m: float) -> Straight:
    """Return the line from an estimated pose onto the contacts of the station."""
    line = Pose2D(STATION.spot[0] + marker_m, pose.y, -math.pi / 2)
    return Straight(line, max(0.0, pose.y - STATION.spot[1]), DOCKING_SPEED)


def is_on_contacts(pose: Pose2D) -> bool:
    """Return whether a robot that truly stands here touches the charger's contacts in the floor.

    They are two rails along the way in, so the robot may stand either way round.
    """
    aside, along = abs(pose.x - STATION.spot[0]), abs(pose.y - STATION.spot[1])
    skew = abs(abs(pose.yaw) - math.pi / 2)
    return aside < _CONTACT_ASIDE_M and along < _CONTACT_ALONG_M and skew < _CONTACT_RAD


def way_to(pose: Pose2D, goal: HospitalPlace) -> list[Point]:
    """Return waypoints to a place from anywhere: first back to the way that the robot has left."""
    position = pose.x, pose.y
    if 0.0 < pose.y < 2.0 * CORRIDOR_Y:
        if abs(pose.x - goal.spot[0]) < _OFF_THE_WAY_M:
            return [goal.spot]
        if abs(pose.y - CORRIDOR_Y) < _MIDDLE_M:
            return list(goal.way_in)
        return [(pose.x, CORRIDOR_Y), *goal.way_in]
    nearest = min(PLACES.values(), key=lambda place: math.dist(place.spot, position))
    if nearest is goal:
        return [goal.spot]
    is_beside = abs(pose.x - nearest.spot[0]) > _OFF_THE_WAY_M
    return [*([(nearest.spot[0], pose.y)] if is_beside else []), *route(nearest, goal)]
