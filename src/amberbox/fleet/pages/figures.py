"""Numbers as people read them: sizes, counts, shares, how long something lasts."""

from __future__ import annotations

from amberbox.fleet.pages.strings import catalogue

_SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
_UNITS = ("B", "kB", "MB", "GB", "TB", "PB")


def size(number: float) -> str:
    """Write bytes with three digits at most: ``1.23 GB``, ``56 MB``."""
    value, unit = float(number), 0
    while value >= 999.5 and unit < len(_UNITS) - 1:
        value, unit = value / 1000, unit + 1
    digits = 0 if unit == 0 or value >= 99.5 else 1 if value >= 9.95 else 2
    text = f"{value:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text} {_UNITS[unit]}"


def count(number: int) -> str:
    """Write a count with its thousands apart: ``1,234,567``."""
    return f"{number:,}"


def percent(share: float) -> int:
    """Return percent of a share of something that is counted; 0 and 100 are none and all of it.

    How sure a diagnosis is stands in words of its own: ``core.sureness.percent``.
    """
    if share <= 0 or share >= 1:
        return 0 if share <= 0 else 100
    return min(99, max(1, round(100 * share)))


def span(seconds: float) -> str:
    """Write how long something lasts, in one unit: ``5 min``."""
    whole = max(0, int(seconds))
    unit, size = next((one for one in _SPANS if whole >= one[1]), _SPANS[-1])
    return catalogue().text(f"common.js.span.{unit}", n=whole // size)
