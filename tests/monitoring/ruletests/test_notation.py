"""The compact notation of series."""

from __future__ import annotations

import math
from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.rule_tests import ABSENT, RuleTestSeries, read_series


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("", []),
        ("5", [5]),
        ("5x3", [5, 5, 5]),
        ("-5x2", [-5, -5]),
        ("0x2", [0, 0]),
        ("0+0.1x4", [0.0, 0.1, 0.2, 0.3]),
        ("10-0.5x3 7", [10.0, 9.5, 9.0, 7]),
        ("-1-1x3", [-1, -2, -3]),
        ("1e3+1e-1x2", [1000.0, 1000.1]),
        ("_x2 null true falsex2", [ABSENT, ABSENT, None, True, False, False]),
        ("'a b'x2 \"it's\"", ["a b", "a b", "it's"]),
        ("inf -inf", [math.inf, -math.inf]),
        ("[1, 2.5]x2 []", [[1.0, 2.5], [1.0, 2.5], []]),
    ],
)
def test_series_are_read(text: str, values: list[Any]) -> None:
    read = read_series(text)
    assert read == values
    assert [type(value) for value in read] == [type(value) for value in values]


def test_nan_is_a_value() -> None:
    number, listed = read_series("nan [1 nan]")
    assert math.isnan(number) and math.isnan(listed[1])


@pytest.mark.parametrize("text", ["drive", "5x", "x5", "'a'+1x3", "[1", "[a]", "5 x3", "true+1x2"])
def test_what_cannot_be_read_is_named(text: str) -> None:
    with pytest.raises(UsageError, match="cannot read") as caught:
        RuleTestSeries.from_text(text)
    assert "5x20" in caught.value.hint


def test_a_series_has_an_end() -> None:
    with pytest.raises(UsageError, match="200000 values at most"):
        read_series("1x99999999999")
