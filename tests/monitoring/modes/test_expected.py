"""Numbers, bools, texts and names of values are compared in their written form."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest

from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.mode import FALSE, TRUE, UNKNOWN
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.monitoring.modes import expected
from amberbox.monitoring.modes.expected import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    configs = [Config(equals=2), Config(matches="^o"), Config(one_of=(True, "ok", 2.5))]
    assert_mode_contract(expected, "expected", configs=configs, text=True)


@pytest.mark.parametrize(
    ("config", "value", "verdict"),
    [
        (Config(equals=3), 3.0, TRUE),
        (Config(equals=3), 4, FALSE),
        (Config(equals=3.0), 3, TRUE),
        (Config(equals=True), True, TRUE),
        (Config(equals=True), False, FALSE),
        (Config(equals="IDLE"), "IDLE", TRUE),
        (Config(equals="IDLE"), "idle", FALSE),
        (Config(equals=3), "3", TRUE),
        (Config(one_of=("IDLE", "ACTIVE")), "ACTIVE", TRUE),
        (Config(one_of=(1, 2)), nan, FALSE),
        (Config(matches="^(IDLE|ACTIVE)$"), "IDLE", TRUE),
        (Config(matches="error"), "no errors", TRUE),
        (Config(matches="error"), "fine", FALSE),
        (Config(equals=1), None, UNKNOWN),
    ],
)
def test_values(config: Config, value: Any, verdict: int) -> None:
    entry = one_input(times_s=[0], values=[value])
    found = expected.evaluate(config, [entry], at_s(0))
    assert int(found["as_expected"]) == verdict


def test_names_of_values() -> None:
    state = one_input(times_s=[0, 1, 2], values=[0, 4, 9], labels={0: "IDLE", 4: "ABORTED"})
    found = expected.evaluate(Config(one_of=("IDLE", 9)), [state], at_s(0, 1, 2))
    assert found["as_expected"].tolist() == [TRUE, FALSE, TRUE]
    assert found["value"].tolist() == ["IDLE", "ABORTED", "9"]
    pattern = expected.evaluate(Config(matches="ABORT"), [state], at_s(0, 1, 2))
    assert pattern["as_expected"].tolist() == [FALSE, TRUE, FALSE]


def test_single_precision_is_compared_as_it_is_written() -> None:
    entry = one_input(times_s=[0], values=np.array([0.1], np.float32))
    assert int(expected.evaluate(Config(equals=0.1), [entry], at_s(0))["as_expected"]) == TRUE


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (Config(equals=3), "is 4, should be 3"),
        (Config(one_of=("a", True)), "is 4, should be a or true"),
        (Config(matches="^x"), "is 4, should be like ^x"),
    ],
)
def test_explanations(config: Config, text: str) -> None:
    assert expected.explain(config, {"as_expected": False, "value": "4"}) == text
    assert expected.explain(config, {"as_expected": None, "value": None}) == ""


@pytest.mark.parametrize("text", ["{}", "{equals: 1, matches: a}", "{matches: '('}"])
def test_what_says_nothing_is_refused(text: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(text, "f", problems)
    assert node is not None
    assert build(Config, node, problems) is None
    assert len(problems) == 1


def test_zero_and_false_are_values_too() -> None:
    assert not list(Config(equals=0).check())
    assert not list(Config(equals=False).check())
