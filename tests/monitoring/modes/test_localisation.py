"""Variances of a pose, given as three variables, as a whole covariance, or as an item."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Input
from amberbox.monitoring.modes import localisation as mode
from amberbox.monitoring.modes.localisation import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

PARTS = {f"pose_covariance_{place}": "float" for place in (0, 7, 35)}


def three(x: float | None, y: float | None, theta: float | None) -> list[Input]:
    return [one_input(times_s=[0], values=[v]) for v in (x, y, theta)]


def test_contract() -> None:
    configs = [Config(avg_variance_threshold=10.0)]
    assert_mode_contract(mode, "localisation", configs=configs, parts=PARTS)


@pytest.mark.parametrize(
    ("variances", "expected"),
    [((0.002, 0.003, 0.01), TRUE), ((0.01, 0.01, 0.01), FALSE), ((0.002, 0.002, 0.5), FALSE),
     ((nan, 0.001, 0.001), FALSE), ((inf, 0.001, 0.001), FALSE), ((-0.1, 0.001, 0.001), FALSE),
     ((0.0, 0.0, 0.0), UNKNOWN), ((None, 0.001, 0.001), UNKNOWN)],
)  # fmt: skip
def test_the_mean_counts_and_nonsense_is_not_localised(variances: Any, expected: int) -> None:
    assert int(mode.evaluate(Config(), three(*variances), at_s(0))["localised"]) == expected


def test_a_whole_covariance_and_an_item_mean_the_same() -> None:
    columns = {f"pose_covariance_{k}": [k / 1000 + 0.001] for k in range(36)}
    whole = [one_input(times_s=[0], values=v) for v in columns.values()]
    item = one_input("/amcl_pose", times_s=[0], parts=columns)
    config = Config(avg_variance_threshold=0.02)
    found = [mode.evaluate(config, inputs, at_s(0)) for inputs in (whole, [item])]
    for results in found:
        assert int(results["localised"]) == TRUE
        variances = [results[f"variance_{axis}"] for axis in ("x", "y", "theta")]
        assert variances == pytest.approx([0.001, 0.008, 0.036])


def test_an_item_without_a_covariance_is_unknown_and_never_well() -> None:
    found = mode.evaluate(Config(), [one_input("/odom", times_s=[0])], at_s(0))
    assert int(found["localised"]) == UNKNOWN
    assert np.isnan(found["variance_x"])


def test_a_kidnapped_robot_is_seen_as_its_variance_grows() -> None:
    grown = [0.001 * 1.5**k for k in range(10)]
    inputs = [one_input(times_s=range(10), values=grown) for _ in range(3)]
    found = mode.evaluate(Config(), inputs, at_s(*range(10)))["localised"].tolist()
    assert found == [TRUE] * 6 + [FALSE] * 4


def test_explanation() -> None:
    uncertain = dict.fromkeys(("variance_x", "variance_y", "variance_theta"), 0.1)
    text = mode.explain(Config(), {"localised": False, **uncertain})
    assert text == "the mean variance is 0.1, less than 0.01 expected"
    missing: dict[str, Any] = {"variance_x": None, "variance_y": 1.0, "variance_theta": 1.0}
    assert mode.explain(Config(), {"localised": False, **missing}) == "a variance is no number"


def test_a_threshold_that_nothing_is_below_is_refused() -> None:
    assert list(Config(avg_variance_threshold=0.0).check())
