"""The clock of a robot that tests live with: right, or behind while its past is written down."""

from __future__ import annotations

import time
from dataclasses import dataclass

from amberbox.core.clock import NS

_UP_NS = 6 * 3600 * NS
"""How long the robot had been on when the tests began."""


@dataclass
class RobotClock:
    """Goes as real time does; ``ago_ns`` is how far in the past it stands."""

    boot: str
    ago_ns: int = 0

    def wall_ns(self) -> int:
        return time.time_ns() - self.ago_ns

    def boot_ns(self) -> int:
        return time.monotonic_ns() + _UP_NS - self.ago_ns

    def boot_id(self) -> str:
        return self.boot

    def synchronised(self) -> bool | None:
        return True
