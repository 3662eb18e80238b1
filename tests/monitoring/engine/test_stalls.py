"""A recorder that was held up: late messages prove nothing, and faults are still found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.recorder.pipeline import BEAT_S, LATE_NS, StallMeter
from amberbox.core.clock import NS
from amberbox.core.flow import Stalls
from amberbox.testing.clock import ManualClock
from tests.fuzzing import examples

MS = NS // 1000


def test_a_thread_that_wakes_late_is_a_stall() -> None:
    clock = ManualClock()
    meter = StallMeter(clock.boot_ns)
    for _ in range(20):
        clock.advance(BEAT_S + 0.5 * LATE_NS / NS)
        meter.beat()
    assert meter.take() is None
    before = clock.boot
    clock.advance(5.0)
    clock.step(3600.0)
    meter.beat()
    clock.advance(BEAT_S)
    meter.beat()
    assert meter.take() == (before, before + 5 * NS)
    assert meter.take() is None


def test_a_stall_that_goes_on_is_known_at_once() -> None:
    clock = ManualClock()
    meter = StallMeter(clock.boot_ns)
    before = clock.boot
    clock.advance(3.0)
    assert meter.take() == (before, before + 3 * NS)
    clock.advance(1.0)
    meter.beat()
    assert meter.take() == (before + 3 * NS, before + 4 * NS)


STALLS = st.lists(st.tuples(st.integers(0, 50), st.integers(1, 50)), max_size=12)


@settings(max_examples=examples(50))
@given(STALLS, st.lists(st.integers(-10, 1200), min_size=2, max_size=6))
def test_time_within_stalls_is_that_of_a_count_by_hand(
    parts: list[tuple[int, int]], times: list[int]
) -> None:
    stalls, stalled, at = Stalls(), set(), 0
    for pause, length in parts:
        stalls.add(at + pause, at + pause + length)
        stalled |= set(range(at + pause, at + pause + length))
        at += pause + length
    since, until = sorted(times)[0], np.array(sorted(times)[1:])
    counted = [sum(since <= t < end for t in stalled) for end in until.tolist()]
    assert stalls.within_ns(since, until).tolist() == counted
    assert [int(stalls.within_ns(since, end)) for end in until.tolist()] == counted
    again = Stalls()
    for stall in [*stalls.snapshot(), *stalls.snapshot()]:
        again.add(*stall)
    assert again.snapshot() == stalls.snapshot()


@pytest.mark.parametrize(("window_ms", "spoilt"), [(300, True), (4999, True), (5001, False)])
def test_windows_are_spoilt_by_a_tenth(window_ms: int, spoilt: bool) -> None:
    stalls = Stalls()
    stalls.add(10 * NS, 10 * NS + 500 * MS)
    instants = np.array([9 * NS, 10 * NS, 10 * NS + MS, 10 * NS + (499 + window_ms) * MS, 30 * NS])
    expected = [False, False, spoilt, spoilt, False]
    assert stalls.spoils(instants, window_ms * MS).tolist() == expected
