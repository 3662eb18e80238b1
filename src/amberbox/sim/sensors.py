"""Sensors of the simulated robot: inertial sensor, laser scanners, and the wireless link.

Laser beams are cast into the world. Reception depends on access points, walls and the elevator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amberbox.sim.noise import Noise, Pose2D, turn_fields, wrap, xyz_fields
from amberbox.sim.world import CIRCLE, LaserScene, cast


class Imu:
    """Measures acceleration and turn rate; integrates a heading that drifts.

    Knobs (nominal value): ``gyro_bias`` (0, rad/s), ``accel_bias`` (0, m/s2), ``held`` (0) above
    0.5 the registers are stuck, ``mount_shake`` (0) how much the mount rattles while moving.
    """

    def __init__(self, yaw: float, noise: Noise) -> None:
        self._noise = noise
        self.gyro_bias = 0.0
        self.accel_bias = 0.0
        self.held = 0.0
        self.mount_shake = 0.0
        self._own_bias = noise.normal(0.0005)
        self._yaw = yaw
        self._fields: dict[str, Any] = {}

    def read(
        self, dt: float, speed: float, yaw_rate: float, acceleration: tuple[float, float]
    ) -> dict[str, Any]:
        """Return the body of an ``imu`` message."""
        draw = self._noise.normal
        shake = (0.15 + 4.0 * self.mount_shake) * math.tanh(abs(speed) / 0.3)
        rate = yaw_rate + self.gyro_bias + self._own_bias + draw(0.003 + 0.02 * self.mount_shake)
        values = (
            acceleration[0] + self.accel_bias + draw(0.04 + shake),
            acceleration[1] + yaw_rate * speed + draw(0.04 + shake),
            9.81 + draw(0.04 + 1.5 * shake),
        )
        self._yaw = wrap(self._yaw + rate * dt)
        if self.held < 0.5 or not self._fields:
            self._fields = {
                "orientation": turn_fields(self._yaw),
                "angular_velocity": xyz_fields(draw(0.003), draw(0.003), rate),
                "linear_acceleration": xyz_fields(*values),
                "temperature": round(31.0 + draw(0.05), 2),
            }
        return self._fields


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
    """A scan with its own stamp (ns of true time), as delivered to the software."""

    stamp_ns: int
    ranges: NDArray[np.float64]
    fields: dict[str, Any]
    agreement: float
    """Share of beams that a map would explain."""


class LaserView(NamedTuple):
    """Distances around a laser: along the beams at its nominal mount, and at its true mount."""

    expected: NDArray[np.float64]
    true: NDArray[np.float64]


class Laser:
    """One scanner, ``offset_m`` ahead of the robot's centre, facing ``facing_rad``.

    Knobs (nominal value): ``cover_deg`` (0) width of a covered sector of the window, ``dirt`` (0)
    share of light lost, ``held`` (0) above 0.5 the driver delivers its last scan again, ``quiet``
    (0) above 0.5 there is no scan, ``yaw_rad`` (0) rotation of the mount, ``spin_loss`` (0) share
    of the motor's speed lost.
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

    def turn(self, view: LaserView, now_ns: int, has_cart: bool) -> None:
        """Turn the mirror for 0.1 s; this may complete a scan."""
        self._turns += 1.0 - min(0.95, self.spin_loss)
        if self._turns < 0.999:
            return
        self._turns -= 1.0
        if self.quiet > 0.5:
            return
        if self.held < 0.5 or self.last is None:
            ranges = self._receive(view.true, has_cart)
            off = np.abs(ranges - view.expected) > 0.15 + 0.02 * view.expected
            agreement = (BEAMS - int(np.count_nonzero(off))) / BEAMS / (0.74 if has_cart else 1.0)
            self.last = Scan(now_ns - 15_000_000, ranges, self._fields(ranges), min(1.0, agreement))
        self._fresh = self.last

    def take(self) -> Scan | None:
        """Return the new scan since the last call, if any."""
        scan, self._fresh = self._fresh, None
        return scan

    def agreement(self, now_ns: int) -> float:
        """Return the share of the newest scan that the map explains; 0 when the scan is old."""
        if self.last is None or now_ns - self.last.stamp_ns > 600_000_000:
            return 0.0
        return self.last.agreement

    def origin(self, pose: Pose2D, mount_yaw: float) -> tuple[float, float, float]:
        """Return where the beams start and the angle of the first one, for ``cast``."""
        x = pose.x + self._offset_m * math.cos(pose.yaw)
        y = pose.y + self._offset_m * math.sin(pose.yaw)
        return x, y, pose.yaw + self._facing_rad + mount_yaw - FIELD_RAD / 2

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


def cast_views(lasers: Sequence[Laser], pose: Pose2D, scene: LaserScene) -> list[LaserView]:
    """Return for each laser the distances expected from the map and the true ones."""
    believed = [laser.origin(pose, 0.0) for laser in lasers]
    turned = [laser for laser in lasers if laser.yaw_rad]
    true = [laser.origin(pose, laser.yaw_rad) for laser in turned]
    rows = iter(cast(scene, np.array(believed + true), BEAMS, RANGE_MAX_M))
    expected = [next(rows) for _ in lasers]
    pairs = zip(lasers, expected, strict=True)
    return [LaserView(row, next(rows) if laser in turned else row) for laser, row in pairs]


_ACCESS_POINTS = {"ap-ward-a": (9.0, 2.8), "ap-ward-b": (24.0, 2.8), "ap-kitchen": (38.0, 2.8)}
_LOST_BELOW_DBM = -88.0


class Wifi:
    """Signal strength by distance to the access point in use; roams when another is stronger.

    Knobs (nominal value): ``loss_db`` (0) extra damping, ``down`` (0) above 0.5 no access point
    answers, ``queue_ms`` (0) waiting time in the network behind it.
    """

    def __init__(self, noise: Noise) -> None:
        self._noise = noise
        self.loss_db = 0.0
        self.down = 0.0
        self.queue_ms = 0.0
        self._access_point = ""
        self._retries = 0
        self._fading = 0.0

    def fields(self, x: float, y: float, in_elevator: bool) -> dict[str, Any]:
        """Return the body of a ``wifi`` message."""
        self._fading = 0.8 * self._fading + self._noise.normal(1.2)
        signal = self._roam(x, y) + self._fading - self.loss_db - (22.0 if in_elevator else 0.0)
        retry_noise = abs(self._noise.normal(1.0))
        latency_noise = abs(self._noise.normal(1.0))
        if self.down > 0.5 or signal < _LOST_BELOW_DBM:
            return self._lost()
        poor = max(0.0, -65.0 - signal)
        self._retries += round(retry_noise * (1.0 + 0.6 * poor))
        latency = 3.0 + self.queue_ms + latency_noise * (2.0 + 0.8 * poor + 0.4 * self.queue_ms)
        return {
            "connected": True,
            "access_point": self._access_point,
            "signal_dbm": round(signal, 1),
            "quality": round(max(0.0, min(100.0, 2.0 * (signal + 95.0))), 1),
            "bit_rate": round(max(6.0, 144.0 - 4.0 * poor), 1),
            "latency": round(latency, 2),
            "retries": self._retries,
        }

    def _roam(self, x: float, y: float) -> float:
        strengths = {
            name: -38.0 - 24.0 * math.log10(max(1.0, math.dist((x, y), place)))
            for name, place in _ACCESS_POINTS.items()
        }
        best = max(strengths, key=lambda name: strengths[name])
        if strengths[best] > strengths.get(self._access_point, -200.0) + 4.0:
            self._access_point = best
        return strengths[self._access_point]

    def _lost(self) -> dict[str, Any]:
        return {
            "connected": False,
            "access_point": "",
            "signal_dbm": -100.0,
            "quality": 0.0,
            "bit_rate": 0.0,
            "latency": 0.0,
            "retries": self._retries,
        }
