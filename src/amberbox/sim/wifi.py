"""The wireless link: access points along the corridor, walls, and an elevator of steel."""

from __future__ import annotations

import math
from typing import Any

from amberbox.sim.noise import Noise

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
