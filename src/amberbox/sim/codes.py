"""What the numbers mean that parts of the robot put their states into."""

from __future__ import annotations

from collections.abc import Mapping

STATUS_BITS: Mapping[int, str] = {
    0: "operational",
    1: "power stage on",
    2: "emergency stop pressed",
    3: "supply voltage low",
    4: "winding warm",
    5: "drive 1 at its current limit",
    6: "drive 2 at its current limit",
    7: "no setpoint",
}
"""Bits of a wheel unit's status."""

STATUS: Mapping[int, str] = {
    0: "off",
    1: "stage off",
    3: "on",
    5: "stopped",
    8: "brown-out",
    19: "warm",
    35: "limit 1",
    67: "limit 2",
    99: "limit 1+2",
    129: "no orders",
}
"""Names of the values that usually come of them, short enough for an axis of a plot."""

LOG_LEVELS: Mapping[int, str] = {
    10: "debug",
    20: "info",
    30: "warning",
    40: "error",
    50: "fatal",
}
