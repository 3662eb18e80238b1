"""The experiment and the unit test of the simulated FMEA tell apart what they are proposed for."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox import sim
from amberbox.core.clock import NS
from amberbox.diagnosis.evidence.conditions import ConditionTracker
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.experiments.profile import Experiment, read_experiment
from amberbox.sim.robot import START_NS, Robot
from tests.sim.monitored import batches

FOLDER = Path(sim.__file__).parent / "folder"
DRIVES = ("current_1_q", "current_2_q")
IN_A_TURN_S = 34.5  # of the robot with seed 53: its pivots point aside then


@cache
def experiment() -> Experiment:
    found, problems = read_experiment(FOLDER / "experiments" / "pivot_check.bpmn", FOLDER)
    assert found is not None and problems == []
    return found


def columns_of_drive(fault: str | None, seed: int, at_s: float) -> tuple[Any, Mapping[str, Any]]:
    """Return times and currents while the robot, on its way until ``at_s``, does what the
    experiment's service tasks order.
    """
    robot = Robot(seed, scenario="shuttle")
    if fault is not None:
        robot.inject(fault)
    list(robot.step_until(at_s))
    robot.command({"do": "stop"})
    list(robot.step_until(at_s + 3.0))
    order = experiment().robot_steps["drive"].parameters
    begun = robot.command({"do": "linear", **order})
    times: list[int] = []
    columns: dict[str, list[float]] = {}
    for seconds in range(4, 40):
        for topic, sent_ns, message in robot.step_until(at_s + seconds):
            if topic.strip("/").split("/")[-1] == "wheels":
                times.append(sent_ns)
                for place, unit in message["sensors"].items():
                    for name in DRIVES:
                        address = f"sim_wheels.sensors_{place}_{name}"
                        columns.setdefault(address, []).append(unit[name])
        state = robot.command({"do": "status", "id": begun["id"]})["state"]
        if state != "running":
            assert state == "done"
            return np.array(times), {name: np.array(v) for name, v in columns.items()}
    raise AssertionError("the drive has not ended")


@pytest.mark.parametrize(
    ("fault", "passes"),
    [
        (None, True),
        ("wheel_front_left_motor_weak", True),
        ("wheel_rear_right_motor_weak", True),
        ("wheel_front_left_bearing_drag", True),
        ("wheel_front_left_slip", True),
        ("wheel_rear_right_tyre_worn", True),
        ("wheel_front_left_pivot_offset", False),
        ("wheel_rear_right_pivot_offset", False),
        ("wheel_front_left_encoder_stuck", False),
    ],
)
def test_pivots_off_their_zero_fail_the_pivot_check_and_weak_drives_do_not(
    fault: str | None, passes: bool
) -> None:
    for seed, at_s in ((3, 5.0), (53, IN_A_TURN_S)):
        times, columns = columns_of_drive(fault, seed, at_s)
        criteria = experiment().options.criteria
        assert {one.measure for one in criteria} == {"duration"}
        step_s = float(np.diff(times).mean()) / 1e9
        lasted = [float(c.of.evaluate_columns(times, columns).sum()) * step_s for c in criteria]
        limits = [one.below for one in criteria if one.below is not None]
        verdict = all(s < most for s, most in zip(lasted, limits, strict=True))
        assert verdict == passes, (seed, lasted)
        margins = [abs(s - most) for s, most in zip(lasted, limits, strict=True)]
        assert min(margins) > 0.2  # of the limit of 0.65 s


def share_covered() -> Callable[[list[Any]], float]:
    """Return the measure of the unit test, from its file; pytest marks in it mean nothing here."""
    tree = ast.parse((FOLDER / "tests" / "test_sensors.py").read_text())
    body: list[ast.stmt] = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name == "share_covered"
    ]
    names: dict[str, Any] = {}
    exec(compile(ast.Module(body, []), "test_sensors.py", "exec"), names)
    found: Callable[[list[Any]], float] = names["share_covered"]
    return found


@pytest.mark.parametrize("side", ["front", "rear"])
def test_a_covered_laser_fails_the_unit_test_and_a_dirty_one_does_not(side: str) -> None:
    measure = share_covered()
    shares = {}
    for fault in (None, f"laser_{side}_lens_dirty", f"laser_{side}_mount_turned",
                  f"laser_{side}_blocked"):  # fmt: skip
        robot = Robot(3)
        if fault is not None:
            robot.inject(fault)
        list(robot.step_until(5.0))
        scans = [m["ranges"] for t, _, m in robot.step_until(8.0) if t.endswith(f"scan_{side}")]
        shares[fault] = measure(scans)
    assert shares.pop(f"laser_{side}_blocked") > 0.1
    assert max(shares.values()) < 0.01


@pytest.mark.parametrize("side", ["front", "rear"])
@pytest.mark.parametrize(
    ("fault", "magnitude", "state"),
    [("blocked", 5.0, "present"), ("blocked", 180.0, "present"), ("lens_dirty", 0.95, "absent")],
)
def test_the_diagnosis_tells_a_covered_window_from_a_dirty_one(
    side: str, fault: str, magnitude: float, state: str
) -> None:
    fmea, _ = load_fmea(FOLDER / "fmea.yaml")
    assert fmea is not None
    robot = Robot(3)
    robot.inject(f"laser_{side}_{fault}", magnitude=magnitude)
    covered = {name: of for name, of in fmea.symptoms.items() if name.endswith(".covered")}
    tracker = ConditionTracker(replace(fmea, symptoms=covered))
    tracker.begin(START_NS)
    scans = [each for each in robot.step_until(6.0) if each[0].startswith("scan_")]
    for batch in batches(scans):
        tracker.feed(batch)
    found = tracker.advance(START_NS, START_NS + 6 * NS)
    states = {each.id: each.state for each in found}
    assert states[f"laser_{side}.covered"] == state
    assert states[f"laser_{'rear' if side == 'front' else 'front'}.covered"] == "absent"


def test_modes_name_the_outcomes_that_were_measured() -> None:
    fmea, _ = load_fmea(FOLDER / "fmea.yaml")
    assert fmea is not None
    askew = {m.id for m in fmea.modes.values() for t in m.tests if t.test == "pivots"}
    assert "wheel_rear_left#pivot_offset" in askew and "wheel_rear_left#motor_weak" not in askew
    covered = [t.outcome for t in fmea.modes["laser_front#blocked"].tests]
    assert "covered" in covered and fmea.tests["laser_front.sector"].answer("failed") == "covered"
