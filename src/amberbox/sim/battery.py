"""The battery: seven cells in series, their management, and the charger's contacts."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from amberbox.sim.noise import Noise
from amberbox.sim.topics import CELLS

CAPACITY_AH = 40.0
CHARGE_CURRENT_A = 15.0
BASE_LOAD_W = 65.0
_CELL_OHM = 0.004
_OPEN_VOLTS = ((0.0, 3.0), (0.1, 3.45), (0.5, 3.7), (0.9, 4.05), (1.0, 4.18))


def open_voltage(charge: float) -> float:
    """Return a cell's voltage without load at a state of charge from 0 to 1."""
    for (low, low_v), (high, high_v) in pairwise(_OPEN_VOLTS):
        if charge <= high:
            return low_v + (high_v - low_v) * max(0.0, charge - low) / (high - low)
    return _OPEN_VOLTS[-1][1]


class Battery:
    """Cells with charge and resistance; its gauge counts the current that its sensor shows.

    Knobs (nominal value): ``cell_ohm`` (0) extra resistance of one cell, ``leak_w`` (0) load
    that nobody switched on, ``sensor_bias_a`` (0) error of the current sensor, ``contact`` (1)
    share of the charger's contact, ``heat_k_s`` (0) extra heating.
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
        self.is_charging = False
        self.voltage_v = sum(self._cells())

    def step(self, dt: float, load_w: float, at_charger: bool) -> None:
        """Advance by ``dt`` with an electrical load."""
        draw_a = (load_w + BASE_LOAD_W + self.leak_w) / max(15.0, self.voltage_v)
        self.is_charging = at_charger and self.contact > 0.5
        charge_a = self._charge_current() * self.contact if self.is_charging else 0.0
        self.current_a = charge_a - draw_a
        moved = self.current_a * dt / 3600.0 / CAPACITY_AH
        self.charges = [min(1.0, max(0.0, charge + moved)) for charge in self.charges]
        bias = self.sensor_bias_a * dt / 3600.0 / CAPACITY_AH
        self.gauge = min(1.0, max(0.0, self.gauge + moved + bias))
        self.voltage_v = sum(self._cells())
        self._warm(dt)

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

    def _warm(self, dt: float) -> None:
        loss_w = self.current_a**2 * (sum(self._ohms) + self.cell_ohm)
        cooling = (self.temperature_degc - 24.0) / 3000.0
        self.temperature_degc += dt * (loss_w / 9000.0 + self.heat_k_s - cooling)
