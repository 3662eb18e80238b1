"""Component and mode files become a plan; errors are reported with file and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.monitoring.plan_loader import load_plan
from tests.monitoring.configuration.folders import (
    component,
    errors,
    make_folder,
    mode_of,
    notes,
    plan_of,
)

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "laser"
RANGE = """\
name: heat
monitor: range
mappings:
  - mapping:
      inputs: [ros_odom.pose_pose_position_x]
      outputs:
        - output: {name: fine, type: bool}
arguments: {max: 3}
"""


def test_the_paper_s_laser() -> None:
    plan, problems = load_plan(load_folder(EXAMPLE))
    assert problems == []
    (laser,) = plan.components
    assert (plan.robot, laser.id, laser.name) == ("ropod_001", "laser", "laser")
    device, heartbeat = laser.modes
    assert (device.id, device.name) == ("laser_device_monitor", "laser_device_monitor")
    assert device.module is not None and device.module.__name__.endswith("modes.device")
    assert heartbeat.module is not None and heartbeat.module.__name__.endswith("modes.heartbeat")
    (of_device,), (of_heartbeat,) = device.mappings, heartbeat.mappings
    assert of_device.inputs[0].probe == ("path_exists", "/dev/front_laser")
    assert of_device.inputs[0].item == "probe_path_exists_dev_front_laser"
    assert (of_heartbeat.inputs[0].kind, of_heartbeat.inputs[0].item) == ("item", "ros_scan_front")
    outputs = [of_device.outputs[0], of_heartbeat.outputs[0]]
    assert [output.name for output in outputs] == ["front_laser_working"] * 2
    assert [output.expectation.value for output in outputs] == [True, True]
    assert [output.severity for output in outputs] == ["urgent", "urgent"]
    assert plan.probes() == [("path_exists", "/dev/front_laser")]


def test_a_folder_without_components(tmp_path: Path) -> None:
    plan, problems = plan_of(tmp_path, {})
    assert (plan.components, problems) == ((), [])


def test_the_paper_s_name_and_ours(tmp_path: Path) -> None:
    files = {
        "a.yaml": "name: Front Laser\nmodes: []\n",
        "deep/er/b.yaml": "component_name: b\ndescription: two\npart_of: Front Laser\n"
        "policy: any\nrecovery_actions: [restart]\n",
    }
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == []
    assert notes(problems) == ["a.yaml:1: component_name: is 'front_laser' in addresses"]
    assert [(entry.id, entry.name) for entry in plan.components] == [
        ("front_laser", "Front Laser"),
        ("b", "b"),
    ]
    b = component(plan, "b")
    assert (b.part_of, b.policy, b.description) == ("front_laser", "any", "two")
    assert b.recovery_actions == ("restart",)


@pytest.mark.parametrize("place", ["sub/modes/heat.yaml", "modes/heat.yaml"])
def test_mode_paths_are_seen_from_the_component_then_from_the_folder(
    tmp_path: Path, place: str
) -> None:
    files = {"sub/a.yaml": "component_name: a\nmodes: [modes/heat.yaml]\n", place: RANGE}
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == []
    assert component(plan, "a").modes[0].id == "heat"


def test_what_is_wrong_is_said_with_its_line_and_the_rest_runs(tmp_path: Path) -> None:
    files = {
        "a.yaml": "component_name: a\nmodes: [heat.yaml, haet.yaml]\ndependencies: [c]\n",
        "heat.yaml": RANGE,
        "b.yaml": "component_name: b\ndependensies: [a]\n",
        "c.yaml": "component_name: c\nmodes: [broken.yaml]\n",
        "broken.yaml": "name: x\nmappings: [\n",
        "odd.yaml": "hello: world\n",
    }
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == [
        "a.yaml:2: modes[1]: there is no mode file 'haet.yaml'; did you mean 'heat.yaml'?",
        "b.yaml:2: file: unknown key 'dependensies'; did you mean 'dependencies'?",
        "broken.yaml:3: syntax: while parsing a flow node "
        "expected the node content, but found '<stream end>'",
        "odd.yaml:1: file: is neither a component nor a mode of one",
    ]
    modes = {(c.id, m.id): m.problem for c, m in plan.modes()}
    assert modes["a", "heat"] == ""
    assert modes["a", "haet"].startswith("there is no mode file 'haet.yaml'")
    assert modes["c", "broken"].endswith("broken.yaml cannot be read")
    assert "unknown key 'dependensies'" in modes["b", "configuration"]


def test_wrong_component_files_do_not_stop_the_recording(tmp_path: Path) -> None:
    make_folder(tmp_path, {"a.yaml": "component_name: [\n"})
    assert load_folder(tmp_path).robot.id == "ropod_001"


def test_names_are_taken_once(tmp_path: Path) -> None:
    twice = "  - {inputs: [ros_odom.pose_pose_position_y], outputs: [{name: fine, type: bool}]}\n"
    files = {
        "a.yaml": "component_name: a\nmodes: [heat.yaml, other.yaml, twice.yaml]\n",
        "b.yaml": "component_name: A\n",
        "heat.yaml": RANGE,
        "other.yaml": RANGE,
        "twice.yaml": RANGE.replace("heat", "twice").replace("arguments", f"{twice}arguments"),
    }
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == [
        f"b.yaml:1: component_name: there is another component 'a' in {tmp_path}/components/a.yaml",
        "other.yaml:1: name: a has several modes called 'heat'",
        "twice.yaml:8: outputs: there are several outputs called 'fine'",
    ]
    (a,) = plan.components
    assert [mode.id for mode in a.modes] == ["heat", "heat_2", "twice"]
    assert [bool(mode.problem) for mode in a.modes] == [False, True, True]


def test_modes_that_no_component_lists_are_judged(tmp_path: Path) -> None:
    plan, problems = plan_of(tmp_path, {"heat.yaml": RANGE.replace("max", "maxx")})
    assert plan.components == ()
    assert notes(problems) == [
        "heat.yaml:1: file: no component lists this mode: it is checked, but not run"
    ]
    assert errors(problems) == ["heat.yaml:8: arguments: unknown key 'maxx'; did you mean 'max'?"]


def test_a_fault_is_called_by_a_name_of_its_own(tmp_path: Path) -> None:
    """Otherwise a component in error could have the state nominal."""
    text = RANGE.replace("name: fine", "name: stale") + "states: {nominal: stale == false}\n"
    _, problems = mode_of(tmp_path, text)
    assert errors(problems) == [
        "mode.yaml:7: mappings[0].outputs[0].name: 'stale' is a state of its own; "
        "faults are called after outputs",
        "mode.yaml:9: states: 'nominal' is a state of its own: give the fault another name",
    ]


def test_states_are_conditions_over_outputs(tmp_path: Path) -> None:
    text = RANGE + "states:\n  hot: not fine\n  cold: not fin\n  warm: 3\n"
    mode, problems = mode_of(tmp_path, text)
    found = errors(problems)
    assert len(found) == 2
    assert found[0].startswith("mode.yaml:11: states.cold: expression, column 5: ")
    assert "did you mean 'fine'?" in found[0]
    assert found[1] == "mode.yaml:12: states.warm: is no condition: it gives number"
    assert list(mode.states) == ["hot", "warm"]


@pytest.mark.parametrize(
    ("line", "seconds"),
    [("", 5.0), ("stale_after: 2 min\n", 120.0), ("stale_after: never\n", None)],
)
def test_stale_after(tmp_path: Path, line: str, seconds: float | None) -> None:
    mode, problems = mode_of(tmp_path, RANGE + line)
    assert errors(problems) == []
    assert mode.stale_s == seconds


def test_a_monitor_of_the_robot_s_own(tmp_path: Path) -> None:
    own = (EXAMPLE.parents[1] / "src/amberbox/monitoring/modes/range.py").read_text()
    (tmp_path / "modes").mkdir()
    (tmp_path / "modes" / "heat.py").write_text(own)
    mode, problems = mode_of(tmp_path, RANGE.replace("monitor: range", "monitor: heat"))
    assert errors(problems) == []
    assert mode.module is not None and mode.module.__file__ == str(tmp_path / "modes" / "heat.py")


@pytest.mark.parametrize(
    ("code", "what"),
    [
        (
            "class Config: ...\ndef evaluate(): ...\nimport no_such_thing\n",
            "cannot be loaded",
        ),
        ("class Config: ...\ndef evaluate(): ...\n1 / 0\n", "ZeroDivisionError"),
        ("class Config: ...\ndef evaluate(): ...\n", "does not define ACCEPTS, RESULTS"),
        ("class Config:\n", "cannot be loaded: IndentationError"),
        ("class Config: ...\ndef evaluate(): ...\nraise SystemExit(3)\n", "SystemExit: 3"),
    ],
)
def test_a_monitor_that_cannot_be_loaded(tmp_path: Path, code: str, what: str) -> None:
    (tmp_path / "modes").mkdir()
    (tmp_path / "modes" / "heat.py").write_text(code)
    mode, problems = mode_of(tmp_path, RANGE.replace("monitor: range", "monitor: heat"))
    (error,) = errors(problems)
    assert error.startswith("mode.yaml:2: monitor: ") and what in error
    assert what in mode.problem


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ("def results_of(*_):\n    return 1 / 0\n", "crashed when it was asked: ZeroDivisionError"),
        ("def history_s(_):\n    return 1 / 0\n", "crashed when it was asked: ZeroDivisionError"),
        ("def timed(_):\n    raise SystemExit(3)\n", "crashed when it was asked: SystemExit: 3"),
        ("def history_s(_):\n    return float('inf')\n", "looks back inf s, which cannot be"),
    ],
)
def test_a_monitor_that_crashes_when_it_is_asked(tmp_path: Path, code: str, what: str) -> None:
    """All functions are called here: an error at run time would also stop other monitors."""
    own = (EXAMPLE.parents[1] / "src/amberbox/monitoring/modes/range.py").read_text()
    (tmp_path / "modes").mkdir()
    (tmp_path / "modes" / "heat.py").write_text(f"{own}\n\n{code}")
    mode, problems = mode_of(tmp_path, RANGE.replace("monitor: range", "monitor: heat"))
    (error,) = errors(problems)
    assert error.startswith("mode.yaml:2: monitor: its monitor ") and what in error
    assert what in mode.problem


def test_what_is_wrong_with_a_file_that_many_list_is_told_once(tmp_path: Path) -> None:
    files = {f"part{k}.yaml": f"component_name: p{k}\nmodes: [mode.yaml]\n" for k in range(3)}
    files["mode.yaml"] = RANGE.replace("max: 3", "high: 3")
    plan, problems = plan_of(tmp_path, files)
    assert len(errors(problems)) == len(set(errors(problems)))
    assert all(mode.problem for _, mode in plan.modes())


def test_not_all_items_that_are_not_known_yet_are_named(tmp_path: Path) -> None:
    box = "- ros:\n    topics:\n" + "".join(
        f"      - topic: {{name: /own{k}, type: own_msgs/Own}}\n" for k in range(20)
    )
    inputs = ", ".join(f"ros_own{k}.x" for k in range(20))
    text = RANGE.replace("ros_odom.pose_pose_position_x", inputs)
    _, problems = mode_of(tmp_path, text, box)
    (note,) = [note for note in notes(problems) if "judged when" in note]
    assert "ros_own19 and 8 more are judged when" in note
