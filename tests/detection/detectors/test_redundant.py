"""Redundant groups: wheels, one of which is frozen, slips, is mirrored, or is at rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from amberbox.core.errors import AmberboxError
from amberbox.detection.detectors.redundant import Config, Detector, GroupOptions
from amberbox.testing.detectors import GivenMission, mission, rows_of, run_detector

Change = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
RATIOS = {"a": 1.0, "b": -1.0, "c": 1.0, "d": -2.0}  # two turn the other way, one is smaller


def group(names: str = "abcd", moves: float | None = None) -> Config:
    members = {name: (f"{name}.speed", f"{name}.current") for name in names}
    return Config(groups={"wheels": GroupOptions(members, moves)})


def wheels(
    seed: int, change: Change | None = None, odd: str = "c", names: str = "abcd", pace: float = 1.0
) -> GivenMission:
    """Return 60 s of wheels at 10 Hz, each at instants of its own; one changes at 30 s."""
    random = np.random.default_rng(seed)
    rows = []
    for name in names:
        times = np.arange(0, 60, 0.1) + random.uniform(0, 0.05)
        motion = pace * (np.sin(times / 3) + 1.5)
        speed = RATIOS[name] * motion + random.normal(0, 0.02, len(times))
        current = 0.5 * motion + random.normal(0, 0.05, len(times))
        if change is not None and name == odd:
            speed = np.where(times < 30, speed, change(times, speed))
        rows += rows_of(name, times, {"speed": speed, "current": current})
    return mission(rows)


def frozen(times: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(values, values[300])


def slow(times: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.7 * values


def garbage(times: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.arange(len(values)) % 2, 1e9, values)


def fitted(config: Config, names: str = "abcd") -> Detector:
    detector = Detector(config)
    detector.fit([wheels(1, names=names), wheels(2, names=names)])
    return detector


def halves(detector: Detector, given: GivenMission) -> tuple[float, float]:
    """Return the greatest scores before and after the half."""
    half_ns = given.rows[0].at_ns + 30 * 10**9
    found = [s for some in run_detector(detector, given.rows) for s in some]
    before = [s.value for s in found if s.at_ns < half_ns]
    return max(before), max(s.value for s in found if s.at_ns >= half_ns)


@pytest.mark.parametrize("change", [frozen, slow, garbage])
@pytest.mark.parametrize("odd", ["a", "d"])
def test_the_odd_wheel_is_found_and_is_the_conflict(change: Change, odd: str) -> None:
    detector = fitted(group())
    before, after = halves(detector, wheels(5, change, odd))
    assert after > 5 > before
    reason = detector.explain("wheels")
    assert (reason.finding, reason.item, reason.variable) == ("odd_one_out", odd, "speed")
    assert reason.suspects == (odd,)
    assert reason.contributions[0][0] == odd


def test_of_two_members_either_may_be_faulty() -> None:
    detector = fitted(group("ab"), "ab")
    before, after = halves(detector, wheels(5, slow, "b", "ab"))
    assert after > 5 > before
    assert detector.explain("wheels").suspects == ("a", "b")


def test_a_group_at_rest_is_not_compared() -> None:
    """All wheels stand, and one of them reports a tenth of its usual speed."""
    detector = fitted(group())

    def creeps(times: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values + 0.25

    assert not any(run_detector(detector, wheels(5, creeps, pace=0.0).rows))


def test_the_ratio_of_each_member_is_learnt() -> None:
    found = fitted(group()).learnt().arrays["0_gain"][:, 0]
    assert found == pytest.approx([1 / RATIOS[name] for name in "abcd"], abs=0.01)


def test_a_member_that_sends_nothing_usable_is_left_out_and_counted() -> None:
    detector = fitted(group())
    _, after = halves(detector, wheels(5, lambda times, values: np.full_like(values, np.nan)))
    assert after < 5
    assert detector.counts["values of members that are missing or not finite"] == 300


def test_a_member_that_fell_silent_while_the_others_move_is_the_odd_one() -> None:
    detector = fitted(group())
    rows = [row for i, row in enumerate(wheels(5).rows) if row.item != "c" or i < 1200]
    found = [s.value for some in run_detector(detector, rows) for s in some]
    assert max(found[1300:]) > 5
    assert detector.explain("wheels").suspects == ("c",)


def test_groups_that_cannot_be_learnt_are_told() -> None:
    with pytest.raises(AmberboxError, match="never moves"):
        fitted(group(moves=100.0))
    with pytest.raises(AmberboxError, match=r"'c.speed'; did you mean '[ab].speed'"):
        fitted(group("abc"), "ab")
    alone = GroupOptions({"a": ("a.speed",)}, moves=-1.0)
    assert [finding[0] for finding in alone.check()] == ["members", "moves"]
    uneven = GroupOptions({"a": ("a.speed", "a.current"), "b": ()})
    assert len(list(uneven.check())) == 2
