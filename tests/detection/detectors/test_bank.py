"""The bank of Kalman filters as a detector: irregular messages, models in YAML and in Python."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.core.config import build
from amberbox.core.contracts import LearntState, Row, Score
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.detection.detectors import bank
from amberbox.detection.model_file import (
    DetectionModel,
    load_model,
    make_detector,
    save_model,
)
from amberbox.testing.detectors import GivenMission, copied, mission, rows_of, run_detector

ARM = """\
sensors: [arm.angle, gyro.rate]
sojourn: 20 s
models:
  moves:
    F: [[1, dt], [0, 1]]
    H: [[1, 0], [0, 1]]
    Q: [[1e-6, 0], [0, dt * 0.5]]
    R: [[4e-4, 0], [0, 4e-4]]
  blocked:
    F: [[1, 0], [0, 0]]
    H: [[1, 0], [0, 1]]
    Q: [[1e-6, 0], [0, 1e-4]]
    R: [[4e-4, 0], [0, 4e-4]]
  gyro_fails:
    F: [[1, dt], [0, 1]]
    H: [[1, 0], [0, 1]]
    Q: [[1e-6, 0], [0, dt * 0.5]]
    R: [[4e-4, 0], [0, 9]]
    masked: [gyro.rate]
"""


def options(text: str) -> bank.BankOptions:
    problems: list[Problem] = []
    node = parse_yaml(text, "detection.yaml", problems)
    assert node is not None
    built = build(bank.Config, node, problems)
    assert built is not None, problems
    return built


def problems_of(text: str) -> str:
    problems: list[Problem] = []
    node = parse_yaml(text, "detection.yaml", problems)
    assert node is not None
    assert build(bank.Config, node, problems) is None
    return "\n".join(f"{problem.where}: {problem.what}" for problem in problems)


def arm_models(dt: float) -> Mapping[str, Mapping[str, Any]]:
    """Return the models of ``ARM``, as a factory does."""
    h, r = np.eye(2), np.eye(2) * 4e-4
    moves = {"F": [[1, dt], [0, 1]], "H": h, "Q": [[1e-6, 0], [0, dt * 0.5]], "R": r}
    return {
        "moves": moves,
        "blocked": {"F": [[1, 0], [0, 0]], "H": h, "Q": np.diag([1e-6, 1e-4]), "R": r},
        "gyro_fails": {**moves, "R": np.diag([4e-4, 9]), "masked": ["gyro.rate"]},
    }


def arm(blocked_at_s: float = 1e9, gyro_fails_at_s: float = 1e9, seed: int = 0) -> GivenMission:
    """Return a swinging arm whose two sensors send at times of their own, at 20 and 30 Hz."""
    random = np.random.default_rng(seed)
    rows: list[Row] = []
    for item, rate_hz in (("arm", 20.0), ("gyro", 30.0)):
        times = np.cumsum(random.uniform(0.5, 1.5, int(30 * rate_hz)) / rate_hz)
        until = np.minimum(times, blocked_at_s)
        values = np.sin(until)
        if item == "gyro":
            values = np.where(times < blocked_at_s, np.cos(times), 0.0)
            values = np.where(times < gyro_fails_at_s, values, 3.0)
        values = values + random.normal(0, 0.02, len(times))
        rows += rows_of(item, times, {"angle" if item == "arm" else "rate": values})
    return mission(rows)


def fitted(config: bank.BankOptions) -> bank.Detector:
    detector = bank.Detector(config)
    detector.fit([arm(seed=1)])
    return detector


def series(found: list[tuple[Score, ...]], name: str) -> dict[float, float]:
    start_ns = found[0][0].at_ns
    return {(s.at_ns - start_ns) / 1e9: s.value for some in found for s in some if s.series == name}


@pytest.mark.parametrize(
    ("fault", "finding", "item"),
    [
        (arm(blocked_at_s=15.0), "blocked", "arm"),
        (arm(gyro_fails_at_s=15.0), "gyro_fails", "gyro"),
    ],
)
def test_the_model_of_a_fault_is_found_within_a_second(
    fault: GivenMission, finding: str, item: str
) -> None:
    detector = fitted(options(ARM))
    scores = series(run_detector(detector, fault.rows), "model")
    before = [value for at, value in scores.items() if 2 < at < 14.9]
    after = [value for at, value in scores.items() if at > 16]
    assert np.median(before) < 0.7 < 3 < np.median(after)
    reason = detector.explain("model")
    assert (reason.finding, reason.item) == (finding, item)
    assert reason.contributions[0][0] == finding


def test_what_no_model_explains_has_a_large_innovation() -> None:
    detector = fitted(options(ARM))
    rows = [
        row._replace(values={"angle": 40.0}) if row.item == "arm" and n % 3 == 0 else row
        for n, row in enumerate(arm().rows)
    ]
    wild = series(run_detector(detector, rows), "innovation")
    reason = detector.explain("innovation")
    calm = series(run_detector(detector, arm().rows), "innovation")
    assert max(list(calm.values())[50:]) < 3 < max(list(wild.values())[50:])
    assert (reason.finding, reason.item) == ("no_model", "arm")


def test_a_factory_gives_the_same_scores_as_the_yaml() -> None:
    by_yaml = fitted(options(ARM))
    factory = f"{__name__}:arm_models"
    by_python = fitted(
        options(f"sensors: [arm.angle, gyro.rate]\nsojourn: 20 s\nfactory: {factory}")
    )
    rows = arm(blocked_at_s=15.0).rows
    scores = [
        [score.value for some in run_detector(one, rows) for score in some]
        for one in (by_python, by_yaml)
    ]
    assert scores[0] == pytest.approx(scores[1], rel=1e-6, abs=1e-6)


def curved_models(dt: float) -> Mapping[str, Mapping[str, Any]]:
    """Return models whose entries are no straight lines of the time step."""
    cov = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) + np.eye(2) * 1e-9
    fast, slow = np.exp(-dt * 5), np.exp(-dt)
    return {
        name: {"F": [[1, dt], [0, f]], "H": np.eye(2), "Q": cov, "R": np.eye(2) * 4e-4}
        for name, f in (("fast", fast), ("slow", slow))
    }


def test_what_lies_between_the_kept_time_steps_is_close() -> None:
    own = options(f"sensors: [arm.angle, gyro.rate]\nfactory: {__name__}:curved_models")
    make = fitted(own)._load()
    for dt_s in (1.3e-4, 0.0333, 0.271, 7.77):
        found, exact = make(dt_s), curved_models(dt_s)
        for number, name in enumerate(found.names):
            for key, stack in (("F", found.linear.f), ("Q", found.linear.q)):
                assert stack[number] == pytest.approx(
                    np.array(exact[name][key]), rel=0.004, abs=2e-4
                )


def test_a_model_file_holds_what_a_factory_made_and_runs_no_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = options(f"sensors: [arm.angle, gyro.rate]\nfactory: {__name__}:arm_models")
    learnt = make_detector("bank", own)
    learnt.fit([arm(seed=1)])
    learnt.calibrate([arm(seed=2)], 60.0)
    file = tmp_path / "bank.model"
    save_model(DetectionModel({"bank": learnt}), file)
    monkeypatch.setattr(bank, "_from_factory", pytest.fail)
    again = load_model(file).detectors["bank"]
    rows = list(arm(blocked_at_s=15.0).rows)
    alarms = []
    for detector in (learnt, again):
        detector.begin(0)
        alarms.append(detector.update(rows))
    assert alarms[0] == alarms[1] and "blocked" in alarms[0][0].id
    state = copied(learnt.detector.learnt())
    for name, wrong in (
        ("q", -state.arrays["q"]), ("steps", state.arrays["steps"][::-1]),
        ("f", state.arrays["f"][:, :1]), ("masked", state.arrays["masked"][:1]),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"."):
            arrays = {**state.arrays, name: wrong}
            bank.Detector(bank.Config()).restore(LearntState(state.values, arrays))
    with pytest.raises(ValueError, match="arm_models"):  # an earlier file: without matrices
        bank.Detector(bank.Config()).restore(LearntState(state.values))


@pytest.mark.parametrize(
    ("factory", "what"),
    [
        ("no_such_module:f", "no_such_module"),
        (f"{__name__}:no_such", "no_such"),
        (f"{__name__}:options", "fails for dt=0.1"),
        ("math:exp", "must return models by name"),
    ],
)
def test_a_factory_that_is_wrong_is_told(factory: str, what: str) -> None:
    detector = bank.Detector(dataclasses.replace(options(ARM), models={}, factory=factory))
    with pytest.raises(AmberboxError, match=what):
        detector.fit([arm()])


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("F: [[1, dt], [0, 1]]", "F: [[1, dt]]", "moves.F must have"),
        ("dt * 0.5", "dt.real", "no formula"),
        ("dt * 0.5", "__import__('os')", "no formula"),
        ("dt * 0.5", "9 ** 9 ** 9", "math range error"),
        ("[4e-4, 0], [0, 4e-4]", "[4e-4, 1], [0, 4e-4]", "moves.R is no covariance"),
        ("[1e-6, 0], [0, dt * 0.5]", "[1e-6, 0], [0, -dt]", "moves.Q is no covariance"),
        ("masked: [gyro.rate]", "masked: [gyro.rat]", "did you mean 'gyro.rate'"),
        ("sojourn: 20 s", "nominal: move", "did you mean 'moves'"),
        ("sojourn: 20 s", "start: [1]", "start must have 2 numbers"),
        ("sojourn: 20 s", "factory: a:b", "'models' or 'factory'"),
    ],
)
def test_a_mistake_in_the_options_is_told(old: str, new: str, what: str) -> None:
    assert what in problems_of(ARM.replace(old, new, 1))


def test_a_sensor_that_never_sends_is_told() -> None:
    detector = bank.Detector(options(ARM.replace("gyro.rate", "gyro.rates")))
    with pytest.raises(AmberboxError, match=r"'gyro.rates'; did you mean 'gyro.rate'"):
        detector.fit([arm()])
