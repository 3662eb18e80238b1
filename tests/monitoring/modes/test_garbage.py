"""Impossible values are counted, in single values and in lists."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan

import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN
from amberbox.monitoring.modes import garbage
from amberbox.monitoring.modes.garbage import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    configs = [Config(), Config(allowed=(0, 1, 2)), Config(mask=7, tolerated=20)]
    assert_mode_contract(garbage, "garbage", configs=configs, text=True)


@pytest.mark.parametrize(
    ("config", "count"),
    [
        (Config(), 3),
        (Config(min=0), 4),
        (Config(max=6.5), 5),
        (Config(allowed=(1, 2, 3, 4)), 6),
        (Config(mask=0b111), 5),
    ],
)
def test_what_is_garbage(config: Config, count: int) -> None:
    values = [1, 2, nan, inf, -inf, 7, 12, None, 4, -3 if config.mask is None else 5.5]
    entry = one_input(times_s=[n / 10 for n in range(10)], values=values)
    found = garbage.evaluate(config, [entry], at_s(1))
    assert int(found["garbage"]) == count
    assert float(found["share"]) == pytest.approx(100 * count / 9)
    assert int(found["clean"]) == FALSE


def test_it_is_clean_again_a_window_later() -> None:
    times = [n / 10 for n in range(100)]
    entry = one_input(times_s=times, values=[nan if n == 30 else n for n in range(100)])
    found = garbage.evaluate(Config(window=2), [entry], at_s(2.9, 3, 4.9, 5.1))
    assert found["clean"].tolist() == [TRUE, FALSE, FALSE, TRUE]


def test_garbage_that_does_not_change_is_still_there_when_a_filter_leaves_it_out() -> None:
    entry = one_input(times_s=[0, 1], values=[5.0, nan])
    assert int(garbage.evaluate(Config(), [entry], at_s(60))["clean"]) == FALSE


def test_some_of_it_may_be_tolerated() -> None:
    entry = one_input(times_s=[n / 10 for n in range(210)], values=[1.0, nan] + [1.0] * 208)
    config = Config(window=20, tolerated=1)
    assert int(garbage.evaluate(config, [entry], at_s(20))["clean"]) == TRUE


def test_nothing_is_said_before_the_window_is_full_unless_too_much_is_garbage_already() -> None:
    times, config = [n / 10 for n in range(400)], Config(window=30, tolerated=2)
    bad = one_input(times_s=times, values=[1.0, nan] + [1.0] * 398)
    worse = one_input(times_s=times, values=[1.0, *[nan] * 8, *[1.0] * 391])
    for entry, expected in ((bad, [2, 2, 1]), (worse, [2, 0, 0])):
        found = garbage.evaluate(config, [entry], at_s(0.1, 0.8, 30))
        assert found["clean"].tolist() == expected
    results = garbage.evaluate(config, [bad], at_s(0.8))
    assert float(results["share"]) == pytest.approx(100 / 9)
    told = {"clean": None, "missing_s": float(results["missing_s"])}
    assert garbage.explain_unknown(config, told) == (
        "not judged for another 29.2 s: it takes 30 s of values"
    )


def test_what_came_right_after_a_gap_is_no_full_window() -> None:
    times = [n / 10 for n in range(400) if not 100 < n < 300]
    values = [nan if second == 30.1 else 1.0 for second in times]
    entry = one_input(times_s=times, values=values)
    config = Config(window=5, tolerated=5)
    found = garbage.evaluate(config, [entry], at_s(10, 30.05, 30.1, 30.5, 31, 36))
    assert found["clean"].tolist() == [TRUE, TRUE, UNKNOWN, UNKNOWN, UNKNOWN, TRUE]


def test_text_where_numbers_belong_is_garbage() -> None:
    entry = one_input(times_s=[0, 1, 6], values=[1.0, "off", "off"])
    assert int(garbage.evaluate(Config(), [entry], at_s(6))["clean"]) == FALSE


def test_nothing_known_is_not_clean() -> None:
    entry = one_input(times_s=[0], values=[None])
    assert int(garbage.evaluate(Config(), [entry], at_s(1))["clean"]) == UNKNOWN


def test_lists_are_counted_number_by_number() -> None:
    parts: dict[str, Sequence[float]] = {
        **{"count": [10, 10], "finite": [9, 10], "mean": [1.0, 1.0]},
        **{"min": [0.1, -4.0], "max": [5.0, 99.0]},
    }
    scan = one_input(times_s=[0, 1], values=[1.0, 1.0], parts=parts)
    found = garbage.evaluate(Config(min=0, max=30, window=2), [scan], at_s(1))
    assert int(found["garbage"]) == 3
    assert float(found["share"]) == pytest.approx(15)


def test_explanation() -> None:
    results = {"clean": False, "garbage": 3, "share": 15.0}
    expected = "15 % of the values of the last 5 s are garbage"
    assert garbage.explain(Config(), results) == expected
    assert garbage.explain(Config(), {**results, "clean": True}) == ""


@pytest.mark.parametrize(
    "config", [Config(window=0), Config(tolerated=100), Config(min=1, max=0), Config(mask=-1)]
)
def test_what_nothing_can_fulfil_is_refused(config: Config) -> None:
    assert list(config.check())
