"""Sizes and shares as people read them."""

import pytest

from amberbox.server.web.text import count, percent, size, span


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1 kB"), (1234, "1.23 kB"), (56_000_000, "56 MB"),
     (999_499, "999 kB"), (999_600, "1 MB"), (12_340_000_000, "12.3 GB"), (5e18, "5000 PB")],
)  # fmt: skip
def test_sizes_have_three_digits(number: float, text: str) -> None:
    assert size(number) == text


def test_counts_have_their_thousands_apart() -> None:
    assert count(1234567) == "1,234,567"


@pytest.mark.parametrize(("share", "shown"), [(0, 0), (0.001, 1), (0.5, 50), (0.999, 99), (1, 100)])
def test_all_is_said_of_all_only(share: float, shown: int) -> None:
    assert percent(share) == shown


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0 s"), (59.9, "59 s"), (60, "1 min"), (7200, "2 h"), (200000, "2 d")]
)
def test_how_long_it_lasted(seconds: float, text: str) -> None:
    assert span(seconds) == text
