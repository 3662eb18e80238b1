"""One hub drive of a wheel unit: encoder, velocity controller, motor, winding temperature."""

from __future__ import annotations

import math

from amberbox.sim.geometry import clamp
from amberbox.sim.noise import Noise

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
        """Whether the controller asks for all it may."""
        return abs(self.current_a) >= 0.99 * self.current_limit_a

    @property
    def voltage_v(self) -> float:
        """The voltage that drives the motor."""
        return VOLTS_PER_RATE * self.rate + RESISTANCE_OHM * self.current_a

    @property
    def power_w(self) -> float:
        """Electrical power drawn from the bus; negative while braking."""
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
