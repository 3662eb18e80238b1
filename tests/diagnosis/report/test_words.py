from __future__ import annotations

import pytest

from amberbox.diagnosis.report.wording import (
    clock,
    date_and_clock,
    delay_text,
    duration,
    join_with_and,
    join_with_or,
    sentence,
)
from tests.diagnosis.report.robot import START_NS


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(30, "30 s"), (60, "1 min"), (900, "15 min"), (7200, "2 h"), (9000, "2.5 h"), (86400, "24 h")],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_times() -> None:
    assert clock(START_NS + 61 * 10**9) == "00:01:01 UTC"
    assert date_and_clock(START_NS) == "2026-11-22 00:00:00 UTC"
    assert [delay_text(s) for s in (0, 0.01, 2.5, 600)] == [
        "first", "at once", "2.5 s later", "10 min later",
    ]  # fmt: skip


def test_lists_and_sentences() -> None:
    assert (join_with_and(["a"]), join_with_and(["a", "b"]), join_with_and(["a", "b", "c"])) == (
        "a",
        "a and b",
        "a, b and c",
    )
    assert (join_with_or(["a"]), join_with_or(["a", "b"])) == ("a", "a; or b")
    assert join_with_or(["a", "b", "c", "d", "e"]) == "a; b; or 3 more"
    assert (sentence("is it so?"), sentence("it is"), sentence("")) == ("Is it so?", "It is.", "")
