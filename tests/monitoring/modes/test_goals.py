"""Goals of an action server: one that failed counts while it is listed, and a while after."""

from __future__ import annotations

import numpy as np
import pytest

from amberbox.core.flow import Flow
from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Given, Input
from amberbox.monitoring.modes import goals as mode
from amberbox.monitoring.modes.goals import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    parts = {"status": "int", "success": "bool"}
    assert_mode_contract(mode, "goals", parts=parts, examples=40)


def test_a_goal_that_failed_counts_for_the_window() -> None:
    entry = one_input(
        "list", times_s=[0, 1, 2, 3], values=[1, 2, 3, 4], parts={"status": [1, 1, 4, 3]}
    )
    found = mode.evaluate(Config(window=5.0), [entry], at_s(0, 1, 2, 6, 7))
    assert found["none_failed"].tolist() == [UNKNOWN, TRUE, FALSE, FALSE, TRUE]
    assert found["listed"].tolist() == [0, 0, 1, 1, 0]


def test_a_server_that_never_had_a_goal_is_well() -> None:
    idle = Input("list", flow=Flow(began_ns=0))
    found = mode.evaluate(Config(), [idle], np.array([0, 2_000_000_000]))
    assert found["none_failed"].tolist() == [UNKNOWN, TRUE]


def test_of_several_servers_the_one_that_failed_is_named() -> None:
    well, bad = (
        one_input(name, times_s=[0], values=[1], parts={"status": [status]})
        for name, status in (("drive", 3), ("lift", 4))
    )
    why = mode.reason(Config(), Given([well, bad], at_s(1)))
    assert why == "goals of lift failed within the last 10 s"


def test_a_call_that_was_answered_without_success_counts_for_the_window() -> None:
    answers = {"success": [True, False, True]}
    entry = one_input("answers", times_s=[0, 1, 2], values=[1, 2, 3], parts=answers)
    config = Config(of="calls", window=5.0)
    found = mode.evaluate(config, [entry], at_s(0, 1, 2, 5, 6))
    assert found["none_failed"].tolist() == [UNKNOWN, FALSE, FALSE, FALSE, TRUE]
    assert mode.explain(config, {"none_failed": False}) == "a call failed within the last 5 s"


def test_explanations() -> None:
    assert "10 s" in mode.explain(Config(), {"none_failed": False})
    assert mode.explain(Config(), {"none_failed": None}) == ""


@pytest.mark.parametrize("config", [Config(failed=()), Config(window=0)])
def test_what_never_holds_is_refused(config: Config) -> None:
    assert list(config.check())
