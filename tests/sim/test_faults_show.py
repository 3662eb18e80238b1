"""Each fault of the catalogue shows in what the robot publishes, beyond nominal noise."""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from amberbox.sim.faults import catalogue
from amberbox.sim.robot import Message, Robot

_BEGIN_S = 9.0  # the robot of this seed drives along the corridor then
_SEED = 3
_BEYOND_NOISE = 4.0
_LASTING_SHIFT = 2.0  # of the mean over the whole window
_CHANGED_BEAMS = 0.03
_OTHER_SPREAD = 2.0

Record = Mapping[str, list[Message]]


@cache
def _before(scenario: str) -> Robot:
    robot = Robot(_SEED, scenario=scenario)
    for _ in robot.step_until(_BEGIN_S):
        pass
    return robot


def _record(robot: Robot, seconds: float) -> Record:
    record: dict[str, list[Message]] = defaultdict(list)
    for message in robot.step_until(_BEGIN_S + seconds):
        record[message[0]].append(message)
    return record


@cache
def _nominal(scenario: str, seconds: float) -> Record:
    return _record(copy.deepcopy(_before(scenario)), seconds)


def _series(record: Record, variable: str) -> NDArray[Any]:
    """Return a variable over time, or a list of them; some are derived from the header."""
    topic, _, path = variable.partition(".")
    messages = record.get(topic, [])
    if path == "header.rate_hz":
        return np.array([float(len(messages))])
    if path == "header.age_s":
        return np.array([_age_s(sent_ns, message["header"]) for _, sent_ns, message in messages])
    return np.array([_leaf(message, path) for _, _, message in messages], dtype=np.float64)


def _age_s(sent_ns: int, header: dict[str, Any]) -> float:
    stamp = header["stamp"]
    return float(sent_ns - stamp["sec"] * 10**9 - stamp["nanosec"]) / 1e9


def _leaf(message: dict[str, Any], path: str) -> Any:
    value: Any = message
    for key in path.split("."):
        value = value[key]
    return value


def _shows(nominal: NDArray[Any], faulty: NDArray[Any]) -> bool:
    """Compare moment by moment: the noise of both runs is the same unless the fault changes it."""
    count = min(len(nominal), len(faulty))
    if count == 0:
        return len(nominal) != len(faulty)
    if nominal.ndim == 2 and nominal.shape[1] > 100:
        return float((np.abs(faulty[:count] - nominal[:count]) > 0.2).mean()) > _CHANGED_BEAMS
    noise = np.abs(np.diff(nominal, axis=0)).std(axis=0) if len(nominal) > 2 else 0.05
    noise = np.maximum(noise, 1e-6)
    change = faulty[:count] - nominal[:count]
    swing = np.sqrt(np.mean(change**2, axis=0)) / noise
    shift = np.abs(np.mean(change, axis=0)) / noise
    is_beyond = swing.max() > _BEYOND_NOISE or shift.max() > _LASTING_SHIFT
    return bool(is_beyond) or _has_other_spread(nominal, faulty)


def _has_other_spread(nominal: NDArray[Any], faulty: NDArray[Any]) -> bool:
    """Return whether a signal varies much more or less; with 50 values the spread is known
    to 10 %.
    """
    if nominal.ndim > 1 or min(len(nominal), len(faulty)) < 50:
        return False
    before, after = nominal.std(), faulty.std()
    return bool(max(before, after) > _OTHER_SPREAD * min(before, after) > 0 or after == 0 < before)


@pytest.mark.parametrize("fault_id", catalogue())
def test_each_fault_shows_where_the_catalogue_says(fault_id: str) -> None:
    fault = catalogue()[fault_id]
    robot = copy.deepcopy(_before(fault.scenario))
    robot.inject(fault_id)
    nominal = _nominal(fault.scenario, fault.visible_s)
    faulty = _record(robot, fault.visible_s)
    silent = [
        variable
        for variable in fault.shows_in
        if not _shows(_series(nominal, variable), _series(faulty, variable))
    ]
    assert not silent, f"{fault_id} does not show in {silent}"


def test_nothing_shows_without_a_fault() -> None:
    nominal = _nominal("transport", 3.0)
    again = _record(copy.deepcopy(_before("transport")), 3.0)
    shown = {variable for fault in catalogue().values() for variable in fault.shows_in}
    assert not [v for v in shown if _shows(_series(nominal, v), _series(again, v))]
