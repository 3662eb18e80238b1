"""What the inputs of a mode mean: items, variables, topics, subjects of probes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.monitoring.configuration.folders import BLACK_BOX, errors, mapping_of, mode_of, notes

SIM = "- sim: {speed: 1}\n"
VARIABLE = """\
name: x
monitor: range
arguments: {{max: 3}}
mappings:
  - mapping: {{inputs: ["{text}"], outputs: [{{name: a, type: bool}}]}}
"""
ITEM = """\
name: x
monitor: heartbeat
mappings:
  - mapping: {{inputs: ["{text}"], outputs: [{{name: a, type: bool}}]}}
"""


@pytest.mark.parametrize(
    ("text", "item", "variable", "index"),
    [
        ("ros_odom.pose_pose_position_x", "ros_odom", "pose_pose_position_x", None),
        ("ros_odom/pose/pose/position/x", "ros_odom", "pose_pose_position_x", None),
        ("ros_odom.pose.pose.position.x", "ros_odom", "pose_pose_position_x", None),
        ("ros_odom.position/x", "ros_odom", "pose_pose_position_x", None),
        ("/odom/pose/pose/position/x", "ros_odom", "pose_pose_position_x", None),
        ("odom.position.x", "ros_odom", "pose_pose_position_x", None),
        ("position/x", "ros_odom", "pose_pose_position_x", None),
        ("range_max", "ros_scan_front", "range_max", None),
        ("ros_odom.pose/covariance[7]", "ros_odom", "pose_covariance_7", None),
        ("ros_odom.pose_covariance_7", "ros_odom", "pose_covariance_7", None),
        ("ros_scan_front.ranges[17]", "ros_scan_front", "ranges", 17),
        ("/scan_front/ranges/17", "ros_scan_front", "ranges", 17),
        ("ros_other.any_thing", "ros_other", "any_thing", None),
        ("ros_other/any/thing", "ros_other", "any_thing", None),
        ("ros_own_data/sensors/2/velocity_1", "ros_own_data__sensors", "velocity_1", 2),
        ("ros_own_data.count", "ros_own_data", "count", None),
        ("amberbox_host.load", "amberbox_host", "load", None),
    ],
)
def test_variables(tmp_path: Path, text: str, item: str, variable: str, index: int | None) -> None:
    (entry,) = mapping_of(tmp_path, VARIABLE.format(text=text)).inputs
    assert (entry.text, entry.kind) == (text, "variable")
    assert (entry.item, entry.variable, entry.index) == (item, variable, index)


@pytest.mark.parametrize("text", ["ros_scan_front", "/scan_front", "scan_front"])
def test_items(tmp_path: Path, text: str) -> None:
    (entry,) = mapping_of(tmp_path, ITEM.format(text=text)).inputs
    assert (entry.text, entry.kind, entry.item) == (text, "item", "ros_scan_front")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("/scan_frnt", "nothing that is recorded is called '/scan_frnt'; "
         "did you mean '/scan_front'?"),
        ("ros_odom.position/w", "ros_odom has no variable 'position/w'"),
        ("position", "nothing that is recorded is called 'position'"),
        ("ros_odom.x", "'ros_odom.x' is ambiguous: ros_odom.pose_pose_position_x or "),
        ("ros_scan_front", "'ros_scan_front' is an item, this monitor takes a variable"),
        ("ros_scan_front.ranges", "'ros_scan_front.ranges' is a list of numbers, "
         "this monitor takes a variable"),
        ("ros_own_data.cout", "'cout' is not among the variable_names of ros_own_data; "
         "did you mean 'count'?"),
        ("ros_other/sensors/*/x", "nobody can know yet how many 'sensors/*/x' there are"),
        ("zmq_battery.voltage", "nothing that is recorded is called 'zmq_battery.voltage'"),
    ],
)  # fmt: skip
def test_texts_that_mean_nothing_or_too_much(tmp_path: Path, text: str, what: str) -> None:
    mode, problems = mode_of(tmp_path, VARIABLE.format(text=text))
    (error,) = errors(problems)
    assert error.startswith(f"mode.yaml:5: mappings[0].inputs[0]: {what}")
    assert mode.problem


def test_two_matches_are_an_error(tmp_path: Path) -> None:
    other = "- zmq:\n    endpoint: tcp://localhost:5555\n    topics: [{name: odom}]\n"
    _, problems = mode_of(tmp_path, ITEM.format(text="odom"), BLACK_BOX + other)
    assert errors(problems) == [
        "mode.yaml:4: mappings[0].inputs[0]: 'odom' is ambiguous: ros_odom or zmq_odom"
    ]


def test_variables_of_unknown_types_are_noted(tmp_path: Path) -> None:
    _, problems = mode_of(tmp_path, VARIABLE.format(text="ros_other.any_thing"))
    assert errors(problems) == []
    (note,) = notes(problems)
    assert note.endswith("variables of ros_other are judged when they have been recorded")


def test_a_source_that_tells_its_topics(tmp_path: Path) -> None:
    (entry,) = mapping_of(tmp_path, VARIABLE.format(text="battery.voltage"), SIM).inputs
    assert (entry.item, entry.variable) == ("sim_battery", "voltage")
    _, problems = mode_of(tmp_path, VARIABLE.format(text="sim_battery.voltge"), SIM)
    (error,) = errors(problems)
    assert error.endswith("sim_battery has no variable 'voltge'; did you mean 'voltage'?")


def test_a_source_that_records_everything(tmp_path: Path) -> None:
    black_box = "- ros: {all_topics: true}\n"
    (entry,) = mapping_of(tmp_path, ITEM.format(text="ros_scan_front"), black_box).inputs
    assert entry.item == "ros_scan_front"
    _, problems = mode_of(tmp_path, ITEM.format(text="zmq_scan"), black_box)
    assert len(errors(problems)) == 1
    _, problems = mode_of(tmp_path, ITEM.format(text="/scan_front"), black_box)
    (error,) = errors(problems)
    assert error.endswith("; write ros_scan_front: its block does not list it")


def test_a_star_stands_for_all(tmp_path: Path) -> None:
    text = VARIABLE.format(text="sim_wheels/sensors/*/temperature_1")
    mapping = mapping_of(tmp_path, text, SIM)
    wheels = ("front_left", "front_right", "rear_left", "rear_right")
    names = [entry.variable for entry in mapping.inputs]
    assert names == [f"sensors_{wheel}_temperature_1" for wheel in wheels]
    assert [output.place for output in mapping.outputs] == [None], "one output for all of them"


def test_a_list_for_a_monitor_of_lists(tmp_path: Path) -> None:
    text = ITEM.replace("heartbeat", "garbage").format(text="/scan_front/ranges")
    (entry,) = mapping_of(tmp_path, text).inputs
    assert (entry.kind, entry.item, entry.variable) == ("list", "ros_scan_front", "ranges")


def test_subjects_of_probes(tmp_path: Path) -> None:
    text = ITEM.replace("heartbeat", "device").format(text="/scan_front")
    (entry,) = mapping_of(tmp_path, text).inputs
    assert entry.probe == ("path_exists", "/scan_front"), "a monitor of paths takes no topics"


def test_what_arguments_read(tmp_path: Path) -> None:
    text = """\
name: x
monitor: expression
arguments: {condition: "ros_odom.pose_pose_position_x < input_1"}
mappings:
  - mapping: {inputs: [range_max], outputs: [{name: a, type: bool}]}
"""
    mapping = mapping_of(tmp_path, text)
    assert [(entry.item, entry.variable) for entry in mapping.reads] == [
        ("ros_odom", "pose_pose_position_x")
    ]
    mode, problems = mode_of(tmp_path, text.replace("position_x", "position_q"))
    (error,) = errors(problems)
    assert error.startswith("mode.yaml:5: mappings[0], arguments: ros_odom has no variable")
    assert mode.problem


DIAGNOSTICS = """\
- ros:
    topics:
      - {name: /x/diagnostics, type: diagnostic_msgs/DiagnosticArray}
      - {name: /y/diagnostics}
"""


@pytest.mark.parametrize(
    "text", ["ros_x_diagnostics__status", "ros_x_diagnostics__status__values",
             "ros_y_diagnostics__status"],
)  # fmt: skip
def test_child_tables_before_they_are_recorded(tmp_path: Path, text: str) -> None:
    mode, problems = mode_of(tmp_path, ITEM.format(text=text), DIAGNOSTICS)
    assert errors(problems) == []
    entry = mode.mappings[0].inputs[0]
    assert (entry.kind, entry.item) == ("item", text)
    told = ["variables of ros_y_diagnostics are judged when they have been recorded"]
    assert [note.partition("inputs: ")[2] for note in notes(problems)] == (
        told if "_y_" in text else []
    )


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("ros_x_diagnostics__statu", "ros_x_diagnostics has no table 'ros_x_diagnostics__statu'; "
         "did you mean 'ros_x_diagnostics__status'?"),
        ("ros_z_diagnostics__status", "nothing that is recorded is called"),
    ],
)  # fmt: skip
def test_tables_that_will_not_be(tmp_path: Path, text: str, what: str) -> None:
    _, problems = mode_of(tmp_path, ITEM.format(text=text), DIAGNOSTICS)
    assert errors(problems)[0].startswith(f"mode.yaml:4: mappings[0].inputs[0]: {what}")


def test_variables_of_child_tables_before_they_are_recorded(tmp_path: Path) -> None:
    text = VARIABLE.format(text="ros_x_diagnostics__status.level")
    mode, problems = mode_of(tmp_path, text, DIAGNOSTICS)
    assert errors(problems) == [] and notes(problems) == []
    entry = mode.mappings[0].inputs[0]
    assert (entry.item, entry.variable) == ("ros_x_diagnostics__status", "level")
    wrong = VARIABLE.format(text="ros_x_diagnostics__status.levl")
    _, problems = mode_of(tmp_path, wrong, DIAGNOSTICS)
    assert "has no variable 'levl'; did you mean 'level'?" in errors(problems)[0]
