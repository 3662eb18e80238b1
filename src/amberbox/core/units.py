"""Quantities as people write and read them: ``5s``, ``64 MB``, ``2 kHz``, probabilities."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction

from amberbox.core.errors import UsageError

# nanoseconds; there is no ``m``, which might be a metre
TIME_NS: Mapping[str, int] = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": 1_000_000_000,
    "min": 60_000_000_000,
    "h": 3_600_000_000_000,
    "d": 86_400_000_000_000,
}

PER_SECOND = "1/s"
"""Unit of a change per second of anything."""

_BYTES: Mapping[str, int] = {
    **{"B": 1, "kB": 10**3, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12},
    **{"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40},
}
_FREQUENCY: Mapping[str, int] = {"Hz": 1, "kHz": 1_000}
_SHARE: Mapping[str, int] = {"%": 1}
_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]*|%)")


def known_units(unit: str) -> Mapping[str, int]:
    """Return the units that can be converted to ``unit`` with their sizes; empty for none."""
    return next((table for table in (TIME_NS, _BYTES, _FREQUENCY, _SHARE) if unit in table), {})


def in_unit(text: str, unit: str) -> Fraction:
    """Convert a quantity such as ``10 min`` to ``unit`` exactly; a bare number is in ``unit``.

    Raises ValueError with a sentence for the person who wrote it.
    """
    match = _QUANTITY.fullmatch(text.strip())
    if match is None:
        raise ValueError("is not a number")
    number, written = Fraction(match[1]), match[2]
    if not written or written == unit:
        return number
    units = known_units(unit)
    if written not in units:
        raise ValueError(_unknown_unit(written, units))
    return number * units[written] / units[unit]


def per_second(unit: str) -> str:
    """Return the unit of a change per second: ``m/s^2`` for ``m/s``."""
    return f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"


def is_same_unit(one: str, other: str) -> bool:
    """Return whether two units are the same; ``m/s^2`` is also written ``m/s2`` and ``m/s²``."""
    return _spelt(one) == _spelt(other)


def _spelt(unit: str) -> str:
    spelt = "".join(unit.split()).replace("²", "^2").replace("/s/s", "/s^2")
    return re.sub(r"/s2$", "/s^2", spelt)


def duration_ns(number: str, unit: str) -> int:
    """Convert ``("5", "s")`` to nanoseconds."""
    return round(in_unit(f"{number} {unit}", "ns"))


def parse_duration_s(text: str) -> float:
    """Read a duration such as ``30s`` or ``5 min``, a bare number in seconds.

    Raises UsageError for anything else, and for a duration below 0.
    """
    try:
        seconds = float(in_unit(text, "s"))
    except ValueError as error:
        raise UsageError(f"'{text}' {error}", "write a duration as 30s or 5 min") from None
    if seconds < 0:
        raise UsageError(f"'{text}' lies below 0", "write a duration as 30s or 5 min")
    return seconds


def bytes_text(count: float) -> str:
    """Write a number of bytes for a person."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def _unknown_unit(written: str, units: Mapping[str, int]) -> str:
    if not units:
        return f"has a unit '{written}' where a plain number is expected"
    return f"has the unknown unit '{written}'; use one of {', '.join(units)}"


# least probability of each word
CONFIDENCE_WORDS: tuple[tuple[float, str], ...] = (
    (0.95, "almost certain"),
    (0.80, "very likely"),
    (0.50, "likely"),
    (0.20, "possible"),
    (0.0, "only a guess"),
)
LIKELY = 0.5  # least probability of a likely cause: more probable than not


def confidence_word(probability: float) -> str:
    """Return a probability in words."""
    return next(word for least, word in CONFIDENCE_WORDS if probability >= least)


def percent(probability: float) -> str:
    """Write a probability in whole percent; a probability below 1 is never 100 %, one above 0 never
    0.
    """
    if probability >= 0.995:
        return "over 99 %"
    return "under 1 %" if probability < 0.005 else f"{probability:.0%}".replace("%", " %")
