"""The hospital: walls, furniture, places, people walking by, and the obstacles of laser beams."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amberbox.sim.noise import Noise

Array = NDArray[np.float64]
Point = tuple[float, float]
CORRIDOR_Y = 1.5
_MAP_RANGE_M = 50.0

# Each line is a chain of wall corners. The corridor runs along x from 0 to 48, 3 m wide.
_WALLS: tuple[tuple[Point, ...], ...] = (
    ((8.0, 3), (5, 3), (0, 3), (0, 0), (4, 0), (4, -2.2), (6.4, -2.2), (6.4, 0), (14, 0)),
    ((9.4, 3), (20, 3)),
    ((21.4, 3), (39.8, 3)),
    ((41.6, 3), (48, 3), (48, 0), (33.4, 0)),
    ((15.4, 0), (32, 0)),
    ((5, 3), (5, 9), (13, 9), (13, 3)),
    ((16, 3), (16, 9), (25, 9), (25, 3)),
    ((10, 0), (10, -6), (19, -6), (19, 0)),
    ((28, 0), (28, -6), (37, -6), (37, 0)),
    ((39.4, 3), (39.4, 6), (42, 6), (42, 3)),
)
_FURNITURE: tuple[tuple[float, float, float, float], ...] = (
    (25.5, 2.8, 27.6, 3.0),
    (35.0, 0.0, 36.2, 0.4),
    (44.0, 2.8, 45.2, 3.0),
    (5.4, 7.0, 6.3, 8.8),
    (11.4, 7.0, 12.4, 8.8),
    (16.5, 7.2, 18.5, 8.2),
    (22.6, 7.2, 24.6, 8.2),
    (10.2, -5.8, 11.0, -3.0),
    (17.8, -5.6, 18.8, -3.0),
    (34.4, -5.8, 36.8, -5.0),
)


@dataclass(frozen=True, slots=True)
class HospitalPlace:
    """A place that a task can name: the way in from the corridor's middle line."""

    name: str
    way_in: tuple[Point, ...]

    @property
    def spot(self) -> Point:
        """Return the point of a place where the robot stops."""
        return self.way_in[-1]


PLACES = {
    place.name: place
    for place in (
        HospitalPlace("charging_station", ((5.2, CORRIDOR_Y), (5.2, -0.9))),
        HospitalPlace("ward_a", ((8.7, CORRIDOR_Y), (8.7, 6.0))),
        HospitalPlace("storage", ((14.7, CORRIDOR_Y), (14.7, -3.6))),
        HospitalPlace("ward_b", ((20.7, CORRIDOR_Y), (20.7, 6.0))),
        HospitalPlace("kitchen", ((32.7, CORRIDOR_Y), (32.7, -3.4))),
        HospitalPlace("elevator", ((40.7, CORRIDOR_Y), (40.7, 4.6))),
    )
}
CART_PLACES = ("ward_a", "storage", "ward_b", "kitchen")
CARTS_AT_START = ("ward_a", "storage")


def route(start: HospitalPlace, goal: HospitalPlace) -> list[Point]:
    """Return the waypoints from one place to another, along the corridor's middle."""
    return [*reversed(start.way_in[:-1]), *goal.way_in]


def way_from(position: Point, goal: HospitalPlace) -> list[Point]:
    """Return waypoints from anywhere: out to the corridor by the nearest place's way, then in."""
    if abs(position[1] - CORRIDOR_Y) < 1.0:
        return list(goal.way_in)
    nearest = min(PLACES.values(), key=lambda place: math.dist(place.spot, position))
    return [goal.spot] if nearest is goal else route(nearest, goal)


def _chain(points: tuple[Point, ...]) -> list[tuple[float, float, float, float]]:
    return [(*a, *b) for a, b in pairwise(points)]


def _box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return _chain(((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)))


def _building() -> Array:
    walls = [segment for chain in _WALLS for segment in _chain(chain)]
    boxes = [segment for box in _FURNITURE for segment in _box(*box)]
    return np.array(walls + boxes, dtype=np.float64)


class Pedestrian:
    """A person who walks up and down the corridor and gives way to the robot."""

    def __init__(self, x: float, y: float, speed: float) -> None:
        self.x, self.y, self.speed = x, y, speed

    def step(self, dt: float, robot: Point) -> None:
        """Walk on; turn round at the ends and before the robot."""
        ahead = (robot[0] - self.x) * self.speed > 0
        if ahead and math.dist((self.x, self.y), robot) < 1.6:
            self.speed = -self.speed
        self.x += self.speed * dt
        if not 1.0 < self.x < 47.0:
            self.speed = math.copysign(self.speed, 24.0 - self.x)

    def outline(self) -> list[tuple[float, float, float, float]]:
        """Return the person as a small diamond."""
        x, y, r = self.x, self.y, 0.22
        return _chain(((x + r, y), (x, y + r), (x - r, y), (x, y - r), (x + r, y)))


class LaserScene:
    """Walls as lines that a laser can be cast against, prepared once for many beams."""

    def __init__(self, segments: Array) -> None:
        self.x0, self.y0, self.x1, self.y1 = segments.T.copy()
        along_x, along_y = self.x1 - self.x0, self.y1 - self.y0
        length = np.maximum(np.hypot(along_x, along_y), 1e-9)
        self.normal_x, self.normal_y = -along_y / length, along_x / length
        self.normal_angle = np.arctan2(self.normal_y, self.normal_x)
        self.offset = self.normal_x * self.x0 + self.normal_y * self.y0


class HospitalWorld:
    """The surroundings of the robot: walls, furniture and people."""

    def __init__(self, noise: Noise) -> None:
        self.building = _building()
        self.people = [
            Pedestrian(noise.uniform(10, 20), 0.45, noise.uniform(0.5, 1.1)),
            Pedestrian(noise.uniform(28, 40), 2.5, -noise.uniform(0.5, 1.1)),
        ]
        self.step(0.0, (0.0, 0.0))

    def step(self, dt: float, robot: Point) -> None:
        """Advance the people by ``dt`` seconds."""
        outlines: list[tuple[float, float, float, float]] = []
        for person in self.people:
            person.step(dt, robot)
            outlines += person.outline()
        self.scene = LaserScene(np.concatenate([self.building, np.array(outlines)]))

    def clearance(self, point: Point) -> float:
        """Return the distance from a point to whatever stands nearest, m."""
        scene = self.scene
        along_x, along_y = scene.x1 - scene.x0, scene.y1 - scene.y0
        to_x, to_y = point[0] - scene.x0, point[1] - scene.y0
        length2 = np.maximum(along_x**2 + along_y**2, 1e-12)
        share = np.clip((to_x * along_x + to_y * along_y) / length2, 0.0, 1.0)
        return float(np.hypot(to_x - share * along_x, to_y - share * along_y).min())

    def wall_ahead(self, origin: Point, direction_rad: float) -> float:
        """Return how far it is from a point to the next wall or furniture on the map, m."""
        beam = np.array([[*origin, direction_rad]])
        return float(cast(LaserScene(self.building), beam, 1, _MAP_RANGE_M)[0, 0])


CIRCLE = 240  # beams in a full turn: one every 1.5 degrees
_TURN = 2 * math.pi
_STEP = _TURN / CIRCLE
_ORIGINS = 4
_ROWS = np.arange(_ORIGINS)[:, None]
# Beams of each origin stand in two rounds, so that a segment may go on past the first beam.
_COS = np.cos(np.arange(2 * CIRCLE * _ORIGINS) * _STEP)
_SIN = np.sin(np.arange(2 * CIRCLE * _ORIGINS) * _STEP)


def cast(scene: LaserScene, origins: Array, beams: int, limit_m: float) -> Array:
    """Return how far each beam gets until it hits something, metres, one row per origin.

    An origin is (x, y, angle of its first beam); beams go round to the left in steps of 1.5
    degrees. Each segment is tested only against the beams between its ends; beams that hit nothing
    give ``limit_m``. Up to four origins are cast at once: calls cost more than numbers.
    """
    x, y, turn = origins.T[:, :, None]
    count = len(origins)
    angle_0 = np.arctan2(scene.y0 - y, scene.x0 - x)
    span = np.arctan2(scene.y1 - y, scene.x1 - x) - angle_0
    span -= _TURN * np.rint(span / _TURN)
    low = (angle_0 + np.minimum(span, 0.0) - turn) / _TURN
    low = (low - np.floor(low)) * CIRCLE
    first = np.ceil(low).astype(np.intp)
    sizes = ((low + np.abs(span) / _STEP).astype(np.intp) - first + 1).ravel()
    height = (scene.offset - scene.normal_x * x - scene.normal_y * y).ravel()
    cos, sin = np.cos(turn), np.sin(turn)
    along = (cos * scene.normal_x + sin * scene.normal_y).ravel()
    across = (sin * scene.normal_x - cos * scene.normal_y).ravel()
    owner = np.repeat(np.arange(sizes.size), sizes)
    start = (first + _ROWS[:count] * 2 * CIRCLE).ravel() + sizes - np.cumsum(sizes)
    beam = np.arange(owner.size) + start[owner]
    distance = np.abs(height[owner] / (_COS[beam] * along[owner] - _SIN[beam] * across[owner]))
    nearest = np.full(count * 2 * CIRCLE, limit_m)
    np.minimum.at(nearest, beam, distance)
    rows = nearest.reshape(count, 2, CIRCLE)
    met: Array = np.minimum(rows[:, 0, :beams], rows[:, 1, :beams])
    return met
