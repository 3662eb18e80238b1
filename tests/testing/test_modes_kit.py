"""The contract kit for modes accepts right modes, and reports each error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, settings

from amberbox.core.mode import UNKNOWN, Input, Result, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now
from amberbox.testing.modes import (
    assert_mode_contract,
    at_s,
    mode_file,
    module_problems,
    one_input,
)

SAMPLE = """\
name: tilt_monitor
monitor: tilt
mappings:
  - mapping:
      inputs: [imu.roll]
      outputs:
        - output: {name: upright, type: bool, expected: true}
arguments: {limit: 0.5}
"""


@dataclass(frozen=True)
class Config:
    limit: float = option(1.0, "the greatest angle")
    window: float = option(1.0, "over how long")


@dataclass(frozen=True)
class Undocumented:
    limit: float = option(1.0)


class Mutable:
    limit: float = 1.0


def upright(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    (roll,) = inputs
    return {"upright": where_known(roll.samples.known(now), np.abs(roll.at(now)) <= config.limit)}


def tilt(**changes: Any) -> ModuleType:
    """Make a mode that is right except for the changes; None removes a name."""
    module = ModuleType("tilt", "Tilt: the robot stands on its wheels.")
    right = {
        "Config": Config,
        "ACCEPTS": ("variable",),
        "RESULTS": (Result("upright", "bool", "stands"),),
        "SAMPLE": SAMPLE,
        "COLUMNS": True,
        "evaluate": upright,
    }
    for name, value in {**right, **changes}.items():
        if value is not None:
            setattr(module, name, value)
    return module


def test_a_right_mode() -> None:
    assert_mode_contract(tilt(), "tilt", configs=[Config(limit=3)])
    assert mode_file(tilt(), "tilt").config == Config(limit=0.5)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"SAMPLE": None}, "does not define SAMPLE"),
        ({"__doc__": ""}, "has no docstring"),
        ({"Config": Undocumented}, "argument 'limit' has no doc"),
        ({"Config": Mutable}, "not a frozen dataclass"),
        ({"ACCEPTS": ("topic",)}, "ACCEPTS must be"),
        ({"ACCEPTS": ("probe",)}, "neither PROBE nor probe_of"),
        ({"RESULTS": ["upright"]}, "must be a tuple of Result"),
        ({"RESULTS": (Result("a", "bool", "a"),) * 2}, "a name twice"),
        ({"RESULTS": (Result("upright", "bool", ""),)}, "has no doc"),
        ({"TIMED": 1}, "TIMED must be True or False"),
        ({"SAMPLE": SAMPLE.replace("monitor: tilt", "monitor: tylt")}, "monitor: tilt"),
        ({"SAMPLE": SAMPLE.replace("mappings", "mapings")}, "mapings"),
        ({"SAMPLE": SAMPLE.replace("limit: 0.5", "limit: much")}, "limit"),
        ({"SAMPLE": SAMPLE.replace("type: bool", "type: string")}, "no result of the type string"),
        ({"SAMPLE": SAMPLE.replace("type: bool", "result: up, type: bool")}, "no result 'up'"),
    ],
)
def test_what_a_module_lacks_is_named(changes: dict[str, Any], what: str) -> None:
    problems = module_problems(tilt(**changes), "tilt")
    assert any(what in problem for problem in problems), problems


@pytest.fixture
def no_shrinking() -> Iterator[None]:
    """Find a counter-example, not the smallest, which takes seconds."""
    before = settings.get_current_profile_name()
    settings.register_profile("no shrinking", phases=[Phase.generate])
    settings.load_profile("no shrinking")
    yield
    settings.load_profile(before)


def always(value: Any) -> Any:
    return lambda config, inputs, now: {"upright": np.full(np.shape(now), value)[()]}


def remembering() -> Any:
    seen: list[int] = []

    def evaluate(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
        seen.append(1)
        return {"upright": np.full(np.shape(now), len(seen) % 2)[()]}

    return evaluate


def touching(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    inputs[0].samples.forget_before(1 << 62)
    return {"upright": np.full(np.shape(now), UNKNOWN)[()]}


def by_the_future(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    (roll,) = inputs
    count = len(roll.samples)
    return {"upright": where_known(roll.samples.known(now), count % 2 == 0)}


def beyond_its_history(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    (roll,) = inputs
    return {"upright": where_known(roll.samples.known(now), roll.over(now, 5).count() > 3)}


def one_at_a_time(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    now = int(np.max(now))
    return upright(config, inputs, now)


def other_columns(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    found = dict(upright(config, inputs, now))
    return found if np.ndim(now) == 0 else {"upright": np.full(np.shape(now), UNKNOWN)}


def raising_on_nan(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    (roll,) = inputs
    if np.isnan(roll.samples.values.astype(float)).any():
        raise ValueError("no NaN, please")
    return upright(config, inputs, now)


@pytest.mark.usefixtures("no_shrinking")
@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"evaluate": always(1)}, "before there is any sample"),
        ({"evaluate": always(3)}, "before there is any sample"),
        ({"evaluate": always(7)}, "is no bool"),
        ({"evaluate": always("yes")}, "is no bool"),
        ({"evaluate": remembering()}, "the second time"),
        ({"evaluate": touching}, "changed its inputs"),
        ({"evaluate": by_the_future}, "in parts"),
        ({"evaluate": beyond_its_history}, "in parts"),
        ({"evaluate": one_at_a_time}, "one by one"),
        ({"evaluate": other_columns}, "one by one"),
        ({"evaluate": raising_on_nan}, "no NaN, please"),
        ({"evaluate": lambda config, inputs, now: {"upside": UNKNOWN}}, "RESULTS does not have"),
        ({"evaluate": lambda config, inputs, now: {}}, "never returned upright"),
        ({"explain": lambda config, results: None}, ""),
    ],
)
def test_a_function_that_breaks_the_contract_is_found(changes: dict[str, Any], what: str) -> None:
    with pytest.raises((AssertionError, ValueError)) as caught:
        assert_mode_contract(tilt(**changes), "tilt", examples=2000)  # ends with the first found
    notes = getattr(caught.value, "__notes__", [])
    assert what in "\n".join([str(caught.value), *notes])


def test_a_mode_that_says_how_far_it_looks_is_right() -> None:
    changes = {"evaluate": beyond_its_history, "history_s": lambda config: 5.0}
    assert_mode_contract(tilt(**changes), "tilt")


def test_inputs_by_hand() -> None:
    entry = one_input("x", times_s=[0, 1, 2], values=[1.5, None, 3], received_s=[0, 0.5, 2])
    assert [bool(entry.samples.known(at_s(s))) for s in (-1, 0, 1, 2)] == [False, True, False, True]
    assert entry.at(at_s(0, 2)).tolist() == [1.5, 3]
    assert entry.age_s(at_s(1.75)) == 1.25
    assert entry.rate_hz(at_s(2), 2) == 1
    item = one_input("x", times_s=[0, 1], stamps_s=[5, 6], parts={"ok": [True, None]})
    assert item.is_item
    assert not entry.is_item
    assert item.stamps.at(at_s(1)) == at_s(6)
    assert item.part("ok").samples.known(at_s(0, 1)).tolist() == [True, False]
