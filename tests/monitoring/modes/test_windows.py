"""The rules of docs/robot/windows.md hold on streams that are late, early and lossy."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from amberbox.core.mode import FALSE, Input
from amberbox.monitoring.modes import frozen, heartbeat, rate_of_change, redundancy
from amberbox.testing.modes import at_s, one_input
from tools.findings import ROOT

PAGE = (ROOT / "docs" / "robot" / "windows.md").read_text(encoding="utf-8")
MESSAGES = 2000
BEGINS = 1500  # message at which the fault begins, where there is one
JITTER, LOST = 0.3, 0.02
NOISE = 0.1
RATES = pytest.mark.parametrize("rate_hz", [1.0, 10.0, 50.0])


def times_s(rate_hz: float, seed: int = 1, until: int = MESSAGES) -> np.ndarray[Any, Any]:
    """Return when messages of a rate come: early or late by a part of a period, a few lost."""
    random = np.random.default_rng(seed)
    times = (np.arange(until) + random.uniform(-JITTER, JITTER, until)) / rate_hz + 1
    return times[random.random(until) >= LOST]


def stream(times: np.ndarray[Any, Any], values: Any = ()) -> Input:
    return one_input("x", times_s=times.tolist(), values=values)


def faults_s(
    mode: ModuleType, config: Any, inputs: list[Input], result: str, rate_hz: float
) -> np.ndarray[Any, Any]:
    """Return the instants at which a result is bad, twice for each message."""
    instants = np.arange(0.5, MESSAGES, 0.5) / rate_hz + 1
    found = mode.evaluate(config, inputs, at_s(*instants))[result]
    bad: np.ndarray[Any, Any] = instants[np.asarray(found) == FALSE]
    return bad


def test_the_page_has_these_rules() -> None:
    for text in ("4 / rate", "20 / rate", "5 / rate", "7 x noise", "at least 2 / rate"):
        assert text in PAGE
    assert "one in fifty" in PAGE and "30 %" in PAGE


def beats(
    rate_hz: float, window: float = 20.0, max_age: float = 4.0, tolerance: float = 30.0
) -> heartbeat.Config:
    return heartbeat.Config(
        rate=rate_hz, tolerance=tolerance, window=window / rate_hz, max_age=max_age / rate_hz
    )


@RATES
def test_heartbeat(rate_hz: float) -> None:
    well = [stream(times_s(rate_hz))]
    assert not len(faults_s(heartbeat, beats(rate_hz), well, "alive", rate_hz))
    assert len(faults_s(heartbeat, beats(rate_hz, max_age=1.5), well, "heard", rate_hz))
    assert len(faults_s(heartbeat, beats(rate_hz, 10, 4, 0), well, "often_enough", rate_hz))
    begin_s = BEGINS / rate_hz + 1
    silent = [stream(times_s(rate_hz, until=BEGINS))]
    found = faults_s(heartbeat, beats(rate_hz), silent, "heard", rate_hz)
    assert begin_s < found[0] <= begin_s + 4.5 / rate_hz
    times = times_s(rate_hz)
    half = times[(times < begin_s) | (np.arange(len(times)) % 2 == 0)]
    slow = faults_s(heartbeat, beats(rate_hz), [stream(half)], "alive", rate_hz)
    assert begin_s < slow[0] <= begin_s + 20.5 / rate_hz


@RATES
def test_frozen(rate_hz: float) -> None:
    times = times_s(rate_hz)
    random = np.random.default_rng(2)
    values = np.round(random.normal(0, NOISE, len(times)), 1)  # may stay the same for a while
    held_s = longest_s(times, values)
    window_s = max(5 / rate_hz, 5 * held_s)
    well = [stream(times, values)]
    config = frozen.Config(window=window_s)
    assert not len(faults_s(frozen, config, well, "moving", rate_hz))
    short = frozen.Config(window=held_s / 2)
    assert len(faults_s(frozen, short, well, "moving", rate_hz))
    begin_s = BEGINS / rate_hz + 1
    stuck = np.where(times < begin_s, values, 7.0)
    found = faults_s(frozen, config, [stream(times, stuck)], "moving", rate_hz)
    assert begin_s < found[0] <= begin_s + window_s + 3 / rate_hz


def longest_s(times: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> float:
    """Return the longest time in which a value stays the same."""
    changes = times[np.flatnonzero(np.diff(values)) + 1]
    return float(np.max(np.diff(changes)))


@RATES
def test_rate_of_change(rate_hz: float) -> None:
    times = times_s(rate_hz)
    usual, limit = 0.1 * rate_hz, 0.5 * rate_hz  # per second
    window_s = max(7 * NOISE / (limit - usual), 2 / rate_hz)
    begin_s = BEGINS / rate_hz + 1
    noise = np.random.default_rng(3).normal(0, NOISE, len(times))
    rising = noise + usual * times
    well = [stream(times, rising)]
    config = rate_of_change.Config(max=limit, window=window_s)
    assert not len(faults_s(rate_of_change, config, well, "in_limits", rate_hz))
    noisy = rate_of_change.Config(max=limit, window=window_s / 3)
    assert len(faults_s(rate_of_change, noisy, [stream(times, 3 * noise)], "in_limits", rate_hz))
    fast = rising + 2 * (limit - usual) * np.maximum(0, times - begin_s)
    found = faults_s(rate_of_change, config, [stream(times, fast)], "in_limits", rate_hz)
    assert begin_s < found[0] <= begin_s + window_s + 3 / rate_hz


@RATES
def test_redundancy(rate_hz: float) -> None:
    times = times_s(rate_hz)
    random = np.random.default_rng(4)
    values = [random.normal(0, NOISE, len(times)) for _ in range(3)]
    values[0][random.random(len(times)) < 0.01] += 10  # single bad samples
    well = [stream(times, one) for one in values]
    config = redundancy.Config(threshold=1.0, window=5 / rate_hz)
    assert not len(faults_s(redundancy, config, well, "agree", rate_hz))
    bare = redundancy.Config(threshold=1.0)
    assert len(faults_s(redundancy, bare, well, "agree", rate_hz))
    begin_s = BEGINS / rate_hz + 1
    off = [stream(times, values[0] + 3 * (times >= begin_s)), *well[1:]]
    found = faults_s(redundancy, config, off, "agree", rate_hz)
    assert begin_s < found[0] <= begin_s + 4 / rate_hz
