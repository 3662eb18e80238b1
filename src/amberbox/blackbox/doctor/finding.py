"""What a check found: its level, the facts, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warn", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's report; ``found`` holds the facts, ``hint`` the next step."""

    check: str
    level: Level
    found: str
    hint: str = ""


def ok(check: str, found: str, hint: str = "") -> Finding:
    """All is well; a hint says what could be better still."""
    return Finding(check, "ok", found, hint)


def warn(check: str, found: str, hint: str) -> Finding:
    """It records, but something may be lost or worn out one day."""
    return Finding(check, "warn", found, hint)


def error(check: str, found: str, hint: str) -> Finding:
    """It does not record, or not what it promises."""
    return Finding(check, "error", found, hint)


def in_time(seconds: float) -> str:
    """Write a duration for a person."""
    for limit, size, unit in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / size:.0f} {unit}"
    days = seconds / 86_400
    return f"{days:,.0f} days" if days < 730 else f"{days / 365:,.0f} years"
