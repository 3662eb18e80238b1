"""How values of outputs are written: numbers, yes and no, durations, with their units."""

from __future__ import annotations

from collections.abc import Mapping
from math import floor, isfinite, log10

from amberbox.fleet.pages import wording
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.state.views import Output

_UNITS: Mapping[str, str] = {
    "hz": "Hz", "s": "s", "ms": "ms", "us": "µs", "ns": "ns", "min": "min", "h": "h",
    "percent": "%", "volts": "V", "voltage": "V", "v": "V", "mv": "mV", "amps": "A", "a": "A",
    "ma": "mA", "watts": "W", "w": "W", "celsius": "°C", "degc": "°C", "m": "m", "mm": "mm",
    "cm": "cm", "rad": "rad", "deg": "°", "rpm": "rpm", "kb": "kB", "mb": "MB", "gb": "GB",
    "bytes": "B", "dbm": "dBm", "newton": "N", "nm": "Nm", "kg": "kg",
}  # fmt: skip
_TELLING = ("voltage", "newton")
"""What says more of an output than the unit behind its value does."""
_LONG_S = 120.0
"""From here on a duration is told in two units."""
_SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
_DIGITS = 4
_FOREVER_S = 1e9
DURATION = "duration"


def shown(output: Output) -> str:
    """Write a value: numbers with as many digits as tell something, yes and no."""
    value = output.value
    if isinstance(value, int | float) and value_type(output) == DURATION:
        return duration(value)
    if value is None:
        return catalogue().text("robot.js.value.none")
    if isinstance(value, bool):
        return catalogue().text(f"robot.js.value.{'yes' if value else 'no'}")
    return number(value) if isinstance(value, float) else str(value)


def number(value: float) -> str:
    """Write a number with four digits that count, of which none is dropped: widths stay."""
    size = abs(value)
    if not isfinite(value) or size >= 1e6 or 0 < size < 1e-3:
        return f"{value:.2e}"
    whole = floor(log10(size)) if size >= 1 else 0
    return f"{value:.{max(0, _DIGITS - 1 - whole)}f}"


def duration(seconds: float) -> str:
    """Write how long something takes: ``0.100 s``, ``13 h 51 min``, in two units from 2 min on."""
    if not _LONG_S <= abs(seconds) < _FOREVER_S:
        return f"{number(seconds)} s"
    whole = int(abs(seconds))
    place = next(n for n, (_, size) in enumerate(_SPANS) if whole >= size)
    most, size = _SPANS[place]
    smaller = [(name, whole % size // step) for name, step in _SPANS[place + 1 :][:1]]
    parts = [(most, whole // size), *smaller]
    text = " ".join(catalogue().text(f"common.js.span.{name}", n=n) for name, n in parts if n)
    return f"-{text}" if seconds < 0 else text


def unit(output: Output) -> str:
    """Return the unit behind a value: as declared, else guessed; a duration says it itself."""
    return "" if value_type(output) == DURATION else _unit(output)


def value_type(output: Output) -> str:
    """Return the type that a value is written as: numbers of seconds are durations."""
    return DURATION if _unit(output) == "s" else output.type


def label(output: Output) -> str:
    """Return the name of an output in words, without the unit that is shown behind its value."""
    rest, _, last = output.name.rpartition("_")
    said = _unit(output)
    is_said = said and said == guessed_unit(output.name) and last.casefold() not in _TELLING
    return wording.readable(rest if rest and is_said else output.name)


def guessed_unit(name: str) -> str:
    """Return the unit that a name ends with; empty where it names none, or one of a rate."""
    rest, _, last = name.casefold().rpartition("_")
    if rest.split("_")[-1] == "per":
        return ""
    return _UNITS.get(last, "") if "_" in name or len(last) > 3 else ""


def _unit(output: Output) -> str:
    if output.type not in ("int", "float"):
        return ""
    return output.unit or guessed_unit(output.name)
