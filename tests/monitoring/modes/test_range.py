"""Limits, values that are not numbers, and hysteresis."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

from amberbox.core.expression import variable_text
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Given
from amberbox.monitoring.modes import range as mode
from amberbox.monitoring.modes.range import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    configs = [Config(min=0), Config(min=-3, max=50, hysteresis=2)]
    assert_mode_contract(mode, "range", configs=configs, text=True)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *[(0, TRUE), (10, TRUE), (5.5, TRUE), (-0.1, FALSE), (10.1, FALSE)],
        *[(nan, FALSE), (inf, FALSE), (-inf, FALSE), (None, UNKNOWN)],
    ],
)
def test_limits(value: float | None, expected: int) -> None:
    entry = one_input(times_s=[1], values=[value])
    assert int(mode.evaluate(Config(min=0, max=10), [entry], at_s(1))["in_range"]) == expected


def test_near_a_limit_it_stays_what_it_was() -> None:
    entry = one_input(times_s=[0, 1, 2, 3], values=[70.0, 81.0, 77.0, 75.0])
    found = mode.evaluate(Config(max=80, hysteresis=5), [entry], at_s(0, 1, 2, 3))
    assert found["in_range"].tolist() == [TRUE, FALSE, HOLD, TRUE]
    assert found["value"].tolist() == [70, 81, 77, 75]


def test_a_limit_as_it_is_written_belongs_to_the_range_in_single_precision_too() -> None:
    entry = one_input(times_s=[0], values=np.array([0.1], np.float32))
    assert int(mode.evaluate(Config(max=0.1), [entry], at_s(0))["in_range"]) == TRUE


@pytest.mark.parametrize(
    "config", [Config(), Config(min=2, max=1), Config(min=0, max=1, hysteresis=0.6),
               Config(max=1, hysteresis=-1)]
)  # fmt: skip
def test_limits_that_say_nothing_are_refused(config: Config) -> None:
    assert list(config.check())


def test_the_reason_has_value_unit_and_the_limit_that_was_crossed() -> None:
    config, entry = Config(min=5, max=50), one_input(times_s=[0, 1, 2], values=[58.2, 3.0, nan])
    hot, cold, none = (Given([entry], int(now), "°C") for now in at_s(0, 1, 2))
    name = variable_text(entry.name)
    assert mode.reason(config, hot) == f"{name} is 58.2 °C, at most 50"
    assert mode.reason(config, cold) == f"{name} is 3 °C, at least 5"
    assert mode.reason(config, none) == f"{name} is no number"
    assert mode.reason(Config(max=60), hot) == ""


def test_a_text_is_no_number_in_the_reason_either() -> None:
    entry = one_input(times_s=[0], values=["E-STOP"])
    assert mode.reason(Config(max=1), Given([entry], int(at_s(0)))).endswith("is no number")
