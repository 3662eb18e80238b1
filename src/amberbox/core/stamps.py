"""A message's own time stamp as its sender wrote it: numbers of any unit, text, ROS pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from amberbox.core.errors import UsageError
from amberbox.core.timetext import parse_time

_NS = 1_000_000_000
_UNITS = ((10**11, _NS), (10**14, 10**6), (10**17, 10**3))
_FIRST_NS = 10**17
_LATEST_NS = 2**63 - 1
_PAIRS = (("secs", "nsecs"), ("sec", "nanosec"), ("sec", "nsec"))


def stamp_of(value: Any) -> int:
    """Read a stamp from a decoded value; nanoseconds since the epoch, 0 if it is none.

    Numbers are seconds, milliseconds, microseconds or nanoseconds by their size (each covers the
    years 1973 to 5138); text is RFC 3339; ``{secs, nsecs}`` and ``{sec, nanosec}`` are ROS times.
    A number or a text before 1973 is a count, a time of day or a time since the start of
    something. ROS times say what they are: those of a simulation begin at 0.
    """
    stamp_ns = time_of(value)
    return stamp_ns if isinstance(value, Mapping) or stamp_ns >= _FIRST_NS else 0


def time_of(value: Any) -> int:
    """Read a value that is known to be a time as ``stamp_of`` does, of any year from 1970 on."""
    if isinstance(value, bool) or value is None:
        return 0
    if isinstance(value, int | float):
        return _number_ns(value)
    if isinstance(value, str):
        return _text_ns(value)
    return _pair_ns(value) if isinstance(value, Mapping) else 0


def _number_ns(number: float) -> int:
    if not math.isfinite(number) or number <= 0:
        return 0
    unit_ns = next((unit for limit, unit in _UNITS if number < limit), 1)
    if isinstance(number, int):
        return _valid(number * unit_ns)
    whole = int(number)
    return _valid(whole * unit_ns + round((number - whole) * unit_ns))


def _text_ns(text: str) -> int:
    if not text[:1].isdigit():
        return 0
    try:
        return _valid(parse_time(text, lambda: 0, lambda: None))
    except (UsageError, ValueError):
        return 0


def _pair_ns(pair: Mapping[str, Any]) -> int:
    for seconds, rest in _PAIRS:
        if type(pair.get(seconds)) is int and type(pair.get(rest)) is int:
            return _valid(pair[seconds] * _NS + pair[rest])
    return 0


def _valid(stamp_ns: int) -> int:
    return stamp_ns if 0 < stamp_ns <= _LATEST_NS else 0
