"""Configuration of one supply, and the reader it makes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from amberbox.blackbox.sources.power.line import Line, level_states
from amberbox.blackbox.sources.power.nut import PORT, Nut
from amberbox.blackbox.sources.power.reading import Reading
from amberbox.blackbox.sources.power.sysfs import PLACE, Sysfs
from amberbox.core.options import option
from amberbox.core.source import Power


class Reader(Protocol):
    """Where readings of a supply come from."""

    def read(self) -> Reading:
        """Read once, within moments; raise UnreadableError if that cannot be."""

    def close(self) -> None:
        """Let go of what is open."""


@dataclass(frozen=True)
class Supply:
    """One supply of the box."""

    kind: Literal["sysfs", "nut", "gpio", "file"] = option("sysfs", "how it is read")
    name: str = option("", "its name in texts and items; the kind when absent")
    path: str = option("", "sysfs: folder of one supply or of all; gpio, file: the file to read")
    host: str = option("127.0.0.1", "nut: where upsd runs")
    port: int = option(PORT, "nut: its port")
    ups: str = option("", "nut: which UPS; the only one when absent")
    active: Literal["high", "low"] = option("high", "gpio: level of the line when it says so")
    means: Power = option("mains", "gpio: what the active line says")
    mains: Sequence[str] = option(("mains", "online"), "file: words for external power")
    battery: Sequence[str] = option(("battery",), "file: words for the box's own battery")
    low: Sequence[str] = option(("low",), "file: words for what is left of it")
    percent_path: str = option("", "gpio, file: file with the battery's percentage")
    voltage_path: str = option("", "gpio, file: file with the battery's voltage")
    voltage_scale: float = option(1.0, "volts per unit of that file; 0.001 for hwmon")
    low_percent: float = option(10.0, "on battery, this much or less is low", unit="%")
    low_voltage: float | None = option(None, "on battery, this many volts or less are low")

    @property
    def title(self) -> str:
        """Name for people and items."""
        return self.name or self.kind

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work; reads nothing."""
        if self.kind in ("gpio", "file") and not self.path:
            yield "path", f"is missing: the file that says how the box is powered ({self.kind})"
        if not 0 < self.port < 65536:
            yield "port", "must be between 1 and 65535"
        if not 0 <= self.low_percent < 100:
            yield "low_percent", "must be 0 or more and below 100"
        if self.low_voltage is not None and self.low_voltage <= 0:
            yield "low_voltage", "must be above 0"
        if len(self.ups.split()) > 1:
            yield "ups", "is one word"
        yield from self._check_words()

    def _check_words(self) -> Iterator[tuple[str, str]]:
        words = [word.casefold() for word in (*self.mains, *self.battery, *self.low)]
        twice = sorted({word for word in words if words.count(word) > 1})
        if self.kind == "file" and twice:
            yield "mains", f"'{twice[0]}' means two things"

    def in_folder(self, folder: Path) -> Supply:
        """Return the same with paths seen from a folder."""
        paths = (str(folder / path) if path else "" for path in self._paths())
        path, percent_path, voltage_path = paths
        return dataclasses.replace(
            self, path=path, percent_path=percent_path, voltage_path=voltage_path
        )

    def _paths(self) -> tuple[str, str, str]:
        return self.path, self.percent_path, self.voltage_path

    def reader(self) -> Reader:
        """Make what reads this supply; nothing is opened yet."""
        if self.kind == "sysfs":
            return Sysfs(Path(self.path or PLACE))
        if self.kind == "nut":
            return Nut(self.host, self.port, self.ups)
        states = level_states(self.active, self.means) if self.kind == "gpio" else self._words()
        voltage = (self.voltage_path, self.voltage_scale)
        return Line(self.path, states, self.percent_path, *voltage)

    def _words(self) -> dict[str, Power]:
        words: dict[str, Power] = {word.casefold(): "mains" for word in self.mains}
        words |= {word.casefold(): "battery" for word in self.battery}
        return words | {word.casefold(): "low" for word in self.low}

    def judged(self, reading: Reading) -> Reading:
        """Return the reading, ``low`` if little is left; with external power it never is."""
        return dataclasses.replace(reading, state="low") if self._is_low(reading) else reading

    def _is_low(self, reading: Reading) -> bool:
        percentage, voltage = reading.percentage, reading.voltage
        little = percentage is not None and percentage <= self.low_percent
        limit = self.low_voltage
        weak = voltage is not None and limit is not None and voltage <= limit
        return reading.state == "battery" and (little or weak)
