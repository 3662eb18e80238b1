"""Status words are split into their bits; an invalid word has none."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.mode import FALSE, TRUE, UNKNOWN
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.monitoring.modes import state_bits
from amberbox.monitoring.modes.state_bits import Config, StateBit
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

WHEEL = Config({"enabled": 0, "e_stop": StateBit(2, nominal=False)})


def test_contract() -> None:
    assert_mode_contract(state_bits, "state_bits", configs=[WHEEL, Config({"top": 62})], text=True)


@pytest.mark.parametrize(
    ("word", "ok", "enabled", "e_stop"),
    [
        (0b0001, TRUE, TRUE, FALSE),
        (0b1011, TRUE, TRUE, FALSE),
        (0b0101, FALSE, TRUE, TRUE),
        (0b0000, FALSE, FALSE, FALSE),
        (1.0, TRUE, TRUE, FALSE),
        (-1, FALSE, TRUE, TRUE),
        *[(value, UNKNOWN, UNKNOWN, UNKNOWN) for value in (nan, 2.5, 1e300, None)],
    ],
)
def test_words(word: float | None, ok: int, enabled: int, e_stop: int) -> None:
    found = state_bits.evaluate(WHEEL, [one_input(times_s=[0], values=[word])], at_s(0))
    assert [int(found[name]) for name in ("ok", "enabled", "e_stop")] == [ok, enabled, e_stop]
    assert np.isnan(found["word"]) == (ok == UNKNOWN)


def test_each_bit_is_a_result_with_its_own_nominal_state() -> None:
    results = {result.name: result for result in state_bits.results_of(WHEEL, 1, 2)}
    assert list(results) == ["ok", "word", "enabled", "e_stop"]
    assert (results["enabled"].nominal, results["e_stop"].nominal) == (True, False)


def test_explanation_names_the_bits() -> None:
    results = {"ok": False, "enabled": False, "e_stop": True}
    assert state_bits.explain(WHEEL, results) == "enabled is not set, e_stop is set"
    assert state_bits.explain(WHEEL, {"ok": True, "enabled": True, "e_stop": False}) == ""
    assert state_bits.explain(WHEEL, dict.fromkeys(("ok", "enabled", "e_stop"))) == ""


@pytest.mark.parametrize(
    "text", ["{}", "{bits: {}}", "{bits: {a: 63}}", "{bits: {a: -1}}", "{bits: {ok: 1}}"]
)
def test_bits_that_no_word_has_are_refused(text: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(text, "f", problems)
    assert node is not None
    assert build(Config, node, problems) is None
    assert problems
