"""Times as text and numbers: ISO 8601, epoch numbers, ``-10m``, ``now``, stamps in messages.

A message's own time stamp is what its sender wrote: a number of any unit, a text, or a pair of
seconds and nanoseconds as in ROS. All times become integer nanoseconds since the Unix epoch.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import UsageError
from amberbox.core.types import IntArray

NS = 1_000_000_000
_UNITS_NS = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": NS,
    "m": 60 * NS,
    "min": 60 * NS,
    "h": 3600 * NS,
    "d": 86_400 * NS,
}
_UNIT_BY_SIZE = ((10**11, NS), (10**14, 10**6), (10**17, 10**3))  # s, ms, us; larger is ns
_BEYOND_NS = 2**63  # times have 64 bits
_DURATION_PART = re.compile(r"(\d+(?:\.\d+)?)(ns|us|ms|min|s|m|h|d)")
_ISO = re.compile(
    r"(\d{4}-\d{2}-\d{2})"
    r"(?:[T ](\d{2}:\d{2})(?::(\d{2})(?:[.,](\d{1,9}))?)?)?"
    r"\s*(Z|z|[+-]\d{2}:?\d{2})?"
)
_HINT = (
    "write 2026-11-21T14:00:00Z, 2026-11-21 14:00 (UTC), an epoch in s, ms, us or ns, "
    "-10m (before the last record), now or now-10m"
)


def parse_duration(text: str) -> int:
    """Read ``10m``, ``1h30m``, ``2.5s`` or ``250ms``; nanoseconds."""
    compact = text.strip().replace(" ", "")
    parts = _DURATION_PART.findall(compact)
    if not parts or "".join(number + unit for number, unit in parts) != compact:
        raise UsageError(f"not a duration: {text!r}", "write 10m, 1h30m, 2.5s or 250ms")
    return sum(_scaled(number, _UNITS_NS[unit]) for number, unit in parts)


def parse_time(text: str, now_ns: Callable[[], int], last_ns: Callable[[], int | None]) -> int:
    """Read a time; nanoseconds since the Unix epoch.

    ISO times without an offset are UTC. Bare numbers are epoch seconds, milliseconds, microseconds
    or nanoseconds, distinguished by magnitude. ``-10m`` is that long before the last record
    (``last_ns``), ``now`` and ``now-10m`` go by the clock (``now_ns``).
    """
    time_ns = parse_any_time(text, now_ns, last_ns)
    if abs(time_ns) >= _BEYOND_NS:
        raise UsageError(f"not a time between the years 1678 and 2262: {text!r}", _HINT)
    return time_ns


def ordered_span(from_ns: int | None, to_ns: int | None) -> tuple[int | None, int | None]:
    """Return a range of time; raises UsageError if it ends before it begins."""
    if from_ns is not None and to_ns is not None and from_ns > to_ns:
        raise UsageError(
            f"the range ends before it begins: from {format_time(from_ns)} to {format_time(to_ns)}",
            "exchange from and to",
        )
    return from_ns, to_ns


def ns_of(stamp: str) -> int:
    """Read a time as `format_time` writes it; raises UsageError for any other."""
    iso = _ISO.fullmatch(stamp)
    if iso is None:
        raise UsageError(f"not a time: {stamp!r}", _HINT)
    return _iso_ns(iso, stamp)


def parse_any_time(text: str, now_ns: Callable[[], int], last_ns: Callable[[], int | None]) -> int:
    """Read a time as ``parse_time`` does, also one that 64 bits cannot hold."""
    compact = text.strip()
    if compact.startswith("now"):
        return now_ns() + _shift(compact[3:], text)
    if re.fullmatch(r"\d+(\.\d+)?", compact):
        return _epoch_ns(compact)
    iso = _ISO.fullmatch(compact)
    if iso:
        return _iso_ns(iso, text)
    if compact[:1] == "-" and _DURATION_PART.match(compact[1:]):
        last = last_ns()
        if last is None:
            raise UsageError(f"{text!r} counts from the last record, but there is none", _HINT)
        return last + _shift(compact, text)
    raise UsageError(f"not a time: {text!r}", _HINT)


def _shift(compact: str, text: str) -> int:
    if not compact:
        return 0
    if compact[0] not in "+-":
        raise UsageError(f"not a time: {text!r}", _HINT)
    distance_ns = parse_duration(compact[1:])
    return distance_ns if compact[0] == "+" else -distance_ns


def _scaled(number: str, unit_ns: int) -> int:
    whole, _, fraction = number.partition(".")
    digits = fraction[:18]
    return int(whole) * unit_ns + (int(digits) * unit_ns // 10 ** len(digits) if digits else 0)


def _epoch_ns(number: str) -> int:
    """Read an epoch number in s, ms, us or ns by its size: each covers 1973 to 5138."""
    size = int(number.partition(".")[0])
    for limit, unit_ns in _UNIT_BY_SIZE:
        if size < limit:
            return _scaled(number, unit_ns)
    return size


def _iso_ns(match: re.Match[str], text: str) -> int:
    date, minutes, seconds, fraction, zone = match.groups()
    offset = "+00:00" if zone in (None, "Z", "z") else zone
    try:
        moment = datetime.fromisoformat(f"{date}T{minutes or '00:00'}:{seconds or '00'}{offset}")
    except ValueError as error:
        raise UsageError(f"not a time: {text!r} ({error})", _HINT) from None
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    whole_ns = (since.days * 86_400 + since.seconds) * NS
    return whole_ns + int((fraction or "0").ljust(9, "0"))


def format_time(time_ns: int) -> str:
    """Write a time as RFC 3339 with nanoseconds, UTC."""
    return f"{np.datetime64(int(time_ns), 'ns')}Z"


def maybe_time(time_ns: int | None) -> str | None:
    """Write a time as RFC 3339; None for a time that is not known."""
    return None if time_ns is None else format_time(time_ns)


def format_to_second(time_ns: int) -> str:
    """Write a time as RFC 3339, cut to the second."""
    return f"{format_time(time_ns)[:19]}Z"


def format_times(times_ns: IntArray) -> NDArray[np.str_]:
    """Write many times as RFC 3339 with nanoseconds, UTC."""
    stamps = np.asarray(times_ns, np.int64).astype("datetime64[ns]")
    return np.strings.add(np.datetime_as_string(stamps, unit="ns"), "Z")


def format_duration(duration_ns: int) -> str:
    """Write a duration for a person: ``1h02m``, ``3m05s``, ``12.3s`` or ``45ms``."""
    if duration_ns < 0:
        return "-" + format_duration(-duration_ns)
    if duration_ns < NS:
        return f"{duration_ns / 1e6:.3g}ms"
    if duration_ns < 60 * NS:
        return f"{duration_ns / NS:.1f}s"
    minutes, seconds = divmod(round(duration_ns / NS), 60)
    if minutes < 60:
        return f"{minutes}m{seconds:02d}s"
    return f"{minutes // 60}h{minutes % 60:02d}m"


_FIRST_NS = 10**17
_LATEST_NS = 2**63 - 1
_PAIRS = (("secs", "nsecs"), ("sec", "nanosec"), ("sec", "nsec"))


def stamp_of(value: Any) -> int:
    """Read a stamp from a decoded value; nanoseconds since the epoch, 0 if it is none.

    Numbers are seconds, milliseconds, microseconds or nanoseconds by their size (each covers the
    years 1973 to 5138); text is RFC 3339; ``{secs, nsecs}`` and ``{sec, nanosec}`` are ROS times. A
    number or a text before 1973 is a count, a time of day or a time since the start of something.
    ROS times are unambiguous: those of a simulation begin at 0.
    """
    stamp_ns = time_of(value)
    return stamp_ns if isinstance(value, Mapping) or stamp_ns >= _FIRST_NS else 0


def time_of(value: Any) -> int:
    """Read a value that is known to be a time as ``stamp_of`` does, of any year from 1970 on."""
    if isinstance(value, bool) or value is None:
        return 0
    if isinstance(value, int | float):
        if not math.isfinite(value) or value <= 0:
            return 0
        unit_ns = next((unit for limit, unit in _UNIT_BY_SIZE if value < limit), 1)
        if isinstance(value, int):
            return _valid(value * unit_ns)
        whole = int(value)
        return _valid(whole * unit_ns + round((value - whole) * unit_ns))
    if isinstance(value, str):
        if not value[:1].isdigit():
            return 0
        try:
            return _valid(parse_time(value, lambda: 0, lambda: None))
        except (UsageError, ValueError):
            return 0
    return _pair_ns(value) if isinstance(value, Mapping) else 0


def _pair_ns(pair: Mapping[str, Any]) -> int:
    for seconds, rest in _PAIRS:
        if type(pair.get(seconds)) is int and type(pair.get(rest)) is int:
            return _valid(pair[seconds] * NS + pair[rest])
    return 0


def _valid(stamp_ns: int) -> int:
    return stamp_ns if 0 < stamp_ns <= _LATEST_NS else 0
