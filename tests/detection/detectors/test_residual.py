"""Residuals: systems whose answer is known, faults between a command and its response."""

from __future__ import annotations

import numpy as np
import pytest

from amberbox.core.errors import AmberboxError
from amberbox.detection.detectors import residual
from amberbox.detection.detectors.residual import Config, Detector, PairOptions
from amberbox.testing.detectors import GivenMission, mission, rows_of, run_detector

DRIVE = PairOptions("wheel.speed", ("command.speed",))


def drive(seed: int, *, stuck_at_s: float = 1e9, seconds: float = 60.0) -> GivenMission:
    """Return commands at 5 Hz, and a wheel at 20 Hz that follows them at 0.8 times the speed."""
    random = np.random.default_rng(seed)
    command_s = np.arange(0, seconds, 0.2)
    command = np.repeat(random.uniform(-1, 1, len(command_s) // 10 + 1), 10)[: len(command_s)]
    wheel_s = np.arange(0.05, seconds, 0.05)
    wanted = command[np.searchsorted(command_s, np.minimum(wheel_s, stuck_at_s), side="right") - 1]
    speed = 0.8 * wanted + random.normal(0, 0.02, len(wheel_s))
    return mission(
        [
            *rows_of("command", command_s, {"speed": command}),
            *rows_of("wheel", wheel_s, {"speed": speed}),
        ]
    )


def chain(seed: int, *, broken_at: int = 10**9, count: int = 3000) -> GivenMission:
    """Return x, y, z of one item: y follows the last x, z is noise, until y no longer follows."""
    random = np.random.default_rng(seed)
    x = np.zeros(count)
    for i in range(1, count):
        x[i] = 0.9 * x[i - 1] + random.normal()
    y = 2 * np.concatenate([[0.0], x[:-1]]) + random.normal(0, 0.2, count)
    y[broken_at:] = random.permutation(y[broken_at:])
    values = {"x": x, "y": y, "z": random.normal(5, 1, count)}
    return mission(rows_of("robot", np.arange(count) * 0.1, values))


def scores(detector: Detector, given: GivenMission, series: str) -> np.ndarray:
    found = run_detector(detector, given.rows)
    return np.array([s.value for some in found for s in some if s.series == series])


def test_a_wheel_that_no_longer_follows_its_command_is_seen() -> None:
    """Its speed stays in its usual range, so that no limit and no other variable could tell."""
    detector = Detector(Config(regression=False, pairs=(DRIVE,)))
    detector.fit([drive(1), drive(2)])
    calm = scores(detector, drive(3), "wheel.speed")
    broken = scores(detector, drive(3, stuck_at_s=30.0), "wheel.speed")
    reason = detector.explain("wheel.speed")
    assert broken[: len(broken) // 2] == pytest.approx(calm[: len(broken) // 2])
    assert broken[len(broken) // 2 :].max() > 5 > calm[100:].max()
    assert (reason.finding, reason.item, reason.variable) == ("pair", "wheel", "speed")


def test_least_squares_find_the_gain_of_a_pair() -> None:
    pair = PairOptions("wheel.speed", ("command.speed",), input_lags=1, output_lags=0)
    detector = Detector(Config(regression=False, pairs=(pair,)))
    detector.fit([drive(1)])
    theta = detector.learnt().values["pairs"][0]["theta"]
    channels = detector._channels
    gain = theta[1] * channels.spread[1] / channels.spread[0]
    assert channels.names == (("command", "speed"), ("wheel", "speed"))
    assert gain == pytest.approx(0.8, abs=0.02)


def test_residuals_of_nominal_missions_are_white() -> None:
    """Whitened residuals have the variance 1, and do not depend on each other."""
    detector = Detector(Config(smoothing=1.0))
    detector.fit([chain(1), chain(2)])
    regression = detector._regressions["robot"]
    detector.begin(0)
    white = []
    for row in chain(3).rows:
        read = detector._read(row)
        if read is not None and read.regressors is not None:
            left = read.values - read.regressors @ regression.coefficients
            white.append(regression.whitening @ left)
    covariance = np.cov(np.array(white).T)
    assert covariance == pytest.approx(np.eye(3), abs=0.12)


def test_the_variable_that_breaks_a_relation_is_named() -> None:
    detector = Detector(Config())
    detector.fit([chain(1), chain(2)])
    broken = scores(detector, chain(3, broken_at=1500), "robot")
    reason = detector.explain("robot")
    assert broken[1600:].mean() > 3 * broken[100:1500].mean()
    assert (reason.finding, reason.variable) == ("regression", "y")
    assert reason.contributions[0][0] == "robot.y"
    assert sum(share for _, share in reason.contributions) == pytest.approx(1)


def test_a_fault_is_not_learnt_as_normal() -> None:
    """A gain that changes for good is learnt far more slowly than it is noticed."""
    detector = Detector(Config(regression=False, pairs=(DRIVE,)))
    detector.fit([drive(1), drive(2)])
    stuck = scores(detector, drive(4, stuck_at_s=20.0, seconds=120.0), "wheel.speed")
    assert stuck[800:].max() > 5  # still seen in the second minute


def test_after_a_gap_there_is_no_score_and_it_is_counted() -> None:
    detector = Detector(Config())
    detector.fit([chain(1)])
    rows = chain(2).rows[:200]
    late = [
        row if i < 100 else row._replace(at_ns=row.at_ns + 10**10) for i, row in enumerate(rows)
    ]
    found = run_detector(detector, late)
    assert len([s for some in found for s in some]) == 200 - 2
    assert detector.counts == {"messages after a gap longer than learnt, without a score": 1}


def test_an_input_that_is_not_there_is_told() -> None:
    detector = Detector(Config(pairs=(PairOptions("wheel.speed", ("command.sped",)),)))
    with pytest.raises(AmberboxError, match=r"'command.sped'; did you mean 'command.speed'"):
        detector.fit([drive(1)])


def test_hundreds_of_variables_are_bounded_and_counted() -> None:
    random = np.random.default_rng(0)
    values = {f"v{n:03}": random.normal(0, 1, 30) for n in range(250)}
    many = mission(rows_of("robot", np.arange(30) * 0.1, values))
    detector = Detector(Config(pairs=(PairOptions("robot.v249", ("robot.v248",)),)))
    detector.fit([many])
    assert detector.counts["variables beyond 200"] == 50
    assert {series for some in run_detector(detector, many.rows) for _, series, _ in some} == {
        "robot",
        "robot.v249",
    }


def test_options_out_of_range_are_told() -> None:
    config = residual.ResidualOptions(
        lags=0, ridge=0, forget=0.5, smoothing=2, pairs=(DRIVE, DRIVE)
    )
    found = [finding[0] for finding in config.check()]
    assert found == ["lags", "ridge", "forget", "smoothing", "pairs"]
    pair = PairOptions("a.b", ("a.b",), input_lags=0, output_lags=-1)
    assert [finding[0] for finding in pair.check()] == ["inputs", "input_lags", "output_lags"]
