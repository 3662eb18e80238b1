"""Numbers, times and lists in words that anyone understands."""

from __future__ import annotations

import re
from collections.abc import Sequence

from amberbox.core.timetext import format_time

NS = 1_000_000_000

WORTH_TELLING = 0.005
"""From which probability on another possibility is told."""

MANY = ("no", "one", "two", "three", "four", "five", "six")


def duration(seconds: float) -> str:
    """Write how long something takes, in the unit that people would use."""
    if seconds < 90:
        return "1 min" if seconds == 60 else f"{seconds:.3g} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    hours = seconds / 3600
    return f"{hours:.0f} h" if hours >= 10 else f"{hours:.2g} h"


def later(seconds: float) -> str:
    """Say how long after the first something came."""
    if seconds <= 0:
        return "first"
    if seconds < 0.05:
        return "at once"
    if seconds < 120:
        return f"{seconds:.1f} s later"
    return f"{duration(seconds)} later"


def clock(time_ns: int) -> str:
    """Write the time of day, UTC."""
    return f"{format_time(time_ns)[11:19]} UTC"


def date_and_clock(time_ns: int) -> str:
    """Write date and time of day, UTC."""
    return f"{format_time(time_ns)[:10]} {clock(time_ns)}"


def readable(name: str) -> str:
    """Turn an id into words."""
    return re.sub(r"[_\s]+", " ", name).strip()


def sentence(text: str) -> str:
    """Begin with a capital letter and end with a full stop."""
    if not text:
        return ""
    return capital(text) + ("" if text[-1] in ".!?" else ".")


def capital(text: str) -> str:
    """Begin with a capital letter."""
    return text[:1].upper() + text[1:]


def both(texts: Sequence[str]) -> str:
    """Join what is there together."""
    if len(texts) < 3:
        return " and ".join(texts)
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def either(texts: Sequence[str], most: int = 3) -> str:
    """Join what may be instead of each other; beyond ``most`` only their number is told."""
    if len(texts) < 2:
        return "".join(texts)
    if len(texts) > most:
        return f"{'; '.join(texts[: most - 1])}; or {len(texts) - most + 1} more"
    return f"{'; '.join(texts[:-1])}; or {texts[-1]}"


def count(number: int) -> str:
    """Write a small number as a word."""
    return MANY[number] if number < len(MANY) else str(number)
