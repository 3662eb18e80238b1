"""The predecessor's mode files, and the whole configuration of its robots."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import create_store
from amberbox.blackbox.store.tail import follow
from amberbox.cli.main import main
from amberbox.core.types import Batch
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.plan_loader import load_plan
from tests.monitoring.configuration.folders import (
    component,
    errors,
    mode_files,
    mode_of,
    notes,
    plan_of,
)

BLACK_BOX = """\
- ros:
    topics:
      - topic: {name: /parser/data, type: own_msgs/Wheels, variable_names: [commands, sensors]}
      - topic: {name: /amcl_pose, type: geometry_msgs/PoseWithCovarianceStamped}
"""
PATTERN = "variable_name_pattern: ros_parser_data/sensors/*/%s\n    number_of_wheels: 3"


def _mode(name: str, outputs: str, arguments: str = "", inputs: str = "[]") -> str:
    entries = "".join(f"            - output: {{{output}}}\n" for output in outputs.split("; "))
    tail = f"arguments:\n    {arguments}\n" if arguments else ""
    return (
        f"name: {name}\nmappings:\n    - mapping:\n        inputs: {inputs}\n"
        f"        outputs:\n{entries}{tail}"
    )


def test_battery(tmp_path: Path) -> None:
    arguments = PATTERN % "voltage_bus" + "\n    lowest_voltage: 5.0\n    highest_voltage: 30.0"
    text = _mode("battery_functional_monitor", "name: percentage, type: float", arguments)
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    assert "read as the monitor 'battery'" in "".join(notes(problems))
    assert (mode.config.empty, mode.config.full) == (5.0, 30.0)
    (mapping,) = mode.mappings
    assert [(entry.item, entry.variable, entry.index) for entry in mapping.inputs] == [
        ("ros_parser_data__sensors", "voltage_bus", wheel) for wheel in range(3)
    ]
    assert mapping.outputs[0].result.name == "charge_percent"


def test_emergency_stop(tmp_path: Path) -> None:
    text = _mode(
        "e_stop_functional_monitor", "name: e_stop_pressed, type: bool", PATTERN % "status1"
    )
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    (output,) = mode.mappings[0].outputs
    assert len(mode.mappings[0].inputs) == 3
    assert (output.place, output.expectation.value) == (None, False), "pressed is not nominal"
    ((name, bit),) = mode.config.named()
    assert (name, bit.bit, bit.nominal) == ("e_stop_pressed", 2, False)


def test_wheel_status_for_each_wheel(tmp_path: Path) -> None:
    outputs = "; ".join(f"name: wheel_{wheel}, type: bool" for wheel in (1, 2, 3))
    text = _mode("smart_wheel_status_monitor", outputs, PATTERN % "status1")
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    found = mode.mappings[0].outputs
    assert [(output.place, output.expectation.value) for output in found] == [
        (0, True),
        (1, True),
        (2, True),
    ]
    assert [bit.bit for _, bit in mode.config.named()] == [0]


def test_pressure(tmp_path: Path) -> None:
    outputs = "; ".join(f"name: pressure_{wheel}, type: bool" for wheel in (1, 2, 3))
    arguments = PATTERN % "pressure" + "\n    median_window_size: 2\n    fault_threshold: 10.0"
    text = _mode("pressure_functional_monitor", outputs, arguments)
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    assert (mode.config.threshold, mode.config.window) == (10.0, 2.0)
    names = [output.result.name for output in mode.mappings[0].outputs]
    assert names == ["member_1", "member_2", "member_3"]


def test_kinematics_of_each_wheel(tmp_path: Path) -> None:
    names = ("velocity_1", "velocity_2", "velocity_pivot")
    inputs = ", ".join(f"ros_parser_data/sensors/*/{name}" for name in names)
    arguments = (
        "number_of_wheels: 2\n    pivot_velocity_threshold: 1.0\n    wheel_diameter: 0.08\n"
        "    inter_wheel_distance: 0.1"
    )
    outputs = "name: consistent, type: bool; name: residual, type: double"
    text = _mode("diff_drive_kinematics_monitor", outputs, arguments, f"[{inputs}]")
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    assert (mode.config.threshold, mode.config.window) == (1.0, 1.0)
    assert mode.config.formula.evaluate({"input_1": 1.0, "input_2": 2.0}) == pytest.approx(-1.2)
    assert [[output.name for output in mapping.outputs] for mapping in mode.mappings] == [
        ["consistent_1", "residual_1"],
        ["consistent_2", "residual_2"],
    ]
    assert [entry.index for mapping in mode.mappings for entry in mapping.inputs] == [0] * 3 + [
        1
    ] * 3


def test_localisation(tmp_path: Path) -> None:
    outputs = (
        "name: variance_x, type: float; name: variance_y, type: float; "
        "name: variance_theta, type: float; name: localised, type: bool"
    )
    arguments = "avg_variance_threshold: 0.01\n    bb_variable_name: ros_amcl_pose/pose/covariance"
    text = _mode("localisation_functional_monitor", outputs, arguments)
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    assert [entry.variable for entry in mode.mappings[0].inputs] == [
        "pose_covariance_0",
        "pose_covariance_7",
        "pose_covariance_35",
    ]


def test_wifi(tmp_path: Path) -> None:
    outputs = (
        "name: wifi_quality, type: double, expected: 50; "
        "name: wifi_strength, type: int, expected: -80"
    )
    text = _mode("wifi_functional_monitor", outputs) + "        map_outputs: True\n"
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == []
    assert any("map_outputs: ignored" in note for note in notes(problems))
    (mapping,) = mode.mappings
    assert mapping.inputs[0].probe == ("wifi", "wlan0")
    assert [str(output.expectation) for output in mapping.outputs] == [">= 50", ">= -80"]


@pytest.mark.parametrize(
    ("name", "inputs", "probe"),
    [
        ("ros_master_monitor", "[]", ("ros_master", "default")),
        ("ros_node_monitor", "[ropod/control]", ("ros_node", "/ropod/control")),
        ("ros_topic_monitor", "[cmd_vel]", ("ros_topic", "/cmd_vel")),
        ("systemd_services_active_monitor", "[roscore]", ("unit_active", "roscore")),
        ("docker_container_monitor", "[overpass]", ("container", "overpass")),
        ("docker_container_monitor", "[box_ROPODID]", ("container", "box_001")),
    ],
)
def test_services(tmp_path: Path, name: str, inputs: str, probe: tuple[str, str]) -> None:
    mode, problems = mode_of(tmp_path, _mode(name, "name: a, type: bool", "", inputs), BLACK_BOX)
    assert errors(problems) == []
    assert mode.mappings[0].inputs[0].probe == probe


@pytest.mark.parametrize(
    "name", ["slip_monitor", "cart_attachment_visual_3d_monitor", "zyre_node_functional_monitor"]
)
def test_what_has_no_counterpart_says_so(tmp_path: Path, name: str) -> None:
    text = _mode(name, "name: slip_detected , type: bool", "use_HMM: True")
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == [f"mode.yaml:1: name: no monitor goes by the name '{name}'"]
    assert mode.problem
    assert mode.mappings[0].outputs[0].name == "slip_detected"


def test_an_image_is_no_container(tmp_path: Path) -> None:
    text = _mode("docker_container_monitor", "name: a, type: bool", "", '["overpass:latest"]')
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert errors(problems) == [
        "mode.yaml:4: mappings[0].inputs: 'overpass:latest' names an image: "
        "write the name of its container"
    ]
    assert mode.problem


def test_files_that_are_ours_stay_as_they_are(tmp_path: Path) -> None:
    text = _mode(
        "battery_functional_monitor", "name: charge, type: float", "lowest_voltage: 20\n"
        "    highest_voltage: 28", "[ros_amcl_pose.pose_covariance_0]",
    )  # fmt: skip
    mode, problems = mode_of(tmp_path, text, BLACK_BOX)
    assert (errors(problems), notes(problems)) == ([], [])
    assert [entry.variable for entry in mode.mappings[0].inputs] == ["pose_covariance_0"]
    _, problems = mode_of(tmp_path, "monitor: range\n" + text, BLACK_BOX)
    unknown = [error for error in errors(problems) if "unknown key 'lowest_voltage'" in error]
    assert unknown, "a monitor that is named counts"


def test_keys_and_files_that_are_not_needed(tmp_path: Path) -> None:
    files = {
        "zyre.yaml": "component_name: zyre\nmonitor_name: zyre_monitor\nmodes: []\n",
        "application.yaml": "robot_id: ropod_001\nconfig_dirs: {hardware: a}\n",
    }
    _, problems = plan_of(tmp_path, files, BLACK_BOX)
    assert errors(problems) == []
    assert [note.split(": ")[:2] for note in notes(problems)] == [
        ["application.yaml:1", "file"],
        ["zyre.yaml:2", "monitor_name"],
    ]


def test_their_defects_are_found(tmp_path: Path) -> None:
    """The twin of the test on the real files: each kind of defect that they hold, once."""
    nodes = (
        "name: ros_node_monitor\nmappings:\n"
        "    - mapping: {inputs: [a], outputs: [{output: {name: floor_detection, type: bool}}]}\n"
        "    - mapping: {inputs: [b], outputs: [{output: {name: planner_node, type: bool}}]}\n"
    )
    files = {
        **mode_files(_mode("slip_monitor", "name: slip_detected , type: bool")),
        "ros.yaml": "component_name: ros\nmodes: [ros/nodes.yaml, ros/master.yaml]\n",
        "ros/nodes.yaml": nodes,
        "ros/master.yaml": _mode("ros_master_monitor", "name: status, type: bool"),
        "docker/containers.yaml": _mode(
            "docker_container_monitor", "name: api, type: bool", "", '["api:latest"]'
        ),
        "laser/functional.yaml": _mode(
            "laser_functional_monitor", "name: works, type: bool, expected: 0.9", "", "[/scan]"
        ),
        "laser/heartbeat.yaml": _mode(
            "laser_heartbeat_monitor", "name: works, type: bool", "", "[/scan_front]"
        ),
        "floor_detector.yaml": "component_name: floor_detector\n",
        "elevator.yaml": "component_name: elevator\n"
        "dependencies: [roscore, floor_detector, planner]\n"
        "dependency_monitors:\n    heartbeat: {roscore: ros/ros_master_monitor}\n"
        "    functional:\n        floor_detector: ros/ros_node_monitor\n"
        "        planner: ros/ros_node_monitor\n",
        "recovery_config.yaml": "roscore: {monitor: ros/ros_master_monitor}\n"
        "ros: {monitor: ros/ros_node_monitor, monitored_parameter: floor_detector}\n",
    }
    plan, problems = plan_of(tmp_path, files, BLACK_BOX)
    assert [error.partition(": ")[0] for error in errors(problems)] == [
        "docker/containers.yaml:4",
        "elevator.yaml:6",
        "elevator.yaml:7",
        "laser/functional.yaml:1",
        "laser/functional.yaml:6",
        "laser/heartbeat.yaml:4",
        "mode.yaml:1",
        "recovery_config.yaml:1",
        "recovery_config.yaml:2",
    ]
    assert any(note.startswith("elevator.yaml:4: ") for note in notes(problems))
    edges = component(plan, "elevator").dependencies
    assert [(e.component, e.mode, bool(e.problem)) for e in edges] == [
        ("ros", "ros_master_monitor", False),
        ("floor_detector", "", False),
        (None, "", True),
    ]


@pytest.fixture
def ropod(shared_data: Path, tmp_path: Path) -> Path:
    """A robot folder with the real configuration of the predecessor's robots."""
    data = shared_data / "ropod"
    shutil.copytree(data / "component_configs" / "ropod" / "robot", tmp_path / "components")
    shutil.copy(data / "black_box_configs" / "data_sources.yaml", tmp_path / "black_box.yaml")
    (tmp_path / "robot.yaml").write_text("id: ropod_001\n")
    create_store(tmp_path / "store").next_run()  # it goes on without its 'event' and 'zyre'
    return tmp_path


@pytest.mark.needs_data
def test_the_real_files_load(ropod: Path) -> None:
    plan, problems = load_plan(load_folder(ropod))
    assert len(plan.components) == 28
    assert sum(not entry.modes for entry in plan.components) == 15
    assert len(plan.modes()) == 16, "and two that no component lists"
    assert sum("no component lists this mode" in note for note in notes(problems)) == 2
    broken = {mode.id for _, mode in plan.modes() if mode.problem}
    assert broken == {
        "slip_monitor",
        "cart_attachment_visual_3d_monitor",
        "docker_container_monitor",
        "zyre_node_functional_monitor",
    }
    assert sum(len(entry.dependencies) for entry in plan.components) == 37
    judged = [e for entry in plan.components for e in entry.dependencies if e.component == "ros"]
    assert len(judged) == 20


@pytest.mark.needs_data
def test_the_real_defects_are_found(ropod: Path) -> None:
    _, problems = load_plan(load_folder(ropod))
    assert len(errors(problems)) == 16
    dangling = [note for note in notes(problems) if "there is no component" in note]
    assert len(dangling) == 17


@pytest.mark.needs_data
def test_the_real_files_run_on_a_real_recording(ropod: Path, shared_data: Path) -> None:
    data = shared_data / "ropod"
    command = ["import", str(data / "bb_test_data"), "--store", str(ropod / "store")]
    assert main([*command, "--msg", str(data / "message_definitions")]) == 0
    plan, problems = load_plan(load_folder(ropod))
    assert not any("judged when they have been recorded" in note for note in notes(problems))
    engine = Engine(plan)
    found = [entry for entry in follow(ropod / "store", live=False) if isinstance(entry, Batch)]
    found.sort(key=lambda batch: int(batch.log_time_ns[0]))
    engine.begin(int(found[0].log_time_ns[0]))
    for batch in found:
        engine.feed(batch)
    engine.advance(max(int(batch.log_time_ns[-1]) for batch in found))
    statuses = {(status.component, status.mode): status for status in engine.statuses()}
    assert {name: statuses[name, ""].level for name in ("battery", "e_stop", "pressure")} == {
        "battery": "ok",
        "e_stop": "ok",
        "pressure": "ok",
    }
    battery = statuses["battery", "battery_functional_monitor"]
    assert battery.outputs["battery_percentage"] == pytest.approx(81.3, abs=0.5)
    assert statuses["e_stop", "e_stop_functional_monitor"].outputs == {"e_stop_pressed": False}
    wheels = statuses["smart_wheel", "diff_drive_kinematics_monitor"].outputs
    residuals = [wheels[f"residual_{wheel}"] for wheel in (1, 2, 3, 4)]
    assert all(isinstance(value, float) and 0 < value < 0.05 for value in residuals)
    assert statuses["localisation", ""].level == "unknown", "nothing was recorded of it"
    assert statuses["platform", "slip_monitor"].level == "unknown"
