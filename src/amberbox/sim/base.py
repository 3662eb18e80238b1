"""The moving base: wheel units, a body on four of them, odometry, safety line, and the battery."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

from amberbox.sim.noise import Noise, Pose2D, clamp, pose_fields, wrap
from amberbox.sim.topics import CELLS, WHEELS

# sigma of what readings() returns, in its order
READING_NOISE = (0.0, 0.0, 0.03, *(4 * [0.04]), *(4 * [0.01]), 0.05)
TORQUE_PER_AMPERE = 0.5
VOLTS_PER_RATE = 0.55
RESISTANCE_OHM = 0.35
CURRENT_LIMIT_A = 8.0
ROOM_DEGC = 23.0
_FRICTION_NM = 0.1
_POLE_PAIRS = 15
_PROPORTIONAL_NM = 0.4
_INTEGRAL_NM = 1.2
_INTEGRAL_LEAK = 0.3  # per second; without it drives that disagree fight each other for ever
_COOLING_S = 600.0
_HEATING_K_PER_A2 = 0.01  # per second
_STANDBY_K_S = 0.008
_ENCODER_NOISE = 0.02
_THIRD = 2.0 * math.pi / 3.0
_DERATE_FROM_DEGC, _DERATE_TO_DEGC = 90.0, 120.0


class HubDrive:
    """A brushless motor with its wheel; turn rates are the wheel's, positive in its own sense.

    Knobs (nominal value): ``torque`` (1) share of the torque that current produces, ``phase_u``
    (1) conduction of phase U, ``drag_nm`` (0) extra friction, ``heat_k_s`` (0) extra heating,
    ``encoder_held`` (0) above 0.5 the encoder's registers stand still, ``encoder_noise`` (0)
    extra noise in rad/s, ``encoder_scale`` (1) share of the motion that the encoder counts.
    """

    def __init__(self, noise: Noise) -> None:
        self._noise = noise
        self.torque = 1.0
        self.phase_u = 1.0
        self.drag_nm = 0.0
        self.heat_k_s = 0.0
        self.encoder_held = 0.0
        self.encoder_noise = 0.0
        self.encoder_scale = 1.0
        self.rate = 0.0
        self.angle = noise.uniform(-3.0, 3.0)
        self.measured_rate = 0.0
        self.measured_angle = self.angle
        self.setpoint = 0.0
        self.current_a = 0.0
        self.temperature_degc = ROOM_DEGC + noise.uniform(4.0, 8.0)
        self.current_limit_a = CURRENT_LIMIT_A
        self._integral = 0.0

    def step(self, dt: float, setpoint: float, rate: float, powered: bool) -> float:
        """Advance by ``dt``; return the torque at the wheel, Nm."""
        self.rate, self.setpoint = rate, setpoint
        self.angle += rate * dt
        if self.encoder_held < 0.5:
            self.measured_rate = rate * self.encoder_scale + self._noise.normal(
                _ENCODER_NOISE + self.encoder_noise
            )
            self.measured_angle += rate * self.encoder_scale * dt
        self.current_a = self._control(dt, setpoint - self.measured_rate) if powered else 0.0
        if not powered:
            self._integral = 0.0
        friction = (_FRICTION_NM + self.drag_nm) * math.tanh(2.0 * rate)
        return self._motor_torque() - friction

    def warm(self, dt: float) -> None:
        """Let the winding warm up or cool down; the firmware takes current from a hot one."""
        cooling = (self.temperature_degc - ROOM_DEGC) / _COOLING_S
        heating = _HEATING_K_PER_A2 * self.current_a**2 + self.heat_k_s + _STANDBY_K_S
        self.temperature_degc += dt * (heating - cooling)
        over = (self.temperature_degc - _DERATE_FROM_DEGC) / (_DERATE_TO_DEGC - _DERATE_FROM_DEGC)
        self.current_limit_a = CURRENT_LIMIT_A * (1.0 - 0.8 * min(1.0, max(0.0, over)))

    @property
    def is_limited(self) -> bool:
        """Return whether the controller is at its current limit."""
        return abs(self.current_a) >= 0.99 * self.current_limit_a

    @property
    def voltage_v(self) -> float:
        """Return the voltage that drives the motor, V."""
        return VOLTS_PER_RATE * self.rate + RESISTANCE_OHM * self.current_a

    @property
    def power_w(self) -> float:
        """Return the electrical power drawn from the bus, W; negative while braking."""
        return self.voltage_v * self.current_a

    def readings(self) -> list[float]:
        """Return encoder, velocity, five currents, four voltages, temperature, without noise."""
        electrical = self.angle * _POLE_PAIRS
        amps, volts = self.current_a, self.voltage_v
        wave_u = math.sin(electrical)
        wave_v, wave_w = math.sin(electrical - _THIRD), math.sin(electrical + _THIRD)
        phases = [amps * wave_u * self.phase_u, amps * wave_v, amps * wave_w]
        voltages = [volts, volts * wave_u, volts * wave_v, volts * wave_w]
        return [
            self.measured_angle,
            self.measured_rate,
            0.0,
            amps,
            *phases,
            *voltages,
            self.temperature_degc,
        ]

    def _control(self, dt: float, error: float) -> float:
        limit_nm = self.current_limit_a * TORQUE_PER_AMPERE
        gain = _INTEGRAL_NM * error - _INTEGRAL_LEAK * self._integral
        self._integral = clamp(self._integral + dt * gain, limit_nm)
        return clamp(_PROPORTIONAL_NM * error + self._integral, limit_nm) / TORQUE_PER_AMPERE

    def _motor_torque(self) -> float:
        nominal = self.current_a * TORQUE_PER_AMPERE * self.torque
        if self.phase_u > 0.999:
            return nominal
        ripple = 0.5 + 0.5 * math.sin(2.0 * self.angle * _POLE_PAIRS)
        return nominal * (1.0 - (1.0 - self.phase_u) * ripple)


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
    """One of the four; ``x`` and ``y`` are the place of its pivot under the robot.

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
        self.is_braked = False
        self._turn_rate = 0.0
        self._spin = [0.0, 0.0]
        self._barometer = noise.normal(0.03)
        self._cycles = noise.integer(0, 65536)
        self._shake = (0.0, 0.0)
        self._yaw_rate = 0.0

    @property
    def measured_pivot_rad(self) -> float:
        """Return the pivot's angle as its encoder measures it, rad."""
        return wrap(self.pivot_rad + self.pivot_offset_rad)

    @property
    def power_w(self) -> float:
        """Return the electrical power of both drives, W."""
        return self.drive_1.power_w + self.drive_2.power_w

    def supply(self, dt: float, battery_v: float, e_stop: bool) -> None:
        """Apply the battery's voltage at the cable (V), and the emergency stop line."""
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
        moment = (push_2 - push_1) * WHEEL_DISTANCE_M / 2 + TRAIL_M * tyre
        self._turn_rate = clamp(self._turn_rate + moment / _PIVOT_INERTIA * dt, 30.0)
        self.pivot_rate = self._turn_rate - yaw_rate
        self.pivot_rad = wrap(self.pivot_rad + self.pivot_rate * dt)
        along = push_1 + push_2
        return along * cos + tyre * sin, along * sin - tyre * cos

    def motion(self) -> tuple[float, float, float]:
        """Return the inputs of odometry: both measured wheel rates and the measured pivot angle."""
        return self.drive_1.measured_rate, self.drive_2.measured_rate, self.measured_pivot_rad

    def feel(self, acceleration: tuple[float, float], yaw_rate: float) -> None:
        """Apply the body's motion to the unit's own small inertial sensor."""
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
        return [self.status(), self._cycles, *stamps], self.numbers(pressure_hpa)

    def numbers(self, pressure_hpa: float) -> list[float]:
        """Return the (noiseless) numbers of the sensor frame now; nothing in the unit changes."""
        pressure = pressure_hpa + self._barometer + self.pressure_offset_hpa
        inertial = [*self._shake, 9.81, 0.0, 0.0, self._yaw_rate, _IMU_DEGC]
        pivot = [self.measured_pivot_rad, self.pivot_rate]
        drives = self.drive_1.readings() + self.drive_2.readings()
        return [*drives, *pivot, self.voltage_v, *inertial, pressure]

    def _drive(self, dt: float, ahead: float, turn: float, rolling: float) -> tuple[float, float]:
        """Let both drives turn; return the forces that the floor takes from them."""
        radius = WHEEL_RADIUS_M * (1.0 - self.worn)
        side, wanted = _HALF_M * self._turn_rate, _HALF_M * turn
        rate_1 = (rolling - side) / radius + self._spin[0]
        rate_2 = (rolling + side) / radius + self._spin[1]
        wanted_1, wanted_2 = (ahead - wanted) / WHEEL_RADIUS_M, (ahead + wanted) / WHEEL_RADIUS_M
        powered = self.is_powered and not self.is_braked
        torque_1 = self.drive_1.step(dt, wanted_1, rate_1, powered)
        torque_2 = -self.drive_2.step(dt, -wanted_2, -rate_2, powered)
        push_1 = self._transmit(dt, 0, torque_1 / radius, radius)
        return push_1, self._transmit(dt, 1, torque_2 / radius, radius)

    def _transmit(self, dt: float, index: int, push: float, radius: float) -> float:
        """Pass a force to the floor; force beyond the grip spins the wheel."""
        limit = _GRIP * self.grip * 160.0
        passed = clamp(push, limit)
        spin = self._spin[index] + (push - passed) * radius / _WHEEL_INERTIA * dt
        keep = 0.5 if passed == push else 0.95
        creep = passed / (_TYRE_LONGITUDINAL * radius)
        self._spin[index] = keep * spin + (1.0 - keep) * creep
        return passed


CONTACT_M = 0.2


class SafetyLine:
    """Knobs (nominal value): ``stop_line`` (0) above 0.5 the line of the button is open,
    ``bumper`` (0) above 0.5 the front bumper's switch is closed."""

    def __init__(self) -> None:
        self.stop_line = 0.0
        self.bumper = 0.0
        self._touches_front = False
        self._touches_rear = False

    @property
    def is_stopped(self) -> bool:
        """Return whether the drives are cut off."""
        return self.stop_line > 0.5 or self.bumper > 0.5 or self.touches

    @property
    def touches(self) -> bool:
        """Return whether the robot really touches an obstacle."""
        return self._touches_front or self._touches_rear

    def feel(self, front_m: float, rear_m: float) -> None:
        """Set the distance of the nearest obstacle from each end of the robot, m."""
        self._touches_front = front_m < CONTACT_M
        self._touches_rear = rear_m < CONTACT_M

    def fields(self) -> dict[str, Any]:
        """Return the body of a ``safety`` message."""
        return {
            "e_stop_pressed": self.stop_line > 0.5,
            "bumper_front": self._touches_front or self.bumper > 0.5,
            "bumper_rear": self._touches_rear,
            "drives_enabled": not self.is_stopped,
        }


Twist = tuple[float, float, float]
Motion = tuple[float, float, float]
BODY_KG, CART_KG = 130.0, 80.0
_ROLLING_FRICTION = 0.015
_PLAUSIBLE_RATE = 60.0
_PIVOTS = {"front_left": (0.3, 0.2), "front_right": (0.3, -0.2)} | {
    "rear_left": (-0.3, 0.2),
    "rear_right": (-0.3, -0.2),
}
_BRAKE_N = 750.0  # of all wheels; the floor takes 900 N
_BRAKE_LEVER_M = 0.36
_LEVER2 = sum(x * x + y * y for x, y in _PIVOTS.values())


class MovingBase:
    """The body's true motion; none of its values is published directly.

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
        self.is_braked = False
        self._sway_phase = 0.0

    @property
    def power_w(self) -> float:
        """Return the electrical power of the eight drives, W."""
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

    def brake(self, is_closed: bool) -> None:
        """Close or open the brakes of the wheels; closed, the drives do not push."""
        self.is_braked = is_closed
        for unit in self.units.values():
            unit.is_braked = is_closed

    def halt(self) -> None:
        """Stop at once, as at a wall."""
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
        if self.is_braked:
            before_x, before_y, _ = self.twist
            self.twist = slower(
                self.twist, _BRAKE_N * dt / mass, _BRAKE_N * _BRAKE_LEVER_M * dt / inertia
            )
            accel_x += (self.twist[0] - before_x) / dt
            accel_y += (self.twist[1] - before_y) / dt
        self.acceleration = (accel_x, accel_y)
        for unit in self.units.values():
            unit.feel(self.acceleration, self.twist[2])

    def _sway(self, dt: float, vx: float) -> float:
        self._sway_phase += dt * 2 * math.pi * 1.7
        return self.sway_m_s2 * math.sin(self._sway_phase) * math.tanh(abs(vx) / 0.1)


def slower(twist: Twist, speed_loss: float, rate_loss: float) -> Twist:
    """Return a twist after a loss of speed (m/s) and of turn rate (rad/s); it never reverses."""
    vx, vy, yaw_rate = twist
    speed = math.hypot(vx, vy)
    keep = max(0.0, speed - speed_loss) / speed if speed > 0.0 else 0.0
    turn = max(0.0, abs(yaw_rate) - rate_loss)
    return vx * keep, vy * keep, math.copysign(turn, yaw_rate)


class Odometry:
    """Pose and twist as the base controller computes them from the fieldbus."""

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


CAPACITY_AH = 40.0
CHARGE_CURRENT_A = 15.0
BASE_LOAD_W = 65.0
_CELL_OHM = 0.004
_OPEN_VOLTS = ((0.0, 3.0), (0.1, 3.45), (0.5, 3.7), (0.9, 4.05), (1.0, 4.18))


def open_voltage(charge: float) -> float:
    """Return a cell's voltage without load, V, at a state of charge from 0 to 1."""
    for (low, low_v), (high, high_v) in pairwise(_OPEN_VOLTS):
        if charge <= high:
            return low_v + (high_v - low_v) * max(0.0, charge - low) / (high - low)
    return _OPEN_VOLTS[-1][1]


class BatteryPack:
    """Cells with charge and resistance; its gauge counts the current that its sensor shows.

    Knobs (nominal value): ``cell_ohm`` (0) extra resistance of one cell, ``leak_w`` (0) unwanted
    load, ``sensor_bias_a`` (0) error of the current sensor, ``contact`` (1) share of the charger's
    contact, ``heat_k_s`` (0) extra heating.
    """

    def __init__(self, charge: float, noise: Noise) -> None:
        self._noise = noise
        self.cell_ohm = 0.0
        self.leak_w = 0.0
        self.sensor_bias_a = 0.0
        self.contact = 1.0
        self.heat_k_s = 0.0
        self.charges = [charge + noise.normal(0.004) for _ in range(CELLS)]
        self._ohms = [_CELL_OHM * (1.0 + noise.normal(0.05)) for _ in range(CELLS)]
        self._poor_cell = noise.integer(0, CELLS)
        self.gauge = charge
        self.temperature_degc = 25.0 + noise.uniform(0.0, 3.0)
        self.current_a = 0.0
        self.charge_a = 0.0
        self.is_charging = False
        self.voltage_v = sum(self._cells())

    def step(self, dt: float, load_w: float, at_charger: bool) -> None:
        """Advance by ``dt`` with an electrical load."""
        draw_a = (load_w + BASE_LOAD_W + self.leak_w) / max(15.0, self.voltage_v)
        self.is_charging = at_charger and self.contact > 0.5
        self.charge_a = self._charge_current() * self.contact if self.is_charging else 0.0
        self.current_a = self.charge_a - draw_a
        moved = self.current_a * dt / 3600.0 / CAPACITY_AH
        self.charges = [min(1.0, max(0.0, charge + moved)) for charge in self.charges]
        bias = self.sensor_bias_a * dt / 3600.0 / CAPACITY_AH
        self.gauge = min(1.0, max(0.0, self.gauge + moved + bias))
        self.voltage_v = sum(self._cells())
        loss_w = self.current_a**2 * (sum(self._ohms) + self.cell_ohm)
        cooling = (self.temperature_degc - 24.0) / 3000.0
        self.temperature_degc += dt * (loss_w / 9000.0 + self.heat_k_s - cooling)

    def fields(self) -> dict[str, Any]:
        """Return the body of a ``battery`` message."""
        draw = self._noise.normal
        cells = [round(volts + draw(0.002), 3) for volts in self._cells()]
        charger = 29.3 * self.contact if self.is_charging else 0.0
        return {
            "voltage": round(sum(cells) + draw(0.01), 3),
            "current": round(self.current_a + self.sensor_bias_a + draw(0.05), 3),
            "percentage": round(100.0 * self.gauge, 2),
            "temperature": round(self.temperature_degc + draw(0.05), 2),
            "charging": self.is_charging,
            "charger_voltage": round(charger + abs(draw(0.02)), 3),
            "cell_voltage": cells,
        }

    def _charge_current(self) -> float:
        full = max(self.charges)
        return CHARGE_CURRENT_A * min(1.0, max(0.0, (1.0 - full) / 0.1))

    def _cells(self) -> list[float]:
        volts = [
            open_voltage(charge) + self.current_a * ohm
            for charge, ohm in zip(self.charges, self._ohms, strict=True)
        ]
        volts[self._poor_cell] += self.current_a * self.cell_ohm
        return volts
