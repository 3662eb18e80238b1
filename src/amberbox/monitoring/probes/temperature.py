"""The temperature of a part of the computer, and whether it is critical."""

from __future__ import annotations

from amberbox.core.errors import AmberboxError
from amberbox.core.host import TemperatureSensor, temperatures
from amberbox.core.probe import Measured

MEASURES = {
    "celsius": ("float", "degC", "the temperature"),
    "critical_celsius": ("float", "degC", "where the part protects itself; null if it is not said"),
    "sensor": ("string", "", "name of the sensor that was read"),
}
SUBJECT = (
    "name of a thermal zone or sensor, such as x86_pkg_temp, coretemp or coretemp/Core 0 "
    "(of several the hottest); hottest: of all"
)
PERIOD_S = 2.0


def measure(subject: str) -> Measured:
    """Read the hottest sensor of the name; it is ok below its critical temperature."""
    return judge(list(temperatures()), subject)


def judge(known: list[TemperatureSensor], subject: str) -> Measured:
    """Return the measurement of the hottest sensor of the name."""
    found = [
        sensor
        for sensor in known
        if subject in ("hottest", sensor.name, sensor.name.partition("/")[0])
    ]
    if not found:
        names = ", ".join(sorted({sensor.name for sensor in known}))
        raise AmberboxError(f"there is no temperature '{subject}'; known: {names or 'none'}")
    hottest = max(found, key=lambda sensor: sensor.celsius)
    critical = hottest.critical
    return {
        "ok": critical is None or hottest.celsius < critical,
        "celsius": hottest.celsius,
        "critical_celsius": critical,
        "sensor": hottest.name,
    }
