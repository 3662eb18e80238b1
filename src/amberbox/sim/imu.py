"""The inertial sensor in the middle of the base."""

from __future__ import annotations

import math
from typing import Any

from amberbox.sim.geometry import turn_fields, wrap, xyz_fields
from amberbox.sim.noise import Noise


class Imu:
    """Measures acceleration and turn rate; integrates a heading that drifts.

    Knobs (nominal value): ``gyro_bias`` (0, rad/s), ``accel_bias`` (0, m/s2), ``held`` (0) above
    0.5 the registers stand still, ``mount_shake`` (0) how much the mount rattles while moving.
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
