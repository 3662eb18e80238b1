"""Measures of signals, known in closed form, and criteria over a recorded interval."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query import record
from amberbox.core.expression import parse
from amberbox.experiments.criteria import (
    MEASURES,
    CriterionResult,
    MeasureError,
    Signal,
    judge,
    verdict_of,
)
from amberbox.experiments.experiment import CriterionOptions, Measure
from amberbox.testing.records import FakeItem, FakeRun

S = 1_000_000_000
T0 = 1_700_000_000 * S
RATE = 100


def signal(values: Any, **keys: Any) -> Signal:
    times = np.arange(len(values)) / RATE
    return Signal(times, np.asarray(values, float), len(values) / RATE, **keys)


def step_response(wn: float = 6.0, zeta: float = 0.4, seconds: float = 5.0) -> Any:
    """Return the step response of a second-order system, whose overshoot is known."""
    t = np.arange(int(seconds * RATE)) / RATE
    wd = wn * math.sqrt(1 - zeta**2)
    return 1 - np.exp(-zeta * wn * t) * (np.cos(wd * t) + zeta * wn / wd * np.sin(wd * t))


def measured(name: str, values: Any, **keys: Any) -> float:
    return MEASURES[name](signal(values, **keys))


def test_every_measure_that_may_be_declared_exists() -> None:
    assert set(get_args(Measure)) == set(MEASURES)


def test_figures_of_samples() -> None:
    values = [3.0, -1.0, 4.0, 2.0]
    assert {name: measured(name, values) for name in ("max", "min", "mean", "final", "range")} == {
        "max": 4, "min": -1, "mean": 2, "final": 2, "range": 5,
    }  # fmt: skip
    assert measured("std", values) == pytest.approx(np.std(values))
    assert measured("rms", values) == pytest.approx(math.sqrt(30 / 4))


def test_a_step_response_has_its_overshoot_rise_and_settling_time() -> None:
    zeta, wn = 0.4, 6.0
    values = step_response(wn, zeta)
    known = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert measured("overshoot", values, target=1.0) == pytest.approx(known, abs=1e-3)
    assert measured("overshoot", -values, target=-1.0) == pytest.approx(known, abs=1e-3)
    assert measured("rise_time", values, target=1.0) == pytest.approx(1.46 / wn, abs=0.02)
    settled = measured("settling_time", values, target=1.0, band=0.02)
    assert settled < 4 / (zeta * wn)
    at = round(settled * RATE)
    assert abs(values[at - 1] - 1) > 0.02 and (abs(values[at:] - 1) <= 0.02).all()


def test_what_is_never_reached_is_infinite() -> None:
    slow = np.linspace(0, 0.5, 200)
    assert measured("rise_time", slow, target=1.0) == math.inf
    assert measured("settling_time", slow, target=1.0, band=0.1) == math.inf
    assert measured("delay", slow, target=1.0, band=0.1) == math.inf
    assert measured("overshoot", slow, target=1.0) == 0


def test_measures_of_conditions() -> None:
    true = [0, 0, 1, 1, 0, 1, 0, 0]
    assert measured("count", true, is_condition=True) == 2
    assert measured("duration", true, is_condition=True) == pytest.approx(0.03)
    assert measured("fraction", true, is_condition=True) == pytest.approx(3 / 8)
    assert measured("delay", true, is_condition=True) == pytest.approx(0.02)
    with pytest.raises(MeasureError, match="no condition"):
        measured("count", true)


def test_a_path_of_one_and_of_two_coordinates() -> None:
    assert measured("distance", [0, 3, 1]) == 5
    assert measured("distance", [0, 3, 3], along=np.array([0.0, 4.0, 5.0])) == pytest.approx(6)


def test_a_measure_without_its_target_says_so() -> None:
    for name in ("settling_time", "overshoot", "rise_time", "delay"):
        with pytest.raises(MeasureError, match="target"):
            measured(name, [0, 1])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of 10 s: a step response from 2 s on, a mode that changes, and a gap."""
    path = tmp_path_factory.mktemp("store") / "store"
    joint = FakeItem("joint", [{"q": 0.1, "maybe": 0.1}])
    mode, hole = FakeItem("mode", [{"on": True}]), FakeItem("hole", [{"x": 0.1}])
    run = FakeRun(path, items=[joint, mode, hole])
    run.start(T0 - 1)
    response = np.concatenate([np.zeros(2 * RATE), step_response(seconds=8)])
    rows: list[tuple[int, FakeItem, Any]] = []
    for number, value in enumerate(response):
        at = T0 + number * S // RATE
        rows.append((at, joint, {"q": float(value), "maybe": None if number == 500 else 1.0}))
        if number % 300 == 0:
            rows.append((at, mode, {"on": number // 300 % 2 == 1}))
        if not 400 < number < 500:
            rows.append((at, hole, {"x": 1.0}))
    run.write(rows)
    run.own(channels.GAP, T0 + 5 * S, {
        "item": "hole", "peer": "", "from_ns": T0 + 4 * S, "to_ns": T0 + 5 * S,
        "reason": "connection lost", "count": 99,
    })  # fmt: skip
    run.close()
    return path


def judged(store: Path, *criteria: CriterionOptions, **intervals: tuple[float, float]) -> Any:
    spans = {"": (T0, T0 + 10 * S)}
    spans |= {name: (T0 + int(a * S), T0 + int(b * S)) for name, (a, b) in intervals.items()}
    with record.open(store) as opened:
        return judge(criteria, opened, spans)


def criterion(measure: Any, of: str, **keys: Any) -> CriterionOptions:
    return CriterionOptions(measure, parse(of), **keys)


def test_criteria_pass_and_fail_over_the_time_of_a_step(store: Path) -> None:
    keys: dict[str, Any] = {"during": "move", "target": 1.0, "band": 0.05, "unit": "s"}
    passed, failed, never = judged(
        store,
        criterion("settling_time", "joint.q", below=2.0, **keys),
        criterion("overshoot", "joint.q", name="overshoot", below=0.1, during="move", target=1.0),
        criterion("delay", "joint.q > 3", below=1.0, during="move"),
        move=(2, 8),
    )
    assert (passed.verdict, passed.name) == ("passed", "settling_time of joint.q")
    assert 0.5 < passed.value < 2
    assert (failed.verdict, failed.value) == ("failed", pytest.approx(0.2538, abs=1e-3))
    assert (never.verdict, never.value, never.text) == ("failed", None, "never")
    assert (passed.from_ns, passed.to_ns) == (T0 + 2 * S, T0 + 8 * S)


def test_the_last_sample_before_an_interval_holds_at_its_beginning(store: Path) -> None:
    (share,) = judged(store, criterion("fraction", "mode.on", during="d"), d=(4.0, 8.0))
    assert share.value == pytest.approx(0.5), "on from 3 s to 6 s"
    (short,) = judged(store, criterion("mean", "q", during="d"), d=(0.0, 1.0))
    assert (short.verdict, short.value) == ("passed", 0.0), "a name that is unique is enough"


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        (criterion("max", "hole.x", below=9), "gap of 1.0s: connection lost"),
        (criterion("max", "joint.maybe", below=9), "1 of 1000 values are unknown"),
        (criterion("max", "joint.z", below=9), "z"),
        (criterion("max", "arm.q", below=9), "arm.q"),
        (criterion("max", "joint.q", below=9, during="fly"), "'fly' was not carried out"),
        (criterion("max", "joint.q", below=9, during="after"), "ends before the interval"),
        (criterion("max", "mode.on", below=9, during="still"), "no samples in the interval"),
        (criterion("count", "joint.q", below=9), "no condition"),
        (criterion("max", "1 + 1", below=9), "reads no variable"),
    ],
)
def test_what_was_not_recorded_is_unknown_and_says_why(
    store: Path, asked: CriterionOptions, why: str
) -> None:
    (result,) = judged(store, asked, after=(9, 20), still=(4, 5))
    assert result.verdict == "unknown"
    assert why in result.text
    assert verdict_of("passed", [result])[0] == "undecided"


def test_without_a_record_everything_is_unknown() -> None:
    (result,) = judge([criterion("max", "a.b")], None, {"": (0, 1)})
    assert (result.verdict, result.text) == ("unknown", "there is no record of the run")


def test_the_verdict_combines_outcome_criteria_and_skipped_questions() -> None:
    good = CriterionResult("good", "max", "a.b", "passed", 1.0)
    bad = CriterionResult("bad", "max", "a.b", "failed", 3.0, unit="A", below=2.0)
    unclear = CriterionResult("unclear", "max", "a.b", "unknown", text="no record")
    assert verdict_of("passed", [good]) == ("passed", [])
    assert verdict_of("passed", [good, bad, unclear]) == (
        "failed", ["bad: 3 A, expected at most 2 A"],
    )  # fmt: skip
    assert verdict_of("passed", [unclear]) == ("undecided", ["unclear: unknown, no record"])
    assert verdict_of("passed", [good], ["door, ok"]) == ("undecided", ["door, ok: skipped"])
    for outcome in ("failed", "aborted", "error"):
        assert verdict_of(outcome, [good])[0] == outcome
