"""The schedule of a source: in step, off it, and what does not move it."""

from __future__ import annotations

import numpy as np
import pytest

from amberbox.detection.schedule import Schedule, usual_off
from amberbox.testing.detectors import T0_NS

PERIOD_NS = 25_000_000


def steady(count: int = 400, faster: float = 1.0) -> list[int]:
    random = np.random.default_rng(0)
    late_ns = np.abs(random.normal(0, 0.03 * PERIOD_NS, count))
    return [T0_NS + round(i * PERIOD_NS / faster + late) for i, late in enumerate(late_ns)]


def followed(times_ns: list[int]) -> list[float]:
    schedule = Schedule(PERIOD_NS / 1e9)
    return [schedule.take(at_ns) for at_ns in times_ns]


def test_half_a_period_later_is_off_schedule_within_a_few_messages() -> None:
    times = steady()
    later = times[:200] + [at + PERIOD_NS // 2 for at in times[200:]]
    off = followed(later)
    assert max(off[:200]) < 0.05
    assert off[200] > 0.15 and off[205] > 0.6


@pytest.mark.parametrize(
    "times",
    [
        pytest.param(steady(faster=1.001), id="a clock that runs fast"),
        pytest.param(steady()[:100] + steady()[103:], id="messages that are missing"),
        pytest.param(steady()[:100] + steady()[300:], id="a long gap"),
        pytest.param([*steady(), steady()[-1] - 3600 * 10**9], id="a step of the clock"),
    ],
)
def test_what_keeps_its_period_is_in_step(times: list[int]) -> None:
    assert max(followed(times)) < 0.1


def test_messages_of_a_stall_do_not_move_the_schedule() -> None:
    times = steady()
    stalled = [max(at, times[200]) if 195 <= i < 200 else at for i, at in enumerate(times)]
    off = followed(stalled)
    assert max(off[225:]) < 0.05


def test_messages_at_random_have_no_schedule() -> None:
    random = np.random.default_rng(0)
    times = (T0_NS + np.cumsum(random.exponential(PERIOD_NS, 500)).astype(np.int64)).tolist()
    assert usual_off(PERIOD_NS / 1e9, [times]) is None
    assert usual_off(PERIOD_NS / 1e9, [steady()]) is not None


def test_a_snapshot_continues_with_the_same_numbers() -> None:
    times = steady()
    whole = followed(times)
    schedule = Schedule(PERIOD_NS / 1e9)
    for at_ns in times[:100]:
        schedule.take(at_ns)
    resumed = Schedule(PERIOD_NS / 1e9)
    resumed.resume(schedule.snapshot())
    assert [resumed.take(at_ns) for at_ns in times[100:]] == whole[100:]
    with pytest.raises(ValueError, match="a period above 0"):
        resumed.resume([None, -1.0, 0.0])
