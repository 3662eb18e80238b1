"""How fast a value changes, with what a change filter left out and with angles."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Given
from amberbox.monitoring.modes import rate_of_change as mode
from amberbox.monitoring.modes.rate_of_change import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

LEAK = Config(min=-0.2, max=0.2, window=2)


def test_contract() -> None:
    configs = [Config(max=3), Config(min=-1, max=1, turn=6.2832)]
    assert_mode_contract(mode, "rate_of_change", configs=configs, text=True)


def test_a_ramp() -> None:
    times = np.arange(0, 10, 0.1)
    entry = one_input(times_s=times.tolist(), values=8 - 0.5 * np.maximum(times - 5, 0))
    found = mode.evaluate(LEAK, [entry], at_s(1, 5, 5.5, 6, 9))
    assert found["in_limits"].tolist() == [UNKNOWN, TRUE, TRUE, FALSE, FALSE]
    assert found["rate"][-1] == pytest.approx(-0.5)
    assert "-0.5 per second" in mode.explain(LEAK, {"in_limits": False, "rate": -0.5})
    told = mode.reason(LEAK, Given([entry], int(at_s(9)), "bar/s"))
    assert told.endswith("changes by -0.5 bar/s, at least -0.2")
    assert mode.reason(LEAK, Given([entry], int(at_s(5)))) == ""


def test_a_value_that_was_filtered_since_it_did_not_change_has_rate_0() -> None:
    entry = one_input(times_s=[0], values=[8.0])
    found = mode.evaluate(LEAK, [entry], at_s(4))
    assert (int(found["in_limits"]), float(found["rate"])) == (TRUE, 0.0)


def test_a_spike_is_seen_when_it_comes() -> None:
    entry = one_input(times_s=[0, 1, 2, 3, 3.1, 4], values=[5, 5, 5, 90, 5, 5])
    found = mode.evaluate(LEAK, [entry], at_s(2.95, 3.05, 3.2))
    assert found["in_limits"].tolist() == [TRUE, FALSE, TRUE]


@pytest.mark.parametrize("value", [nan, None])
def test_what_is_no_number_has_no_rate(value: float | None) -> None:
    entry = one_input(times_s=[0, 3], values=[5.0, value])
    assert int(mode.evaluate(LEAK, [entry], at_s(3))["in_limits"]) == UNKNOWN


def test_an_angle_does_not_jump_where_a_turn_ends() -> None:
    entry = one_input(times_s=[0, 1, 2], values=[170.0, 178.0, -174.0])
    config = Config(min=-10, max=10, turn=360)
    found = mode.evaluate(config, [entry], at_s(2))
    assert float(found["rate"]) == pytest.approx(8)
    assert int(found["in_limits"]) == TRUE


def test_small_whole_numbers_may_fall() -> None:
    entry = one_input(times_s=[0, 1], values=np.array([3, 1], np.uint8))
    found = mode.evaluate(Config(min=-1), [entry], at_s(1))
    assert (float(found["rate"]), int(found["in_limits"])) == (-2, FALSE)


@pytest.mark.parametrize(
    "config", [Config(), Config(min=2, max=1), Config(max=1, window=0), Config(max=1, turn=-1)]
)
def test_limits_that_say_nothing_are_refused(config: Config) -> None:
    assert list(config.check())
