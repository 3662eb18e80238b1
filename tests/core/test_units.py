"""Quantities with units."""

from __future__ import annotations

from fractions import Fraction

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.units import duration_ns, in_unit, parse_duration_s


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("5", "s", 5),
        ("5s", "s", 5),
        ("10 min", "s", 600),
        ("1 d", "h", 24),
        ("1ns", "s", Fraction(1, 10**9)),
        ("64 MB", "B", 64_000_000),
        ("64 MiB", "B", 67_108_864),
        ("1 GB", "MB", 1000),
        ("2.5e3 Hz", "kHz", Fraction(5, 2)),
        ("-3 s", "s", -3),
        (".5 h", "min", 30),
        ("7 m", "m", 7),
    ],
)
def test_conversion_is_exact(text: str, unit: str, value: Fraction) -> None:
    assert in_unit(text, unit) == value


@pytest.mark.parametrize("text", ["", "s", "5 5", "5 m", "5 MB", "--5", "1e", "5s s"])
def test_nonsense_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not a number|unknown unit"):
        in_unit(text, "s")


def test_durations() -> None:
    assert duration_ns("1.5", "ms") == 1_500_000
    assert parse_duration_s("5 min") == 300.0
    assert parse_duration_s("0.25") == 0.25
    for text in ("5 parsecs", "-1s", ""):
        with pytest.raises(UsageError) as caught:
            parse_duration_s(text)
        assert caught.value.hint == "write a duration as 30s or 5 min"
