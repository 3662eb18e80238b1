"""Results over samples do not depend on the batches or on the order of queries."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.flow import NONE_OPEN, Flow
from amberbox.core.samples import Samples, Window
from amberbox.core.types import IntArray

MS = 1_000_000
WINDOW_S = 0.1
NUMBERS = [0.0, -0.0, 1.0, 2.5, -3.0, 0.1, 1e300, math.nan, math.inf, -math.inf]
DTYPES = [np.float64, np.float32, np.int64, np.uint8, np.bool_]


def above(samples: Samples) -> Any:
    """One flag per sample; unknown values mean nothing."""
    flags = samples.values > 1
    return flags if samples.null is None else flags & ~samples.null


Ask = Callable[[Samples, Any], Any]
ASKED: dict[str, Ask] = {
    "last": lambda s, now: s.since_ns(now),
    "at": lambda s, now: np.where(s.known(now), s.at(now), 0),
    "known": lambda s, now: s.known(now),
    "count": lambda s, now: Window(s, now, WINDOW_S).count(),
    "min": lambda s, now: Window(s, now, WINDOW_S).min(),
    "max": lambda s, now: Window(s, now, WINDOW_S).max(),
    "mean": lambda s, now: Window(s, now, WINDOW_S).mean(),
    "std": lambda s, now: Window(s, now, WINDOW_S).std(),
    "rate": lambda s, now: Window(s, now, WINDOW_S).rate(),
    "changes": lambda s, now: Window(s, now, WINDOW_S).changes(),
    "sum_of": lambda s, now: Window(s, now, WINDOW_S).sum_of(above(s)),
    "derived": lambda s, now: Window(s.derived(above(s)), now, WINDOW_S).mean(),
}


def bits(value: Any) -> bytes:
    """Make a value comparable bit for bit, all NaN alike."""
    number = float(value)
    return b"nan" if math.isnan(number) else struct.pack("<d", number)


@st.composite
def columns(draw: st.DrawFn) -> tuple[IntArray, Any]:
    """Times in order, and values of any kind with unknown ones among them."""
    times = sorted(draw(st.lists(st.integers(0, 400), min_size=1, max_size=25)))
    pool = draw(st.lists(st.sampled_from(NUMBERS), min_size=1, max_size=6))
    values = np.resize(pool, len(times))
    with np.errstate(all="ignore"):
        values = np.nan_to_num(values, posinf=9, neginf=9).astype(draw(st.sampled_from(DTYPES))) \
            if draw(st.booleans()) else values  # fmt: skip
    null = np.array(draw(st.lists(st.booleans(), min_size=len(times), max_size=len(times))))
    column = np.ma.MaskedArray(values, null) if draw(st.booleans()) else values
    return np.array(times, np.int64) * MS, column


instants = st.lists(st.integers(0, 450), min_size=1, max_size=8).map(
    lambda found: np.array(sorted(found), np.int64) * MS
)
cuts = st.sets(st.integers(1, 25), max_size=4)


def whole(column: tuple[IntArray, Any]) -> Samples:
    samples = Samples()
    samples.extend(*column)
    return samples


@settings(max_examples=150)
@given(columns(), instants)
def test_many_instants_give_what_each_gives(column: tuple[IntArray, Any], now: IntArray) -> None:
    samples = whole(column)
    with np.errstate(all="ignore"):
        for name, ask in ASKED.items():
            together = [bits(value) for value in ask(samples, now)]
            assert together == [bits(ask(samples, int(n))) for n in now], name


@settings(max_examples=150)
@given(columns(), instants, cuts)
def test_parts_and_forgetting_change_nothing(
    column: tuple[IntArray, Any], now: IntArray, places: set[int]
) -> None:
    reference, samples = whole(column), Samples()
    times, values = column
    done = 0
    for instant in now.tolist():
        end = int(times.searchsorted(instant, "right"))
        for stop in (*(cut for cut in sorted(places) if done < cut < end), end):
            samples.extend(times[done:stop], values[done:stop])
            done = max(done, stop)
        samples.forget_before(instant - round(WINDOW_S * NS))
        with np.errstate(all="ignore"):
            for name, ask in ASKED.items():
                if end or name != "last":
                    assert bits(ask(samples, instant)) == bits(ask(reference, instant)), name


@settings(max_examples=150)
@given(columns(), st.integers(0, 450))
def test_the_answers_are_those_of_the_definition(column: tuple[IntArray, Any], at: int) -> None:
    samples, now = whole(column), at * MS
    rows = [(t, None if m else v) for t, v, m in zip(
        column[0].tolist(), np.ma.getdata(column[1]).tolist(),
        np.ma.getmaskarray(column[1]).tolist(), strict=True)]  # fmt: skip
    past = [value for t, value in rows if t <= now]
    assert bool(samples.known(now)) == (bool(past) and past[-1] is not None)
    if samples.known(now):
        assert bits(samples.at(now)) == bits(past[-1])
    inside = [v for t, v in rows if now - WINDOW_S * NS < t <= now]
    window = Window(samples, now, WINDOW_S)
    assert window.count() == len(inside)
    pairs = list(zip([value for _, value in rows], [value for _, value in rows][1:], strict=False))
    changed = [differ(*pairs[n - 1]) for n, (t, _) in enumerate(rows)
               if n and now - WINDOW_S * NS < t <= now]  # fmt: skip
    assert window.changes() == sum(changed)
    known = [float(value) for value in inside if value is not None]
    if known and not any(map(math.isnan, known)):
        assert (window.min(), window.max()) == (min(known), max(known))
    elif not known:
        assert math.isnan(window.min())


def differ(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is not other
    return not (one == other or (one != one and other != other))


def test_texts() -> None:
    samples = Samples()
    samples.extend(np.array([1, 2]), np.array(["idle", None], object))
    samples.extend(np.array([3, 4]), np.array(["busy", "busy"], object))
    assert [samples.at(n) for n in (1, 3, 9)] == ["idle", "busy", "busy"]
    assert samples.known(np.array([0, 1, 2, 3])).tolist() == [False, True, False, True]
    assert samples.column().tolist() == ["idle", None, "busy", "busy"]
    assert Window(samples, 4, 1).changes() == 2


def test_a_wider_type_comes_later() -> None:
    samples = Samples()
    samples.extend(np.array([1]), np.array([7], np.uint8))
    samples.extend(np.array([2]), np.array([0.5]))
    assert samples.values.tolist() == [7, 0.5]


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
def test_narrow_numbers_are_held_wide(dtype: type) -> None:
    samples = Samples()
    samples.extend(np.array([1, 2]), np.array([3, 200], dtype))
    assert samples.values.dtype.itemsize == 8
    assert samples.at(1) - samples.at(2) == -197


def test_what_is_unknown_has_no_type() -> None:
    unknown = np.ma.MaskedArray(np.zeros(1), [True])
    for columns in ([unknown, np.array([True])], [np.array([True]), unknown]):
        samples = Samples()
        for time_ns, column in enumerate(columns):
            samples.extend(np.array([time_ns]), column)
        assert samples.values.dtype == bool


def test_nothing_is_known_of_no_samples() -> None:
    samples, now = Samples(), np.array([5, 6])
    assert samples.known(now).tolist() == [False, False]
    assert not samples.known(5)
    assert len(samples.at(now)) == 2
    assert math.isnan(Window(samples, 5, 1).mean())
    assert Window(samples, 5, 1).count() == Window(samples, 5, 1).changes() == 0


def test_memory_is_bounded_by_what_is_kept() -> None:
    samples = Samples()
    for second in range(1000):
        samples.extend(np.arange(second * 100, second * 100 + 100), np.zeros(100))
        samples.forget_before(second * 100 - 200)
    assert len(samples) <= 401
    assert len(samples._times) <= 2000


def test_the_smaller_of_two_zeros_has_no_sign() -> None:
    samples = Samples()
    samples.extend(np.arange(1, 10), np.array([0.0, -0.0] * 4 + [-0.0]))
    for now in range(2, 10):
        window = Window(samples, now, 1)
        assert [math.copysign(1, found) for found in (window.min(), window.max())] == [1, 1]


FLOW: dict[str, Callable[[Flow, Any], Any]] = {
    "age_s": lambda flow, now: flow.age_s(now),
    "rate_hz": lambda flow, now: flow.rate_hz(now, WINDOW_S),
    "lost": lambda flow, now: flow.lost(now),
    "reaches_back": lambda flow, now: flow.reaches_back(now, WINDOW_S),
    "listened": lambda flow, now: flow.listened(now, WINDOW_S),
}


def count_at(samples: Samples, times: Sequence[int]) -> None:
    samples.extend(np.array(times, np.int64) * MS, np.arange(1, len(times) + 1))


@settings(max_examples=150)
@given(*[st.lists(st.integers(0, 400), max_size=12).map(sorted)] * 3, instants)
def test_how_an_item_flows(
    heard: list[int], rows: list[int], gaps: list[int], now: IntArray
) -> None:
    whole_flow, flow = Flow(), Flow()
    at_ns = {name: np.array(times, np.int64) * MS
             for name, times in (("heard", heard), ("rows", rows), ("gaps", gaps))}  # fmt: skip
    lost_ns = np.where(np.arange(len(gaps)) % 2 == 0, at_ns["gaps"], NONE_OPEN)
    series = {
        "received": (at_ns["heard"], np.arange(1, len(heard) + 1)),
        "last_ns": (at_ns["heard"], at_ns["heard"] - 1),
        "rows": (at_ns["rows"], np.arange(1, len(rows) + 1)),
        "gap_from_ns": (at_ns["gaps"], lost_ns),
    }
    for name, (times, values) in series.items():
        getattr(whole_flow, name).extend(times, values)
    before = -1
    for instant in now.tolist():
        for name, (times, values) in series.items():
            new = (times > before) & (times <= instant)
            getattr(flow, name).extend(times[new], values[new])
            getattr(flow, name).forget_before(instant - round(WINDOW_S * NS))
        before = instant
        for name, ask in FLOW.items():
            assert bits(ask(flow, instant)) == bits(ask(whole_flow, instant)), name
    for name, ask in FLOW.items():
        together = [bits(value) for value in ask(whole_flow, now)]
        assert together == [bits(ask(whole_flow, int(n))) for n in now], name


def test_silence_lowers_the_rate_and_raises_the_age() -> None:
    flow = Flow()
    count_at(flow.received, range(0, 1001, 100))
    flow.last_ns.extend(flow.received.times_ns, flow.received.times_ns)
    assert flow.rate_hz(1000 * MS, 0.5) == pytest.approx(10)
    assert flow.rate_hz(1250 * MS, 0.5) == pytest.approx(6)
    assert flow.rate_hz(2000 * MS, 0.5) == 0
    assert flow.age_s(1250 * MS) == pytest.approx(0.25)
    assert math.isnan(Flow().rate_hz(5, 1))
    assert Flow().age_s(5) == math.inf


def test_counts_before_filters_come_before_rows() -> None:
    flow = Flow()
    count_at(flow.received, range(0, 1001, 10))
    count_at(flow.rows, range(0, 1001, 500))
    assert flow.rate_hz(1000 * MS, 0.5) == pytest.approx(100)


def test_how_long_one_has_listened() -> None:
    flow = Flow()
    assert not flow.listened(9 * NS, 5)
    flow.began_ns = 2 * NS
    assert [bool(flow.listened(n * NS, 5)) for n in (3, 6, 7, 9)] == [False, False, True, True]
    assert not flow.reaches_back(9 * NS, 5)


def test_a_lost_publisher_is_back_with_its_next_message() -> None:
    flow = Flow()
    flow.rows.extend(np.array([1, 9]) * NS, np.array([1, 2]))
    flow.gap_from_ns.extend(np.array([5]) * NS, np.array([5]) * NS)
    assert [bool(flow.lost(n * NS)) for n in (2, 5, 6, 9)] == [False, False, True, False]


def test_what_is_within_windows_is_what_was_in_force_there() -> None:
    samples = Samples()
    samples.extend(np.array([1, 2, 4, 7, 9]) * NS, np.ma.masked_equal([1, 2, 3, 4, 5], 2))
    near = samples.within(7 * NS, 4)
    assert near.times_ns.tolist() == [2 * NS, 4 * NS, 7 * NS]
    assert near.column().tolist() == [None, 3, 4]
    assert samples.within(np.array([3, 9]) * NS, 1).times_ns.tolist() == [
        t * NS for t in (2, 4, 7, 9)
    ]
    assert len(samples.within(NS, 5)) == 1
    assert not len(samples.within(0, 5))
    assert not len(Samples().within(NS, 5))
