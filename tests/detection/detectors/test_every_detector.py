"""Every detector: its contract, streams cut anywhere, checkpoints, and model files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core import plugins
from amberbox.core.clock import NS
from amberbox.core.config import build
from amberbox.core.contracts import LearntState, Row, Score
from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.detection.alarms import DetectorAlarm, alarm_to_json
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.detection.model_file import (
    DETECTORS,
    DetectionModel,
    detector_names,
    model_bytes,
    read_model,
)
from amberbox.testing.detectors import (
    GivenMission,
    assert_detector_contract,
    mission,
    nominal_missions,
    run_detector,
)

OPTIONS = {
    "residual": (
        "pairs: [{output: wheel.b, inputs: [imu.a, battery.c]}]\nlags: 3",
        "regression: false\npairs: [{output: imu.b, inputs: [imu.a], output_lags: 0}]",
    ),
    "bank": (
        """\
sensors: [imu.a, wheel.b]
models:
  swings: {F: [[1, dt], [-dt, 1]], H: [[1, 0], [2, 0]], Q: [[dt, 0], [0, dt]],
           R: [[0.01, 0], [0, 0.01]]}
  stands: {F: [[1, 0], [0, 0]], H: [[1, 0], [2, 0]], Q: [[0.001, 0], [0, 1]],
           R: [[0.01, 0], [0, 0.01]]}
  wheel_fails: {F: [[1, dt], [-dt, 1]], H: [[1, 0], [2, 0]], Q: [[dt, 0], [0, dt]],
                R: [[0.01, 0], [0, 4]], masked: [wheel.b]}
""",
    ),
    "state_flow": (
        "events: [battery.mode, imu.a]",
        "members: {left: [imu.*], right: [wheel.*, battery.c]}\nwindow: 0.3\nstep: 0.1\nstates: 4",
        "events: [battery.mode]\nclusters: false",
    ),
    "redundant": (
        """\
groups:
  three: {members: {x: [imu.a, imu.c], y: [imu.b, wheel.c], z: [wheel.a, battery.c]}}
  two: {members: {x: [imu.a], y: [wheel.a]}, moves: 0.5}
""",
    ),
}


def module_of(name: str) -> ModuleType:
    return plugins.get(DETECTORS, name, defines=("Config", "Detector")).load()


def options(name: str, text: str) -> Any:
    problems: list[Problem] = []
    node = parse_yaml(text, "detection.yaml", problems)
    assert node is not None, problems
    built = build(module_of(name).Config, node, problems)
    assert built is not None, problems
    return built


def richest(name: str) -> Any:
    """Return the options with the most parts of a detector in use."""
    return options(name, OPTIONS[name][0]) if name in OPTIONS else module_of(name).Config()


@cache
def missions() -> tuple[GivenMission, ...]:
    """Return nominal missions, in which the battery also sends a mode."""
    return tuple(
        mission(
            [
                row._replace(texts={"mode": ("idle", "go", "turn")[row.at_ns // (2 * NS) % 3]})
                if row.item == "battery"
                else row
                for row in one.rows
            ],
            one.name,
        )
        for one in nominal_missions(4)
    )


def damaged(rows: Sequence[Row]) -> list[Row]:
    """Return rows with all values five times as large from the middle on."""
    half = len(rows) // 2
    return [
        row if i < half else row._replace(values={k: 5 * v for k, v in row.values.items()})
        for i, row in enumerate(rows)
    ]


@cache
def calibrated(name: str) -> bytes:
    """Return a model file of one detector that has been learnt and calibrated."""
    detector = LearntDetector(name, module_of(name).Detector(richest(name)))
    detector.fit(missions()[:2])
    detector.calibrate(missions()[2:], 100.0)
    return model_bytes(DetectionModel({name: detector}))


def restored(name: str) -> LearntDetector:
    return read_model(calibrated(name), "model").detectors[name]


def as_json(alarms: Sequence[DetectorAlarm]) -> str:
    return json.dumps([alarm_to_json(alarm) for alarm in alarms])


@pytest.mark.parametrize("name", detector_names())
def test_it_keeps_the_contract(name: str) -> None:
    assert_detector_contract(
        module_of(name),
        name,
        missions=missions()[:3],
        configs=[options(name, text) for text in OPTIONS.get(name, ())],
        examples=6,
    )


@pytest.mark.parametrize("name", detector_names())
def test_its_alarms_do_not_depend_on_how_a_stream_is_cut(name: str) -> None:
    rows = damaged(missions()[0].rows)
    whole = restored(name)
    expected = as_json(whole.update(rows) + whole.tick(rows[-1].at_ns + NS))
    assert len(json.loads(expected)) > (0 if name != "event_timing" else -1)

    @settings(max_examples=6, database=None)
    @given(st.lists(st.integers(0, len(rows)), max_size=6), st.integers(0, 6))
    def check(cuts: list[int], resumed: int) -> None:
        detector = restored(name)
        found: list[DetectorAlarm] = []
        borders = [0, *sorted(cuts), len(rows)]
        for number, (start, end) in enumerate(pairwise(borders)):
            if number == resumed:
                state = json.loads(json.dumps(detector.snapshot(), allow_nan=False))
                detector = restored(name)
                detector.resume(state)
            found += detector.update(rows[start:end])
        assert as_json(found + detector.tick(rows[-1].at_ns + NS)) == expected

    check()


@pytest.mark.parametrize("name", detector_names())
def test_a_model_file_gives_back_the_same_detector(name: str) -> None:
    again = restored(name)
    assert model_bytes(DetectionModel({name: again})) == calibrated(name)
    first = LearntDetector(name, module_of(name).Detector(richest(name)))
    first.fit(missions()[:2])
    first.calibrate(missions()[2:], 100.0)
    one, other = first.score(missions()[3]), again.score(missions()[3])
    assert len(one) > 0
    assert one.names == other.names
    assert one.value.tobytes() == other.value.tobytes()
    assert one.p_value.tobytes() == other.p_value.tobytes()


@pytest.mark.parametrize("name", sorted(OPTIONS))
def test_its_sample_can_be_read(name: str) -> None:
    assert options(name, module_of(name).SAMPLE) != module_of(name).Config()


def changed(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Return plain JSON with the value at a path replaced; without it if ``new`` is ``...``."""
    if not path:
        return new
    step, *rest = path
    if isinstance(value, dict):
        found = {
            key: entry for key, entry in value.items() if key != step or new is not ... or rest
        }
        return {
            key: changed(entry, tuple(rest), new) if key == step else entry
            for key, entry in found.items()
        }
    return [
        changed(entry, tuple(rest), new) if place == step else entry
        for place, entry in enumerate(value)
        if place != step or new is not ... or rest
    ]


def paths(value: Any) -> list[tuple[Any, ...]]:
    """Return the paths of all values in plain JSON; of a list, those of its first entry."""
    entries: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        entries = list(value.items())
    elif isinstance(value, list) and value:
        entries = [(0, value[0])]
    below = [(key, *path) for key, entry in entries for path in paths(entry)]
    return [(key,) for key, _ in entries] + below


@pytest.mark.parametrize("name", sorted(OPTIONS))
def test_damaged_models_and_checkpoints_are_refused_or_work(name: str) -> None:
    """Only the errors of the contract are raised, and scores stay finite."""
    detector = module_of(name).Detector(richest(name))
    detector.fit(missions()[:2])
    rows = missions()[0].rows[:30]
    run_detector(detector, rows)
    state = detector.learnt()
    values = json.loads(json.dumps(dict(state.values)))
    snapshot = json.loads(json.dumps(detector.snapshot()))
    damaged_states = [
        LearntState(changed(values, path, new), state.arrays) for path, new in wrong_values(values)
    ]
    for key, array in state.arrays.items():
        for other in (array[:-1], np.full_like(array, np.nan), np.zeros_like(array), array[None]):
            damaged_states.append(LearntState(values, {**state.arrays, key: other}))
        damaged_states.append(
            LearntState(values, {k: v for k, v in state.arrays.items() if k != key})
        )
    refused = 0
    for damaged_state in damaged_states:
        other = module_of(name).Detector(module_of(name).Config())
        try:
            other.restore(damaged_state)
        except (ValueError, KeyError, TypeError):
            refused += 1
            continue
        finite(run_detector(other, rows))
    assert refused > len(damaged_states) / 3
    for path, new in wrong_values(snapshot):
        other = module_of(name).Detector(richest(name))
        other.restore(state)
        try:
            other.resume(changed(snapshot, path, new))
        except (ValueError, KeyError, TypeError):
            continue
        finite([other.observe(row) for row in rows[:3]])


def wrong_values(value: Any) -> list[tuple[tuple[Any, ...], Any]]:
    """Return two wrong values for each path in plain JSON; ``...`` stands for none at all."""
    wrong: tuple[Any, ...] = (..., None, -1, "x", [], 1e300)
    places = enumerate(paths(value))
    return [(path, wrong[(n + k) % len(wrong)]) for n, path in places for k in (0, 4)]


def finite(found: Sequence[Sequence[Score]]) -> None:
    assert all(0 <= score.value < np.inf for scores in found for score in scores)
