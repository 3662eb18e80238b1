"""Which column of a table is the time, and in what unit it counts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation

import numpy as np

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timetext import any_time

ISO = "ISO 8601"
UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
RECEIVED, STAMP = "received", "timestamp"
_NAMES = (RECEIVED, STAMP, "time", "t", "stamp", "log_time", "datetime", "date_time", "date")
_UNIT = re.compile(
    r"(?<![ _\[(])[ _\[(]+(?:(ns|nsec|nanosec\w*)|(us|µs|usec|microsec\w*)|(ms|msec|millisec\w*)"
    r"|(s|secs?|seconds?))[\])]?",
    re.IGNORECASE,
)
_LIMITS = ((10**11, "s"), (10**14, "ms"), (10**17, "us"))
"""Seconds, milliseconds, microseconds by size: each covers the years 1973 to 5138."""
_ISO_TEXT = re.compile(r"\d{4}-\d{2}-\d{2}(?!\d).*")
_OURS = re.compile(r"(?:(?:19[789]\d|2[01]\d\d)-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d{1,9})?Z\n)*")
_LATEST_NS = 2**63 - 1
_LONG_AGO = 10**8


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """A column of times: which one, as text or as numbers, the unit if its name tells."""

    place: int
    name: str
    is_text: bool = False
    unit: str = ""


def choose(names: Sequence[str], wanted: str | None) -> tuple[TimeColumn, TimeColumn | None]:
    """Find the column of receipt, and that of own stamps if there are both.

    Raises UsageError when the wanted one is not there, or none looks like a time.
    """
    if wanted is not None:
        if wanted not in names:
            raise UsageError(f"there is no column {wanted!r}", _columns(names))
        return _column(names, wanted), None
    known = {_base(name): name for name in reversed(names)}
    found = [known[base] for base in _NAMES if base in known]
    if not found:
        raise UsageError(
            "no column looks like a time", f"--time COLUMN says which; {_columns(names)}"
        )
    both = [known[base] for base in (RECEIVED, STAMP) if base in known]
    stamp = _column(names, both[1]) if len(both) == 2 else None
    return _column(names, found[0]), stamp


def _columns(names: Sequence[str]) -> str:
    shown = ", ".join(names[:20])
    return f"the columns are {shown}" + (", ..." if len(names) > 20 else "")


def _column(names: Sequence[str], name: str) -> TimeColumn:
    return TimeColumn(names.index(name), name, unit=_unit_of(name))


def _base(name: str) -> str:
    lowered = name.casefold()
    match = _UNIT.search(lowered)
    return lowered[: match.start()] if match and match.end() == len(lowered) else lowered


def _unit_of(name: str) -> str:
    match = _UNIT.search(name)
    if match is None or match.end() != len(name):
        return ""
    return next(u for u, text in zip(("ns", "us", "ms", "s"), match.groups(), strict=True) if text)


def is_iso(cells: Sequence[str], name: str) -> bool:
    """Tell by the first cells whether times are text; raises AmberboxError if they are none."""
    for cell in cells:
        if _ISO_TEXT.fullmatch(cell.strip()):
            return True
        if _number(cell) is not None:
            return False
    raise AmberboxError(
        f"the column {name!r} holds no times",
        "times are ISO 8601, or numbers; --time COLUMN names another column",
    )


def read_cells(cells: Sequence[str], is_text: bool) -> list[Decimal | None]:
    """Read times: as nanoseconds where they are text, else as the numbers they are."""
    if not is_text:
        return [_number(cell) for cell in cells]
    quick = _quick_iso(cells)
    return quick if quick is not None else [_iso(cell) for cell in cells]


def _number(cell: str) -> Decimal | None:
    try:
        number = Decimal(cell.strip().replace(",", "."))
    except InvalidOperation:
        return None
    return number if number.is_finite() and abs(number) < 10**20 else None


def _quick_iso(cells: Sequence[str]) -> list[Decimal | None] | None:
    """Read times as we write them (``2026-11-21T14:00:00.5Z``) all at once."""
    if not _OURS.fullmatch("\n".join([*cells, ""])):
        return None
    try:
        times = np.array([cell[:-1] for cell in cells], "datetime64[ns]")
    except ValueError:
        return None
    return [Decimal(time_ns) for time_ns in times.astype(np.int64).tolist()]


def _iso(cell: str) -> Decimal | None:
    text = cell.strip()
    if not _ISO_TEXT.fullmatch(text):
        return None
    try:
        return Decimal(any_time(text, lambda: 0, lambda: None))
    except (UsageError, ValueError):
        return None


def unit_for(column: TimeColumn, largest: Decimal) -> str:
    """Say in what unit a column counts: by its name, else by the size of its numbers."""
    if column.is_text:
        return ISO
    return column.unit or next((unit for limit, unit in _LIMITS if largest < limit), "ns")


def in_ns(value: Decimal, unit: str) -> int:
    """Turn a time into nanoseconds, exactly."""
    return int(value if unit == ISO else value * UNITS_NS[unit])


def is_relative(largest_ns: int) -> bool:
    """Tell whether times cannot be dates: they would lie in the first years after 1970."""
    return largest_ns < _LONG_AGO * 10**9


def is_possible(time_ns: int) -> bool:
    """Tell whether a journal can hold a time."""
    return 0 <= time_ns <= _LATEST_NS
