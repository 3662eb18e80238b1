"""Needs in component files count for the failure modes."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.consult.folder_knowledge import fmea_references, plan_references
from amberbox.core.needs import Needs, all_of, any_of, at_least
from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.diagnosis.fmea.model import lost
from amberbox.monitoring.plan import ComponentPlan, DependencyPlan, MonitoringPlan

PARTS = ("front", "rear", "bus", "navigation")
MODE = "{failure_modes: {dead: {rate: 1e-5, unobservable: nobody looks}}}"
BLACK_BOX = "- zmq: {endpoint: 'tcp://127.0.0.1:9', topics: [{name: t}]}\n"
FMEA = f"""\
types:
  front: {MODE}
  rear: {MODE}
  bus: {MODE}
  navigation: {MODE}
functions:
  drive: {{needs: [navigation]}}
"""


def _components(path: Path, needs: str) -> Path:
    """Write a robot folder whose navigation needs something."""
    (path / "robot.yaml").write_text("id: r1\n")
    (path / "black_box.yaml").write_text(BLACK_BOX)
    (path / "fmea.yaml").write_text(FMEA)
    (path / "components").mkdir()
    for name in PARTS:
        text = f"component_name: {name}\n"
        text += f"dependencies: {needs}\n" if name == "navigation" else ""
        (path / "components" / f"{name}.yaml").write_text(text)
    return path


def _edge(name: str, component: str | None, mode: str = "", problem: str = "") -> DependencyPlan:
    return DependencyPlan(name, "functional", component, mode, problem=problem)


def _needs(*edges: DependencyPlan, needs: Needs | None = None) -> Needs:
    parts = [ComponentPlan(name, f"The {name}") for name in ("a", "b", "c", "host")]
    user = ComponentPlan("x", "x", dependencies=edges, needs=needs)
    return plan_references(MonitoringPlan("r", "h", [user, *parts])).needs["x"]


def test_all_that_is_listed_is_needed_once() -> None:
    edges = [_edge("a", "a"), _edge("b", "b"), _edge("a", "a"), _edge("c", None, "", "a circle")]
    assert _needs(*edges) == all_of("a", "b")


def test_what_one_can_do_without_stays_so() -> None:
    edges = [_edge(name, name) for name in ("a", "b", "c")]
    for needs in (any_of("a", "b", "c"), at_least(2, "a", "b", "c"), all_of("a", any_of("b", "c"))):
        assert _needs(*edges, needs=needs) == needs


def test_a_component_is_needed_whoever_speaks_for_it() -> None:
    edges = [_edge("a", "host", "m"), _edge("The b", "b"), _edge("master", "host", "m")]
    assert _needs(*edges) == all_of("a", "b", "host")
    needs = any_of("a", all_of("The b", "master"))
    assert _needs(*edges, needs=needs) == any_of("a", all_of("b", "host"))


def test_what_is_no_component_is_taken_to_be_well() -> None:
    edges = [_edge("a", "a"), _edge("b", "b"), _edge("gone", None)]
    assert _needs(*edges, needs=all_of("gone", any_of("a", "b"))) == all_of(any_of("a", "b"))
    assert _needs(*edges, needs=any_of("gone", "a")) == all_of()


@pytest.mark.parametrize(
    ("needs", "down", "is_lost"),
    [
        ("[front, rear, bus]", ["front"], True),
        ("{any: [front, rear]}", ["front"], False),
        ("{any: [front, rear]}", ["front", "rear"], True),
        ("[bus, {any: [front, rear]}]", ["rear"], False),
        ("[bus, {any: [front, rear]}]", ["bus"], True),
        ("{at_least: 2, of: [front, rear, bus]}", ["bus"], False),
        ("{at_least: 2, of: [front, rear, bus]}", ["bus", "rear"], True),
    ],
)
def test_faults_spread_by_what_component_files_say(
    tmp_path: Path, needs: str, down: list[str], is_lost: bool
) -> None:
    folder = _components(tmp_path, needs)
    fmea, problems = load_fmea(folder / "fmea.yaml", fmea_references(load_folder(folder)))
    assert fmea is not None, problems
    gone = lost(fmea, [f"{name}#dead" for name in down])
    assert gone == {*down, *(("navigation", "drive") if is_lost else ())}


MODES = {
    "tilt": ("range", "ros_imu.linear_acceleration_z", "in_range", "bool", "{min: 9, max: 11}"),
    "jerk": ("rate_of_change", "ros_imu.linear_acceleration_z", "in_limits", "bool", "{max: 5}"),
    "turn": ("rate_of_change", "ros_imu.angular_velocity_z", "rate", "float", "{max: 5}"),
    "heartbeat": ("heartbeat", "ros_imu", "alive", "bool", "{rate: 10}"),
}
"""Monitor, input, result, type of the output and arguments, by mode."""


@pytest.mark.parametrize(
    ("symptom", "unit", "what"),
    [
        ("imu/tilt/in_range", "m/s2", ""),
        ("imu/tilt/in_range", "g", "ros_imu.linear_acceleration_z is in m/s^2, not in g"),
        ("imu/jerk/in_limits", "m/s^2/s", ""),
        ("imu/jerk/in_limits", "m/s^2", "rate(ros_imu.linear_acceleration_z) is in m/s^2/s"),
        ("imu/turn/rate", "rad/s^2", ""),
        ("imu/turn/rate", "rad/s", "imu/turn/rate is in rad/s^2, not in rad/s"),
        ("imu/heartbeat/alive", "s", ""),
        ("imu/heartbeat/alive", "ms", "age(ros_imu) is in s, not in ms"),
    ],
)
def test_a_monitor_knows_the_unit_of_its_measure(
    tmp_path: Path, symptom: str, unit: str, what: str
) -> None:
    (tmp_path / "robot.yaml").write_text("id: r1\n")
    block = "- ros: {topics: [{name: /imu, type: sensor_msgs/Imu}]}\n"
    (tmp_path / "black_box.yaml").write_text(block)
    (tmp_path / "components").mkdir()
    names = ", ".join(f"imu/{name}.yaml" for name in MODES)
    (tmp_path / "components" / "imu.yaml").write_text(f"component_name: imu\nmodes: [{names}]\n")
    (tmp_path / "components" / "imu").mkdir()
    for name, (monitor, text, result, kind, arguments) in MODES.items():
        expected = "true" if kind == "bool" else "1"
        (tmp_path / "components" / "imu" / f"{name}.yaml").write_text(
            f"name: {name}\nmonitor: {monitor}\nmappings: [{{mapping: {{inputs: [{text}], outputs: "
            f"[{{output: {{name: {result}, type: {kind}, expected: {expected}}}}}]}}}}]\n"
            f"arguments: {arguments}\n"
        )
    (tmp_path / "fmea.yaml").write_text(
        f"symptoms: {{{symptom}: {{edges: [1], unit: {unit}}}}}\n"
        f"types: {{imu: {{failure_modes: {{bad: {{rate: 1e-5, symptoms: [{symptom}]}}}}}}}}\n"
    )
    _, problems = load_fmea(tmp_path / "fmea.yaml", fmea_references(load_folder(tmp_path)))
    errors = [problem.what for problem in problems if problem.is_error]
    assert [what in error for error in errors] == ([True] if what else []), errors
