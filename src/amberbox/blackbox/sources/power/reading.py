"""What a supply says at one moment, and what several say together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.source import Power

WORST: dict[Power, int] = {"mains": 0, "battery": 1, "low": 2}
"""How bad each state is."""
_LONGEST_BYTES = 4096


class UnreadableError(Exception):
    """A supply does not say how the box is powered; the text is one line for a person."""


@dataclass(frozen=True, slots=True)
class Reading:
    """State of one supply; what it does not tell is None.

    ``percentage`` is 0 to 100, ``voltage`` in V, ``current`` in A with the supply's own sign.
    """

    state: Power
    percentage: float | None = None
    voltage: float | None = None
    current: float | None = None
    minutes_left: float | None = None

    def text(self) -> str:
        """Say what is known of the battery, as in ``87 %, 12.1 V, 23 min left``."""
        facts = ((self.percentage, "{:.0f} %"), (self.voltage, "{:.2f} V"))
        shown = [form.format(value) for value, form in facts if value is not None]
        if self.minutes_left is not None and self.state != "mains":
            shown.append(f"{self.minutes_left:.0f} min left")
        return ", ".join(shown)


def together(readings: Iterable[Reading]) -> Reading:
    """Combine supplies: the worst state, the least percentage and time, the worst one's rest."""
    found = sorted(readings, key=lambda reading: -WORST[reading.state])
    percentages = [r.percentage for r in found if r.percentage is not None]
    minutes = [r.minutes_left for r in found if r.minutes_left is not None]
    voltages = [(r.voltage, r.current) for r in found if r.voltage is not None]
    voltage, current = voltages[0] if voltages else (None, found[0].current)
    return Reading(
        found[0].state, min(percentages, default=None), voltage, current, min(minutes, default=None)
    )


def read_text(path: Path) -> str:
    """Read a small file; raise UnreadableError with the reason if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_LONGEST_BYTES).decode(errors="replace").strip("\0 \t\r\n")
    except OSError as error:
        raise UnreadableError(f"{path}: {error.strerror or error}") from None


def read_number(path: Path, scale: float = 1.0) -> float:
    """Read a number such as 11812000 (with scale 1e-6: 11.812)."""
    return number(read_text(path), str(path)) * scale


def number(text: str, where: str) -> float:
    """Read a finite number; raise UnreadableError for anything else."""
    try:
        value = float(text)
    except ValueError:
        raise UnreadableError(f"{where}: '{text[:20]}' is no number") from None
    if value - value != 0:  # infinities and not-a-number
        raise UnreadableError(f"{where}: '{text[:20]}' is no finite number")
    return value
