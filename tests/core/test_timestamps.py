"""Times as text: every spelling, exact to the nanosecond."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.errors import UsageError
from amberbox.core.timestamps import (
    NS,
    format_duration,
    format_time,
    format_times,
    parse_duration,
    parse_time,
)

NOW = 1_790_000_000 * NS
LAST = 1_780_000_000 * NS


def read(text: str, last: int | None = LAST) -> int:
    return parse_time(text, lambda: NOW, lambda: last)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1970-01-01", 0),
        ("2001-09-09T01:46:40Z", 1_000_000_000 * NS),
        ("2001-09-09 01:46:40", 1_000_000_000 * NS),
        ("2001-09-09T01:46", 1_000_000_000 * NS - 40 * NS),
        ("2001-09-09T03:46:40.123456789+02:00", 1_000_000_000 * NS + 123_456_789),
        ("2001-09-09T03:46:40.5+0200", 1_000_000_000 * NS + 500_000_000),
        ("1000000000", 1_000_000_000 * NS),
        ("1000000000.25", 1_000_000_000 * NS + 250_000_000),
        ("1700000000123", 1_700_000_000_123 * 10**6),
        ("1700000000123456", 1_700_000_000_123_456 * 10**3),
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ("now", NOW),
        ("now-10m", NOW - 600 * NS),
        ("-10m", LAST - 600 * NS),
        ("-1h30m", LAST - 5400 * NS),
        ("-250ms", LAST - 250_000_000),
    ],
)
def test_reads_every_spelling(text: str, expected: int) -> None:
    assert read(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("", "soon", "10m", "-10", "-10 parsecs", "2026-13-01", "2026-11-21T25:00", "nowish"),
        *("9" * 23, "9999-01-01", "1600-01-01"),
    ],
)
def test_refuses_what_is_no_time(text: str) -> None:
    with pytest.raises(UsageError, match="not a"):
        read(text)


def test_relative_time_needs_a_record() -> None:
    with pytest.raises(UsageError, match="no"):
        read("-10m", last=None)


@given(st.integers(0, 2**62))
def test_format_and_read_agree(time_ns: int) -> None:
    text = format_time(time_ns)
    assert read(text) == time_ns
    assert format_times(np.array([time_ns]))[0] == text


@given(st.integers(0, 10**15), st.sampled_from(["ns", "us", "ms", "s", "m", "h", "d"]))
def test_whole_durations_are_exact(count: int, unit: str) -> None:
    factor = {"ns": 1, "us": 10**3, "ms": 10**6, "s": NS, "m": 60 * NS, "h": 3600 * NS}
    assert parse_duration(f"{count}{unit}") == count * factor.get(unit, 86400 * NS)


@pytest.mark.parametrize(
    ("duration_ns", "text"),
    [
        (45_000_000, "45ms"),
        (12_345_678_901, "12.3s"),
        (185 * NS, "3m05s"),
        (3720 * NS, "1h02m"),
        (-NS, "-1.0s"),
    ],
)
def test_durations_for_people(duration_ns: int, text: str) -> None:
    assert format_duration(duration_ns) == text
