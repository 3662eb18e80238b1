"""A planar laser scanner: beams cast into the world, and what the device makes of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amberbox.sim.geometry import Pose2D
from amberbox.sim.noise import Noise
from amberbox.sim.world import CIRCLE, Scene, cast

BEAMS = 181
FIELD_RAD = (BEAMS - 1) * 2 * math.pi / CIRCLE
RANGE_MIN_M, RANGE_MAX_M = 0.05, 25.0
SCAN_TIME_S = 0.1
_ANGLES = np.linspace(-FIELD_RAD / 2, FIELD_RAD / 2, BEAMS)
_INCREMENT = FIELD_RAD / (BEAMS - 1)
_NO_RETURN = 0.0
_CART_BEHIND_M = 0.35
_CART_LEGS = np.where(
    np.abs(_ANGLES) < math.radians(35), _CART_BEHIND_M / np.cos(_ANGLES), RANGE_MAX_M
)


class Scan(NamedTuple):
    """A scan with its own stamp (ns of true time), as the rest of the software gets it."""

    stamp_ns: int
    ranges: NDArray[np.float64]
    fields: dict[str, Any]
    agreement: float
    """Share of beams that a map would explain."""


class View(NamedTuple):
    """Distances around a laser: along the beams as it believes to sit, and as it really sits."""

    expected: NDArray[np.float64]
    true: NDArray[np.float64]


class Laser:
    """One scanner, ``offset_m`` ahead of the robot's middle, looking along ``facing_rad``.

    Knobs (nominal value): ``cover_deg`` (0) width of a sector with something on the window,
    ``dirt`` (0) share of light lost, ``held`` (0) above 0.5 the driver hands out its last scan
    again, ``quiet`` (0) above 0.5 no scan comes, ``yaw_rad`` (0) turn of the mount,
    ``spin_loss`` (0) share of the motor's speed lost.
    """

    def __init__(self, offset_m: float, facing_rad: float, noise: Noise) -> None:
        self._offset_m, self._facing_rad = offset_m, facing_rad
        self._noise = noise
        self._cover_centre = noise.uniform(-0.2, 0.2)
        self.cover_deg = 0.0
        self.dirt = 0.0
        self.held = 0.0
        self.quiet = 0.0
        self.yaw_rad = 0.0
        self.spin_loss = 0.0
        self.last: Scan | None = None
        self._turns = 0.0
        self._fresh: Scan | None = None

    def turn(self, view: View, now_ns: int, has_cart: bool) -> None:
        """Let the mirror turn for 0.1 s; a scan may come out of it."""
        self._turns += 1.0 - min(0.95, self.spin_loss)
        if self._turns < 0.999:
            return
        self._turns -= 1.0
        if self.quiet > 0.5:
            return
        if self.held < 0.5 or self.last is None:
            self.last = self._measure(view, now_ns, has_cart)
        self._fresh = self.last

    def take(self) -> Scan | None:
        """Return the scan that has come since the last call, if any."""
        scan, self._fresh = self._fresh, None
        return scan

    def agreement(self, now_ns: int) -> float:
        """Return how far the map explains the newest scan; 0 when that is old."""
        if self.last is None or now_ns - self.last.stamp_ns > 600_000_000:
            return 0.0
        return self.last.agreement

    def origin(self, pose: Pose2D, mount_yaw: float) -> tuple[float, float, float]:
        """Return where the beams start and the angle of the first one, for ``cast``."""
        x = pose.x + self._offset_m * math.cos(pose.yaw)
        y = pose.y + self._offset_m * math.sin(pose.yaw)
        return x, y, pose.yaw + self._facing_rad + mount_yaw - FIELD_RAD / 2

    def _measure(self, view: View, now_ns: int, has_cart: bool) -> Scan:
        ranges = self._receive(view.true, has_cart)
        off = np.abs(ranges - view.expected) > 0.15 + 0.02 * view.expected
        agreement = (BEAMS - int(np.count_nonzero(off))) / BEAMS / (0.74 if has_cart else 1.0)
        return Scan(now_ns - 15_000_000, ranges, self._fields(ranges), min(1.0, agreement))

    def _receive(self, true: NDArray[np.float64], has_cart: bool) -> NDArray[np.float64]:
        noise = self._noise
        if has_cart:
            true = np.minimum(true, _CART_LEGS)
        sigma = 0.012 * (1.0 + 2.0 * self.dirt)
        ranges = true + noise.normals(BEAMS, sigma)
        loss = 0.002 + self.dirt * (0.25 + 0.75 * true / RANGE_MAX_M)
        ranges[(noise.uniforms(BEAMS) < loss) | (true >= RANGE_MAX_M)] = _NO_RETURN
        if self.cover_deg > 0.0:
            covered = np.abs(_ANGLES - self._cover_centre) < math.radians(self.cover_deg) / 2
            ranges[covered] = 0.11 + noise.normals(int(covered.sum()), 0.006)
        return ranges

    def _fields(self, ranges: NDArray[np.float64]) -> dict[str, Any]:
        turn_s = SCAN_TIME_S / (1.0 - min(0.95, self.spin_loss)) + self._noise.normal(0.00005)
        return {
            "angle_min": round(-FIELD_RAD / 2, 6),
            "angle_max": round(FIELD_RAD / 2, 6),
            "angle_increment": round(_INCREMENT, 6),
            "time_increment": round(turn_s * _INCREMENT / (2 * math.pi), 8),
            "scan_time": round(turn_s, 6),
            "range_min": RANGE_MIN_M,
            "range_max": RANGE_MAX_M,
            "ranges": ranges.round(3).tolist(),
        }


def look_around(lasers: Sequence[Laser], pose: Pose2D, scene: Scene) -> list[View]:
    """Return for each laser what a map lets expect and what its beams really meet."""
    believed = [laser.origin(pose, 0.0) for laser in lasers]
    turned = [laser for laser in lasers if laser.yaw_rad]
    true = [laser.origin(pose, laser.yaw_rad) for laser in turned]
    rows = iter(cast(scene, np.array(believed + true), BEAMS, RANGE_MAX_M))
    expected = [next(rows) for _ in lasers]
    pairs = zip(lasers, expected, strict=True)
    return [View(row, next(rows) if laser in turned else row) for laser, row in pairs]
