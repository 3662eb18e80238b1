"""Rates are learned from steady topics, and from nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from amberbox.agent.commissioning.rate import learn_rate
from amberbox.core.clock import NS

LENGTH_S = 20.0


def received(times_s: np.typing.ArrayLike) -> list[int]:
    return [int(time_s * NS) for time_s in np.sort(np.asarray(times_s, float))]


@pytest.mark.parametrize("rate_hz", [0.4, 1.0, 9.7, 50.0, 400.0])
def test_a_steady_topic(rate_hz: float) -> None:
    random = np.random.default_rng(7)
    times = np.arange(0.0, LENGTH_S, 1 / rate_hz)
    found = learn_rate(received(times + random.uniform(0, 0.2 / rate_hz, len(times))), 20 * NS)
    assert found is not None
    assert found.mean_hz == pytest.approx(rate_hz, rel=0.05)
    assert 0.75 * rate_hz <= found.low_hz <= found.mean_hz


def test_the_low_rate_is_that_of_slow_windows() -> None:
    times = [*np.arange(0, 10, 0.1), *np.arange(10, 20, 0.15)]
    found = learn_rate(received(times), 20 * NS)
    assert found is not None and found.low_hz == pytest.approx(6.8, abs=0.3)


@pytest.mark.parametrize(
    "times",
    [
        [],
        [0, 5, 10, 15],  # too few to tell
        [3.0] * 9,  # all at once
        [0, 0.1, 0.2, 5, 5.1, 5.2, 11, 11.1, 18],  # events
        np.arange(0, 8, 0.1),  # it has stopped
        np.random.default_rng(3).uniform(0, 20, 40),
    ],
)
def test_what_has_no_rate(times: np.typing.ArrayLike) -> None:
    assert learn_rate(received(times), 20 * NS) is None


def test_a_hiccup_of_the_listener_is_no_event() -> None:
    times = np.arange(0, 20, 0.02)
    assert learn_rate(received(times[(times < 9) | (times > 9.4)]), 20 * NS) is not None
