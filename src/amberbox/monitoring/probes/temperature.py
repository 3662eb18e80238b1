"""The temperature of a part of the computer, and whether it is critical."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from amberbox.core.errors import AmberboxError
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


class _TemperatureSensor(NamedTuple):
    """One temperature, and its critical value (None if not known)."""

    name: str
    celsius: float
    critical: float | None


def measure(subject: str) -> Measured:
    """Read the hottest sensor of the name; it is ok below its critical temperature."""
    return judge(list(sensors(Path("/sys/class"))), subject)


def judge(known: list[_TemperatureSensor], subject: str) -> Measured:
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


def sensors(root: Path) -> Iterator[_TemperatureSensor]:
    """Read every temperature below ``/sys/class``; unreadable ones are left out."""
    for zone in sorted(root.glob("thermal/thermal_zone*")):
        with suppress(OSError, ValueError):
            yield _TemperatureSensor(
                _text(zone / "type"), _celsius(zone / "temp"), _zone_critical(zone)
            )
    for file in sorted(root.glob("hwmon/hwmon*/temp*_input")):
        with suppress(OSError, ValueError):
            yield _hwmon(file)


def _hwmon(file: Path) -> _TemperatureSensor:
    stem = file.name.removesuffix("_input")
    label, critical = file.with_name(f"{stem}_label"), file.with_name(f"{stem}_crit")
    part = _text(label) if label.exists() else stem
    limit = _celsius(critical) if critical.exists() else None
    return _TemperatureSensor(
        f"{_text(file.parent / 'name')}/{part}", _celsius(file), _plausible(limit)
    )


def _zone_critical(zone: Path) -> float | None:
    for kind in sorted(zone.glob("trip_point_*_type")):
        if _text(kind) == "critical":
            limit = _celsius(kind.with_name(kind.name.replace("_type", "_temp")))
            return _plausible(limit)
    return None


def _plausible(limit: float | None) -> float | None:
    """Drop limits that drivers use for 'none' (0, -273, 65261 degrees)."""
    return limit if limit is not None and 0 < limit < 1000 else None


def _text(path: Path) -> str:
    return path.read_text(errors="replace").strip()


def _celsius(path: Path) -> float:
    return int(_text(path)) / 1000
