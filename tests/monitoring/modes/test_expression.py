"""Conditions and numbers in the language of expressions, with history, over inputs."""

from __future__ import annotations

import numpy as np
import pytest

from amberbox.core.expression import parse
from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Input
from amberbox.monitoring.modes import expression as mode
from amberbox.monitoring.modes.expression import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

HOT = Config(condition=parse("not (motor.temperature > 80 for 2s)"))


def test_contract() -> None:
    assert_mode_contract(mode, "expression", examples=40)


def temperature(*values: float | None) -> Input:
    return one_input("motor.temperature", times_s=range(len(values)), values=values)


def test_a_condition_with_history() -> None:
    entry = temperature(70, 90, 90, 90, 70)
    found = mode.evaluate(HOT, [entry], at_s(0, 1, 2, 2.95, 3, 3.5, 4))["holds"].tolist()
    assert found == [TRUE, TRUE, TRUE, TRUE, FALSE, FALSE, TRUE]
    assert mode.history_s(HOT) == 2.0


def test_unknown_is_not_false() -> None:
    config = Config(condition=parse("motor.temperature < 80"))
    found = mode.evaluate(config, [temperature(70, None, 90)], at_s(0, 1, 2))["holds"]
    assert found.tolist() == [TRUE, UNKNOWN, FALSE]


def test_a_number_over_inputs_and_addresses() -> None:
    config = Config(number=parse("input_1 * a.b + mean(input_2 over 2s)"))
    assert mode.reads(config) == ("a.b",)
    inputs = [temperature(2, 3), one_input(times_s=[0, 1], values=[10.0, 20.0]), temperature(5, 5)]
    found = mode.evaluate(config, inputs, at_s(0, 1))
    assert found["value"].tolist() == [20.0, 30.0]
    assert list(found) == ["value"]


def test_texts_are_compared() -> None:
    config = Config(condition=parse("mode.name == 'AUTO'"))
    entry = one_input(times_s=[0, 1, 2], values=["AUTO", "MANUAL", None])
    assert mode.evaluate(config, [entry], at_s(0, 1, 2))["holds"].tolist() == [
        TRUE, FALSE, UNKNOWN
    ]  # fmt: skip


def test_only_what_is_asked_for_is_a_result() -> None:
    assert [r.name for r in mode.results_of(HOT, 0, 1)] == ["holds"]
    both = Config(condition=parse("a > 1"), number=parse("a"))
    assert [r.name for r in mode.results_of(both, 0, 1)] == ["holds", "value"]


def test_one_instant_gives_what_many_give() -> None:
    entry = temperature(*np.linspace(60, 100, 20).tolist())
    config = Config(condition=HOT.condition, number=parse("std(motor.temperature over 5s)"))
    instants = at_s(*(k / 4 for k in range(80)))
    many = mode.evaluate(config, [entry], instants)
    for row, now in enumerate(instants.tolist()):
        single = mode.evaluate(config, [entry], now)
        assert int(single["holds"]) == int(many["holds"][row])
        assert np.array_equal(single["value"], many["value"][row], equal_nan=True)


def test_explanation() -> None:
    text = "it does not hold that not (motor.temperature > 80 for 2s)"
    assert mode.explain(HOT, {"holds": False}) == text
    assert mode.explain(HOT, {"holds": None}) == ""
    assert mode.explain(Config(number=parse("a")), {"value": 1.0}) == ""


@pytest.mark.parametrize(
    "config", [Config(), Config(condition=parse("a + 1")), Config(number=parse("'text'"))]
)
def test_what_asks_for_nothing_is_refused(config: Config) -> None:
    assert list(config.check())


@pytest.mark.parametrize(
    ("condition", "number", "is_timed"),
    [("x > 1", None, False), ("x > 1 for 2s", None, True), (None, "age(x)", True),
     ("x > 1", "mean(x over 1s)", True)],
)  # fmt: skip
def test_only_what_looks_back_changes_as_time_passes(
    condition: str | None, number: str | None, is_timed: bool
) -> None:
    asked = [None if text is None else parse(text) for text in (condition, number)]
    assert mode.timed(Config(*asked)) is is_timed
