"""A wheel unit: two hub drives side by side on a pivot, like a caster that steers itself."""

from __future__ import annotations

import math

from amberbox.sim.geometry import clamp, wrap
from amberbox.sim.hub_drive import READING_NOISE, HubDrive
from amberbox.sim.noise import Noise

WHEEL_RADIUS_M = 0.052
WHEEL_DISTANCE_M = 0.085
TRAIL_M = 0.03
MAX_PIVOT_RATE = 6.0
UNDERVOLTAGE_V = 21.0
_HALF_M = WHEEL_DISTANCE_M / 2
_IMU_DEGC = 34.0
SUPPLY_OHM = 0.05
_INERTIAL_NOISE = (*(3 * [0.08]), *(3 * [0.008]), 0.1)
# sigma of the numbers that readings() returns, in their order
SENSOR_NOISE = (*READING_NOISE, *READING_NOISE, 0.001, 0.03, 0.03, *_INERTIAL_NOISE, 0.01)
_GRIP = 0.7
_TYRE_LATERAL = 400.0  # N per m/s
_TYRE_LONGITUDINAL = 2500.0  # N per m/s
_PIVOT_INERTIA = 0.02
_WHEEL_INERTIA = 0.02
_WARM_DEGC = 80.0


class WheelUnit:
    """One of the four; ``x`` and ``y`` say where its pivot sits under the robot.

    Drive 2 is mounted mirrored: rolling ahead its rate is negative.
    Knobs (nominal value): ``grip`` (1) share of the friction with the floor, ``worn`` (0) share of
    the tyre radius that is gone, ``pivot_offset_rad`` (0) error of the pivot's zero,
    ``power`` (1) below 0.5 the power stage is off, ``connected`` (1) below 0.5 off the fieldbus,
    ``supply_drop_v`` (0) voltage lost on the way from the battery, ``pressure_offset_hpa`` (0).
    """

    def __init__(self, x: float, y: float, noise: Noise) -> None:
        self.x, self.y = x, y
        self._noise = noise
        self.drive_1 = HubDrive(noise)
        self.drive_2 = HubDrive(noise)
        self.grip = 1.0
        self.worn = 0.0
        self.pivot_offset_rad = 0.0
        self.power = 1.0
        self.connected = 1.0
        self.supply_drop_v = 0.0
        self.pressure_offset_hpa = 0.0
        self.pivot_rad = noise.normal(0.02)
        self.pivot_rate = 0.0
        self.voltage_v = 26.0
        self.is_powered = False
        self.has_setpoint = True
        self.e_stop = False
        self._turn_rate = 0.0
        self._spin = [0.0, 0.0]
        self._barometer = noise.normal(0.03)
        self._cycles = noise.integer(0, 65536)
        self._shake = (0.0, 0.0)
        self._yaw_rate = 0.0

    @property
    def measured_pivot_rad(self) -> float:
        """What the pivot's encoder says."""
        return wrap(self.pivot_rad + self.pivot_offset_rad)

    @property
    def power_w(self) -> float:
        """Electrical power that both drives draw."""
        return self.drive_1.power_w + self.drive_2.power_w

    def supply(self, dt: float, battery_v: float, e_stop: bool) -> None:
        """Take what the cable from the battery brings, and the emergency stop line."""
        self.drive_1.warm(dt)
        self.drive_2.warm(dt)
        drop = SUPPLY_OHM * self.power_w / max(self.voltage_v, 10.0)
        self.voltage_v = max(0.0, battery_v - drop - self.supply_drop_v)
        self.e_stop = e_stop
        self.has_setpoint = self.connected > 0.5
        brown_out = self.voltage_v < UNDERVOLTAGE_V
        self.is_powered = self.power > 0.5 and self.has_setpoint and not (e_stop or brown_out)

    def step(
        self,
        dt: float,
        command: tuple[float, float],
        velocity: tuple[float, float],
        yaw_rate: float,
    ) -> tuple[float, float]:
        """Advance by ``dt``; return the force on the body (N, body frame).

        ``command`` and ``velocity`` are the wanted and the true velocity of the pivot point.
        """
        angle = self.measured_pivot_rad
        cos, sin = math.cos(angle), math.sin(angle)
        ahead = command[0] * cos + command[1] * sin
        turn = clamp((command[1] * cos - command[0] * sin) / TRAIL_M, MAX_PIVOT_RATE)
        cos, sin = math.cos(self.pivot_rad), math.sin(self.pivot_rad)
        rolling = velocity[0] * cos + velocity[1] * sin
        sideways = velocity[1] * cos - velocity[0] * sin
        push_1, push_2 = self._drive(dt, ahead, turn, rolling)
        tyre = _TYRE_LATERAL * max(0.1, self.grip) * (sideways - TRAIL_M * self._turn_rate)
        self._steer(dt, push_1, push_2, tyre, yaw_rate)
        along = push_1 + push_2
        return along * cos + tyre * sin, along * sin - tyre * cos

    def motion(self) -> tuple[float, float, float]:
        """Return what odometry needs: both measured wheel rates and the measured pivot angle."""
        return self.drive_1.measured_rate, self.drive_2.measured_rate, self.measured_pivot_rad

    def feel(self, acceleration: tuple[float, float], yaw_rate: float) -> None:
        """Take the body's motion for the unit's own small inertial sensor."""
        self._shake = acceleration
        self._yaw_rate = yaw_rate

    def status(self) -> int:
        """Return the status word (see ``codes.STATUS_BITS``)."""
        warm = max(self.drive_1.temperature_degc, self.drive_2.temperature_degc) > _WARM_DEGC
        bits = (
            self.power > 0.5 and not self.voltage_v < UNDERVOLTAGE_V,
            self.is_powered,
            self.e_stop,
            self.voltage_v < UNDERVOLTAGE_V,
            warm,
            self.drive_1.is_limited,
            self.drive_2.is_limited,
            not self.has_setpoint,
        )
        return sum(1 << bit for bit, is_set in enumerate(bits) if is_set)

    def readings(self, time_us: int, pressure_hpa: float) -> tuple[list[int], list[float]]:
        """Return the integers and the (noiseless) numbers of the sensor frame, as in its schema.

        Integers: status1, status2, sensor_ts, setpoint_ts, imu_ts.
        """
        self._cycles = (self._cycles + 50) % 65536
        late = self._noise.integer(0, 200)
        stamps = [time_us - 1000 - late, time_us - 2000 - late, time_us - 1500 - late]
        pressure = pressure_hpa + self._barometer + self.pressure_offset_hpa
        inertial = [*self._shake, 9.81, 0.0, 0.0, self._yaw_rate, _IMU_DEGC]
        pivot = [self.measured_pivot_rad, self.pivot_rate]
        drives = self.drive_1.readings() + self.drive_2.readings()
        numbers = [*drives, *pivot, self.voltage_v, *inertial, pressure]
        return [self.status(), self._cycles, *stamps], numbers

    def _drive(self, dt: float, ahead: float, turn: float, rolling: float) -> tuple[float, float]:
        """Let both drives turn; return the forces that the floor takes from them."""
        radius = WHEEL_RADIUS_M * (1.0 - self.worn)
        side, wanted = _HALF_M * self._turn_rate, _HALF_M * turn
        rate_1 = (rolling - side) / radius + self._spin[0]
        rate_2 = (rolling + side) / radius + self._spin[1]
        wanted_1, wanted_2 = (ahead - wanted) / WHEEL_RADIUS_M, (ahead + wanted) / WHEEL_RADIUS_M
        torque_1 = self.drive_1.step(dt, wanted_1, rate_1, self.is_powered)
        torque_2 = -self.drive_2.step(dt, -wanted_2, -rate_2, self.is_powered)
        push_1 = self._transmit(dt, 0, torque_1 / radius, radius)
        return push_1, self._transmit(dt, 1, torque_2 / radius, radius)

    def _transmit(self, dt: float, index: int, push: float, radius: float) -> float:
        """Pass a force to the floor; what the floor does not take spins the wheel."""
        limit = _GRIP * self.grip * 160.0
        passed = clamp(push, limit)
        spin = self._spin[index] + (push - passed) * radius / _WHEEL_INERTIA * dt
        keep = 0.5 if passed == push else 0.95
        creep = passed / (_TYRE_LONGITUDINAL * radius)
        self._spin[index] = keep * spin + (1.0 - keep) * creep
        return passed

    def _steer(self, dt: float, push_1: float, push_2: float, tyre: float, yaw: float) -> None:
        moment = (push_2 - push_1) * WHEEL_DISTANCE_M / 2 + TRAIL_M * tyre
        self._turn_rate = clamp(self._turn_rate + moment / _PIVOT_INERTIA * dt, 30.0)
        self.pivot_rate = self._turn_rate - yaw
        self.pivot_rad = wrap(self.pivot_rad + self.pivot_rate * dt)
