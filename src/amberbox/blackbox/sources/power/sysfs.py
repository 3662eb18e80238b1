"""Power supplies that the kernel knows: batteries, adapters, UPS (/sys/class/power_supply)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from amberbox.blackbox.sources.power.reading import (
    Reading,
    UnreadableError,
    read_number,
    read_text,
)
from amberbox.core.source import Power

PLACE = "/sys/class/power_supply"
_STORES = ("Battery", "UPS")
_FED = ("Charging", "Full", "Not charging")
_MICRO = 1e-6


class Sysfs:
    """One supply's folder, or a folder of supplies that are looked at together."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> Reading:
        """Read adapters and batteries; raise UnreadableError if they do not tell the state."""
        folders = [self._path] if (self._path / "type").exists() else self._supplies()
        stores = [folder for folder in folders if _type(folder) in _STORES]
        adapters = [folder for folder in folders if folder not in stores]
        state = _state(adapters, stores, self._path)
        return Reading(state, *_battery(stores))

    def close(self) -> None:
        """Nothing is kept open."""

    def _supplies(self) -> list[Path]:
        """List what powers the box; batteries of mice and keyboards are none of it."""
        found = sorted(path.parent for path in self._path.glob("*/type"))
        found = [path for path in found if _word(path / "scope") != "Device"]
        if not found:
            raise UnreadableError(f"{self._path} holds no power supply")
        return found


def _state(adapters: Sequence[Path], stores: Sequence[Path], place: Path) -> Power:
    online = [
        value for value in (_number(path / "online") for path in adapters) if value is not None
    ]
    statuses = {_word(path / "status") for path in stores}
    if any(online) or "Charging" in statuses:
        return "mains"
    if not online and statuses.isdisjoint({"Discharging", *_FED}):
        raise UnreadableError(f"{place} does not tell whether there is external power")
    if not online and "Discharging" not in statuses:
        return "mains"
    critical = any(_word(path / "capacity_level") == "Critical" for path in stores)
    return "low" if critical else "battery"


def _battery(stores: Sequence[Path]) -> tuple[float | None, ...]:
    """Return percentage, voltage, current and minutes left; batteries are used one by one."""
    percentages = [value for value in map(_percentage, stores) if value is not None]
    minutes = [value for value in map(_minutes, stores) if value is not None]
    voltages = [_number(path / "voltage_now", _MICRO) for path in stores]
    currents = [_number(path / "current_now", _MICRO) for path in stores]
    return (
        fmean(percentages) if percentages else None,
        next((value for value in voltages if value is not None), None),
        next((value for value in currents if value is not None), None),
        max(minutes, default=None),
    )


def _percentage(store: Path) -> float | None:
    told = _number(store / "capacity")
    if told is None:
        told = _ratio(store, "energy_now", "energy_full")
        told = _ratio(store, "charge_now", "charge_full") if told is None else told
        told = told if told is None else 100 * told
    return told if told is None else min(max(told, 0.0), 100.0)  # fuel gauges tell up to 102


def _minutes(store: Path) -> float | None:
    seconds = _number(store / "time_to_empty_now") or _number(store / "time_to_empty_avg")
    if seconds is not None:
        return seconds / 60
    if _word(store / "status") != "Discharging":
        return None
    hours = _ratio(store, "energy_now", "power_now")
    hours = _ratio(store, "charge_now", "current_now") if hours is None else hours
    return hours if hours is None else abs(hours) * 60


def _ratio(store: Path, part: str, whole: str) -> float | None:
    above, below = _number(store / part), _number(store / whole)
    return None if above is None or not below else above / below


def _type(folder: Path) -> str:
    return _word(folder / "type")


def _word(path: Path) -> str:
    try:
        return read_text(path)
    except UnreadableError:  # each driver has other files, and some answer "no data" at times
        return ""


def _number(path: Path, scale: float = 1.0) -> float | None:
    try:
        return read_number(path, scale)
    except UnreadableError:
        return None
