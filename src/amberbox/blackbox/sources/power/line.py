"""A UPS HAT's line or file: its content says external power, battery or low."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.sources.power.reading import (
    Reading,
    UnreadableError,
    read_number,
    read_text,
)
from amberbox.core.source import Power


@dataclass(frozen=True)
class Line:
    """A file whose words mean states, and files for what is left of the battery.

    A ``*`` in a path stands for the number that the kernel gives a device at each start.
    """

    path: str
    states: Mapping[str, Power]
    percent_path: str = ""
    voltage_path: str = ""
    voltage_scale: float = 1.0

    def read(self) -> Reading:
        """Read the files; raise UnreadableError if one is missing or says something else."""
        word = read_text(found(self.path))
        state = self.states.get(word.casefold())
        if state is None:
            known = ", ".join(self.states)
            raise UnreadableError(f"{self.path} says '{word[:20]}', which is none of {known}")
        percentage = _number(self.percent_path)
        return Reading(state, percentage, _number(self.voltage_path, self.voltage_scale))

    def close(self) -> None:
        """Nothing is kept open."""


def level_states(active: str, means: Power) -> Mapping[str, Power]:
    """Return what 0 and 1 mean on a line that is ``high`` or ``low`` when it says ``means``."""
    other: Power = "battery" if means == "mains" else "mains"
    return {"1": means, "0": other} if active == "high" else {"0": means, "1": other}


def found(pattern: str) -> Path:
    """Return the first file that fits a path with ``*``."""
    path = Path(pattern)
    if "*" not in pattern:
        return path
    fits = sorted(Path(path.anchor or ".").glob(str(path.relative_to(path.anchor))))
    if not fits:
        raise UnreadableError(f"nothing fits {pattern}")
    return fits[0]


def _number(pattern: str, scale: float = 1.0) -> float | None:
    return read_number(found(pattern), scale) if pattern else None
