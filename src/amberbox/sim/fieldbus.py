"""The fieldbus: cycles at 1 kHz, a working counter, and four wheel units as its devices."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from amberbox.sim.base import CURRENT_LIMIT_A, SENSOR_NOISE, Motion, WheelUnit
from amberbox.sim.noise import Noise
from amberbox.sim.topics import TOPIC_BY_NAME

CYCLES_PER_S = 1000
COUNTS_PER_DEVICE = 3  # a device that reads and writes adds 3 to an LRW datagram
_SENSORS = TOPIC_BY_NAME["wheels"].body["properties"]["sensors"]["properties"]["front_left"]
_SENSOR_FIELDS = {name: shape["type"] for name, shape in _SENSORS["properties"].items()}
_BEFORE = list(_SENSOR_FIELDS).index("imu_ts") - 4  # numbers that stand before imu_ts
_SIGMA = np.array(SENSOR_NOISE)
_NOMINAL_DIP = 0.0004  # share of samples with a low counter although nothing is wrong
_ODD_SAMPLES = 0.12  # share of samples of a lost device that hold arbitrary memory


class Fieldbus:
    """Transfers the units' frames to the computer; the last data of a lost device stay in memory.

    Knobs (nominal value): ``frame_loss`` (0) share of cycles that do not come back,
    ``cycle_jitter_us`` (0) extra jitter of the cycle time.
    """

    def __init__(self, units: dict[str, WheelUnit], noise: Noise) -> None:
        self._units = units
        self._noise = noise
        self.frame_loss = 0.0
        self.cycle_jitter_us = 0.0
        self._cycles = 0.0
        self._lost = 0
        self._low = 0
        self._counter = self._expected
        self._frames: dict[str, dict[str, float]] = {}  # the last good frame of each unit
        self._motions = {name: unit.motion() for name, unit in units.items()}

    @property
    def _expected(self) -> int:
        return COUNTS_PER_DEVICE * len(self._units)

    def step(self, dt: float) -> dict[str, Motion]:
        """Run the cycles of ``dt`` seconds; return the motion of each unit as received."""
        cycles = dt * CYCLES_PER_S
        self._cycles += cycles
        present = [name for name, unit in self._units.items() if unit.connected > 0.5]
        answers = COUNTS_PER_DEVICE * len(present)
        lost = self._lose(cycles)
        self._counter = 0 if lost and self._noise.uniform() < self.frame_loss else answers
        if self._noise.uniform() < _NOMINAL_DIP:
            self._counter = max(0, answers - COUNTS_PER_DEVICE)
        self._low += int(cycles) if answers < self._expected else lost
        if self._counter:
            self._motions.update({name: self._units[name].motion() for name in present})
        return self._motions

    def wheels(self, time_us: int, pressure_hpa: float) -> dict[str, Any]:
        """Return the body of a ``wheels`` message."""
        readings = [unit.readings(time_us, pressure_hpa) for unit in self._units.values()]
        exact = np.array([numbers for _, numbers in readings])
        noisy = exact + self._noise.normals(exact.size, 1.0).reshape(exact.shape) * _SIGMA
        rows = noisy.round(4).tolist()
        sensors = {
            name: self._receive(name, unit, integers, row)
            for (name, unit), (integers, _), row in zip(
                self._units.items(), readings, rows, strict=True
            )
        }
        commands = {name: command_fields(unit) for name, unit in self._units.items()}
        return {"commands": commands, "sensors": sensors}

    def counters(self) -> dict[str, Any]:
        """Return the body of a ``bus`` message."""
        sigma = 4.0 + self.cycle_jitter_us
        mean = 1000.0 + self._noise.normal(sigma / 7)
        peak = mean + 12.0 + abs(self._noise.normal(sigma)) * 2.0
        return {
            "cycle": round(self._cycles),
            "working_counter": self._counter,
            "expected_working_counter": self._expected,
            "low_counter_cycles": self._low,
            "lost_frames": self._lost,
            "devices_operational": sum(u.connected > 0.5 for u in self._units.values()),
            "cycle_time_mean_us": round(mean, 2),
            "cycle_time_max_us": round(peak, 1),
        }

    def _lose(self, cycles: float) -> int:
        if self.frame_loss <= 0.0:
            return 0
        expected = cycles * self.frame_loss
        lost = max(0, round(expected + self._noise.normal(expected**0.5)))
        self._lost += lost
        return lost

    def _receive(
        self, name: str, unit: WheelUnit, integers: list[int], numbers: list[float]
    ) -> dict[str, float]:
        """Take a unit's frame; of a lost device the last one stays, or arbitrary memory."""
        is_present = unit.connected > 0.5
        if name not in self._frames or (is_present and self._counter):
            values = integers[:4] + numbers[:_BEFORE] + integers[4:] + numbers[_BEFORE:]
            self._frames[name] = dict(zip(_SENSOR_FIELDS, values, strict=True))
        if is_present or self._noise.uniform() >= _ODD_SAMPLES:
            return self._frames[name]
        odd = {field: self._arbitrary(field) for field in _SENSOR_FIELDS}
        self._motions[name] = (odd["velocity_1"], odd["velocity_2"], odd["encoder_pivot"])
        return odd

    def _arbitrary(self, field: str) -> float:
        bits = self._noise.integer(0, 2**32)
        if _SENSOR_FIELDS[field] == "integer":
            return bits % 65536 if field.startswith("status") else bits
        value: float = struct.unpack("<f", struct.pack("<I", bits & 0xFEFF_FFFF))[0]
        return value if value == value and abs(value) < 1e38 else 1e38


def command_fields(unit: WheelUnit) -> dict[str, float]:
    """Return what the computer tells a unit."""
    return {
        "command1": 3,
        "command2": 0,
        "setpoint1": round(unit.drive_1.setpoint, 4),
        "setpoint2": round(unit.drive_2.setpoint, 4),
        "limit1_p": CURRENT_LIMIT_A,
        "limit1_n": -CURRENT_LIMIT_A,
        "limit2_p": CURRENT_LIMIT_A,
        "limit2_n": -CURRENT_LIMIT_A,
    }
