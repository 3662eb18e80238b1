"""The detector of limits: what left its nominal range, jumped, froze, became garbage, or silent."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.contracts import Row
from amberbox.detection.detectors import guard
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.detection.limits import VariableLimits
from amberbox.detection.model_file import make_detector
from amberbox.testing.detectors import (
    T0_NS,
    GivenMission,
    assert_detector_contract,
    mission,
    rows_of,
)


def test_guard_is_a_detector() -> None:
    assert_detector_contract(guard, "guard")


def motor(seed: int, seconds: float = 60.0) -> GivenMission:
    """Return a mission of a motor at 10 Hz: speed, temperature, a counter, a constant."""
    random = np.random.default_rng(seed)
    times = np.arange(0, seconds, 0.1) + random.uniform(0, 0.01)
    values = {
        "speed": 2 * np.sin(times) + random.normal(0, 0.05, len(times)),
        "temperature": 40 + 3 * np.sin(times / 20) + random.normal(0, 0.01, len(times)),
        "ticks": np.arange(len(times)) + 1000 * seed,
        "mode": np.full(len(times), 3.0),
    }
    return mission(rows_of("motor", times, values), f"motor_{seed}")


@cache
def learnt() -> LearntDetector:
    detector = make_detector("guard")
    detector.fit([motor(seed) for seed in range(3)])
    detector.calibrate([motor(10 + seed) for seed in range(3)], 60.0)
    return detector


def limits() -> dict[str, VariableLimits]:
    detector = learnt().detector
    assert isinstance(detector, guard.Detector)
    (item,) = detector.limits
    return {variable.name: variable for variable in item.variables}


def test_limits_are_those_of_the_missions() -> None:
    found = limits()
    assert found["temperature"].low == pytest.approx(40.0, abs=0.5)
    assert found["temperature"].high == pytest.approx(43.0, abs=0.2)
    assert found["speed"].jump == pytest.approx(0.35, abs=0.1)
    assert found["speed"].change_per_s == pytest.approx(2.0, abs=0.3)
    assert found["speed"].rest_s == pytest.approx(0.2, abs=0.05)
    assert found["ticks"].counter and not found["speed"].counter
    assert found["mode"].rest_s is None and found["mode"].whole


def changed(kind: str) -> list[Row]:
    """Return a mission in which something is wrong from 30 s on."""
    rows = list(motor(50))
    for place in range(len(rows)):
        if rows[place].at_ns < T0_NS + 30 * NS:
            continue
        values = dict(rows[place].values)
        if kind == "range":
            values["temperature"] = 60.0
        elif kind == "jump":
            values["speed"] = 1.5 * (-1) ** place
        elif kind == "garbage":
            values["speed"] = math.nan if place % 2 else math.inf
        elif kind == "frozen":
            values["speed"] = 0.5
        elif kind == "mode":
            values["mode"] = 7.0
        elif kind == "slow" and place % 3:
            values = {}
        rows[place] = rows[place]._replace(values=values)
    return [row for row in rows if row.values]


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [
        ("range", "guard.range.motor.temperature"),
        ("jump", "guard.jump.motor.speed"),
        ("garbage", "guard.garbage.motor.speed"),
        ("frozen", "guard.frozen.motor.speed"),
        ("mode", "guard.range.motor.mode"),
        ("slow", "guard.slow.motor"),
    ],
)
def test_what_is_wrong_is_named_with_value_and_limit(kind: str, wanted: str) -> None:
    detector = learnt()
    detector.begin(T0_NS)
    found = {alarm.id: alarm for alarm in detector.update(changed(kind)) if not alarm.gone_ns}
    assert wanted in found
    alarm = found[wanted]
    assert T0_NS + 30 * NS <= alarm.confirmed_ns < T0_NS + 42 * NS
    assert "(learnt: " in alarm.reason.text
    assert alarm.reason.contributions[0][1] > 0.3


def test_what_is_new_is_counted_and_no_alarm() -> None:
    detector = guard.Detector(guard.Config())
    detector.fit([motor(0)])
    detector.begin(T0_NS)
    rows = [row._replace(values={**row.values, "new": 1e9}) for row in motor(0)]
    scores = [score for row in rows for score in detector.observe(row)]
    assert max(score.value for score in scores) == 0
    detector.observe(Row("other", T0_NS, T0_NS, {}))
    assert detector.counts == {
        "values of variables that were not learnt": len(rows),
        "messages of items that were not learnt": 1,
    }
