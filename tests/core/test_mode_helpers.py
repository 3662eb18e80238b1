"""Inputs looked at together: middles and medians against numpy's, names, values of expressions."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

from amberbox.core.expression import parse
from amberbox.core.mode import (
    by_name,
    medians,
    middles,
    numbers,
    numbers_at,
    place_name,
    reads_of,
    sample_times,
    value_of,
    worst_of,
)
from amberbox.testing.modes import at_s, one_input

RANDOM = np.random.default_rng(5)


@pytest.mark.parametrize("count", range(1, 8))
def test_middles_are_those_of_what_is_finite(count: int) -> None:
    values = RANDOM.normal(size=(count, 50))
    values[RANDOM.random(values.shape) < 0.3] = nan
    values[RANDOM.random(values.shape) < 0.1] = inf
    values[RANDOM.random(values.shape) < 0.1] = -inf
    low, high = middles(values)
    for k in range(50):
        finite = np.sort(values[np.isfinite(values[:, k]), k])
        if not len(finite):
            assert np.isnan(low[k])
            assert np.isnan(high[k])
        else:
            assert (low[k], high[k]) == (finite[(len(finite) - 1) // 2], finite[len(finite) // 2])


def test_of_nothing_there_is_no_middle() -> None:
    low, high = middles(np.zeros((0, 3)))
    assert np.isnan([*low, *high]).all()


def test_medians_are_numpys_and_the_last_value_where_a_window_is_empty() -> None:
    times = np.sort(RANDOM.integers(0, 10**10, 60))
    rows = RANDOM.normal(size=(3, 60))
    rows[RANDOM.random(rows.shape) < 0.3] = nan
    instants = np.arange(-1, 12) * 10**9
    found = medians(times, rows, instants, 0.7)
    assert found.shape == (3, 13)
    for place, now in enumerate(instants):
        inside = (times > now - 700_000_000) & (times <= now)
        for row in range(3):
            known = rows[row, inside][~np.isnan(rows[row, inside])]
            before = rows[row, times <= now]
            if inside.any():
                expected = np.median(known) if len(known) else nan
            else:
                expected = before[-1] if len(before) else nan
            assert found[row, place] == pytest.approx(expected, nan_ok=True)
            assert np.array_equal(medians(times, rows, int(now), 0.7)[row], found[row, place], True)


def test_infinity_counts_in_medians() -> None:
    rows = np.array([[1.0, inf, 2.0], [inf, inf, 1.0], [nan, inf, inf]])
    times = np.array([1, 2, 3])
    assert medians(times, rows, 3, 1.0).tolist() == [2.0, inf, inf]


def test_the_worst_is_unknown_only_where_no_known_one_is_too_bad() -> None:
    values = np.array([[1.0, 1.0, nan], [nan, 9.0, nan], [2.0, nan, nan]])
    found = worst_of(values, limit=5.0)
    assert np.isnan(found[[0, 2]]).all()
    assert found[1] == 9.0


def test_texts_are_no_numbers() -> None:
    mixed = np.array([1, "two", 3.5, None, True, np.float32(2)], object)
    assert np.array_equal(numbers(mixed), [1.0, nan, 3.5, nan, 1.0, 2.0], equal_nan=True)
    entry = one_input(times_s=[0, 1, 2], values=[1.0, None, inf])
    found = numbers_at(entry, at_s(-1, 0, 1, 2))
    assert np.array_equal(found, [nan, 1.0, nan, nan], equal_nan=True)


def test_inputs_are_named_by_place_and_what_is_read_by_address() -> None:
    assert place_name(0) == "input_1"
    reads = reads_of(parse("input_1 + a.b * c.d"), None, parse("a.b > input_2"))
    assert reads == ("a.b", "c.d")
    entries = [one_input(str(k), times_s=[0], values=[k]) for k in range(4)]
    named = by_name(entries, reads)
    assert {name: entry.name for name, entry in named.items()} == {
        "input_1": "0", "input_2": "1", "a.b": "2", "c.d": "3"
    }  # fmt: skip
    assert value_of(parse("input_1 + a.b * c.d"), named, at_s(0)) == 6.0
    assert np.isnan(value_of(parse("input_1 + a.b"), named, at_s(-1)))


def test_sample_times_are_those_of_the_windows_and_one_before_for_each() -> None:
    fast = one_input(times_s=[0, 1, 2, 3, 4], values=[0] * 5)
    slow = one_input(times_s=[0.5, 3.5], values=[0] * 2)
    found = sample_times([fast, slow], at_s(3), 1.5)
    assert found.tolist() == at_s(0.5, 1, 2, 3).tolist()
