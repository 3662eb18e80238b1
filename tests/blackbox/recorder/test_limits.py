"""Rate limits through the whole recorder: a stream at the limit is kept, bursts are thinned."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.filters.rate import TOLERANCE_PERIODS
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, last_counters, number

LIMIT_HZ = 10.0
MESSAGES = 3000
Times = Callable[[random.Random], list[float]]


def jitter(rng: random.Random) -> list[float]:
    """10 Hz on the publisher's schedule, each message up to 30 % of a period early or late."""
    return [(n + rng.uniform(-0.3, 0.3)) / 10 for n in range(1, MESSAGES)]


def random_walk(rng: random.Random) -> list[float]:
    """10 Hz where each pause is up to 30 % longer or shorter: the publisher sleeps."""
    now, times = 0.0, []
    for _ in range(MESSAGES):
        now += rng.uniform(0.07, 0.13)
        times.append(now)
    return times


def too_fast(rng: random.Random) -> list[float]:
    """10.05 Hz."""
    return [n / 10.05 for n in range(1, MESSAGES)]


def record(store: Path, times: list[float]) -> ManualBox:
    """Receive a message at each time (seconds), writing every 100 ms."""
    options = [TopicOptions("/count", max_frequency=LIMIT_HZ)]
    box = ManualBox(store, options, ManualClock())
    start_ns, next_write = box.clock.wall, 0.1
    for n, time_s in enumerate(times):
        while next_write <= time_s:
            box.clock.advance((start_ns + round(next_write * 1e9) - box.clock.wall) / 1e9)
            box.pipeline.tick()
            next_write += 0.1
        box.clock.advance((start_ns + round(time_s * 1e9) - box.clock.wall) / 1e9)
        box.hear(COUNT, number(n))
    box.close()
    return box


@pytest.mark.parametrize("times", [jitter, random_walk, too_fast])
def test_a_topic_at_its_limit_is_kept(tmp_path: Path, times: Times) -> None:
    moments = times(random.Random(4))
    box = record(tmp_path / "store", moments)
    counters = last_counters(box.store)["ros_count"]
    assert counters["received"] == len(moments)
    assert counters["kept"] >= 0.99 * len(moments)
    assert counters["kept"] + counters["rate_limited"] == len(moments)
    assert len(amberbox.open(box.store).query("ros_count")) == counters["kept"]


def test_twice_the_limit_is_halved(tmp_path: Path) -> None:
    box = record(tmp_path / "store", [n / 20 for n in range(1, 2000)])
    counters = last_counters(box.store)["ros_count"]
    assert counters["kept"] == pytest.approx(1000, abs=TOLERANCE_PERIODS + 2)


def test_the_burst_after_a_stall_is_thinned_and_counted(tmp_path: Path) -> None:
    steady = [n / 10 for n in range(1, 101)]
    burst = [40.0 + n / 10_000 for n in range(300)]  # 30 s of messages at once
    after = [40.1 + n / 10 for n in range(1, 101)]
    box = record(tmp_path / "store", [*steady, *burst, *after])
    kept = amberbox.open(box.store).query("ros_count").values("data")
    of_burst = [n for n in kept if 100 <= n < 400]
    assert [n for n in kept if n < 100] == list(range(100))
    assert 1 <= len(of_burst) <= TOLERANCE_PERIODS + 1
    assert len(kept) >= 200
    counters = last_counters(box.store)["ros_count"]
    assert counters["rate_limited"] == 500 - len(kept)
    assert counters["dropped"] == 0
