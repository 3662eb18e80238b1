"""The rate limit keeps what jitters around it, thins bursts, forgives a clock set back."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.filters.rate import TOLERANCE_PERIODS, RateLimit
from amberbox.core.errors import UsageError
from amberbox.core.types import IntArray

Arrivals: TypeAlias = Callable[[float, int, np.random.Generator], IntArray]

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


def timer_paced(rate_hz: float, count: int, rng: np.random.Generator) -> IntArray:
    """Arrivals around a steady schedule, each early or late by up to 30 % of the period."""
    places = np.arange(count) + rng.uniform(-0.3, 0.3, count)
    return START_NS + (places * SECOND_NS / rate_hz).astype(np.int64)


def drifting(rate_hz: float, count: int, rng: np.random.Generator) -> IntArray:
    """Arrivals whose intervals vary by 30 %: a random walk around the schedule."""
    intervals = (1 + rng.uniform(-0.3, 0.3, count)) * SECOND_NS / rate_hz
    return START_NS + np.cumsum(intervals).astype(np.int64)


@pytest.mark.parametrize("rate_hz", [10.0, 10.05])
@pytest.mark.parametrize("arrivals", [timer_paced, drifting])
@pytest.mark.parametrize("count", [600, 20_000])
def test_a_jittering_stream_at_its_limit_is_kept(
    arrivals: Arrivals, rate_hz: float, count: int
) -> None:
    for seed in range(3):
        received_ns = arrivals(rate_hz, count, np.random.default_rng(seed))
        assert RateLimit(10).mask(received_ns).mean() >= 0.99


def test_a_timer_paced_stream_at_its_limit_loses_nothing() -> None:
    received_ns = timer_paced(10.0, 20_000, np.random.default_rng(1))
    assert RateLimit(10).mask(received_ns).all()


@pytest.mark.parametrize("rate_hz", [11.0, 25.0, 1000.0])
def test_a_faster_stream_is_brought_down_to_the_limit(rate_hz: float) -> None:
    received_ns = timer_paced(rate_hz, int(60 * rate_hz), np.random.default_rng(2))
    kept = int(RateLimit(10).mask(received_ns).sum())
    assert 600 <= kept <= 600 + TOLERANCE_PERIODS + 1


def test_a_slower_stream_is_kept_whole() -> None:
    assert RateLimit(10).mask(drifting(7.0, 2_000, np.random.default_rng(3))).all()


def test_the_burst_after_a_stall_is_thinned() -> None:
    limit = RateLimit(10)
    before = START_NS + np.arange(50) * SECOND_NS // 10
    burst = before[-1] + 5 * SECOND_NS + np.arange(50) * 1_000
    assert limit.mask(before).all()
    assert int(limit.mask(burst).sum()) == TOLERANCE_PERIODS + 1


@given(
    st.lists(st.integers(0, 3 * SECOND_NS), min_size=1, max_size=300),
    st.floats(0.5, 1000),
)
def test_no_stretch_holds_more_than_its_share_and_one_burst(
    gaps_ns: list[int], max_frequency: float
) -> None:
    received_ns = START_NS + np.cumsum(gaps_ns)
    kept_ns = received_ns[RateLimit(max_frequency).mask(received_ns)]
    spans_s = (kept_ns[None, :] - kept_ns[:, None]) / SECOND_NS
    count = np.arange(len(kept_ns))[None, :] - np.arange(len(kept_ns))[:, None] + 1
    assert (count <= spans_s * max_frequency + TOLERANCE_PERIODS + 1 + 1e-6)[spans_s >= 0].all()


@given(
    st.lists(st.integers(-SECOND_NS, 3 * SECOND_NS), max_size=100),
    st.lists(st.integers(0, 100), max_size=4),
)
def test_batches_and_single_messages_agree(gaps_ns: list[int], cuts: list[int]) -> None:
    received_ns = START_NS + np.cumsum(np.array(gaps_ns, dtype=np.int64))
    batched, single = RateLimit(10), RateLimit(10)
    parts = np.split(received_ns, sorted(min(cut, len(gaps_ns)) for cut in cuts))
    masks = np.concatenate([batched.mask(part) for part in parts])
    assert masks.tolist() == [single.accept(int(t)) for t in received_ns]


def test_a_clock_set_back_starts_the_schedule_anew() -> None:
    limit = RateLimit(10)
    assert limit.accept(START_NS)
    assert limit.accept(START_NS - 3600 * SECOND_NS)


@pytest.mark.parametrize("max_frequency", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_that_is_none_is_refused(max_frequency: float) -> None:
    with pytest.raises(UsageError, match="max_frequency"):
        RateLimit(max_frequency)
