"""Declarations of ROS 1 actions: what is checked without a robot, and the simulated twins."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

from amberbox.core.errors import ConfigurationError, NotStartedError
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.experiments.action import load_action, read_actions
from amberbox.experiments.actions.ros1_publish import _due_times
from amberbox.testing.actions import ManualContext
from tests.support.action_runs import BackgroundRun, declared

KINDS = ("ros1_publish", "ros1_service", "ros1_action")
PUBLISH = """
kind: ros1_publish
topic: /cmd_vel
type: geometry_msgs/Twist
message: {linear: {x: "{speed}"}}
duration: 1
safe_stop: {message: {}}
parameters:
  speed: {min: -1, max: 1}
risk: moves
"""
SERVICE = """
kind: ros1_service
service: /set
type: std_srvs/SetBool
request: {data: "{on}"}
parameters:
  on: {type: bool}
risk: state
"""
ACTION = """
kind: ros1_action
server: /move_base
type: move_base_msgs/MoveBaseAction
goal: {target_pose: {pose: {position: {x: "{x}"}}}}
parameters:
  x: {min: -1, max: 1}
risk: moves
"""


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> ModuleType:
    return importlib.import_module(f"amberbox.experiments.actions.{request.param}")


def test_the_sample_is_a_declaration(kind: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "actions").mkdir()
    (tmp_path / "actions" / "sample.yaml").write_text(kind.SAMPLE)
    found, problems = read_actions(tmp_path)
    assert problems == []
    problems = []
    root = parse_yaml(kind.SAMPLE, "SAMPLE", problems)
    assert root is not None and list(root.mapping or {}) == list(found)


@pytest.mark.parametrize(
    ("text", "old", "new", "what"),
    [
        (PUBLISH, "/cmd_vel", "/cmd vel", "act.topic: '/cmd vel' is not a name ROS allows"),
        (PUBLISH, "/cmd_vel", "/../x", "is not a name ROS allows for a topic"),
        (PUBLISH, "linear: {x", "linear: {q", "linear/q is no field of geometry_msgs/Vector3"),
        (PUBLISH, "linear", "liner", "liner is no field .*; did you mean 'linear'"),
        (PUBLISH, '"{speed}"', "fast", "linear/x must be a number, not 'fast'"),
        (PUBLISH, '"{speed}"', '"{sped}"', "no parameter 'sped'; did you mean 'speed'"),
        (PUBLISH, "{message: {}}", "{message: {a: 1}}", "act.safe_stop: .*a is no field"),
        (PUBLISH, "{message: {}}", "{topic: /stop}", "needs the type of its own topic"),
        (PUBLISH, "safe_stop: {message: {}}", "latch: true", "needs a safe_stop"),
        (PUBLISH, "duration: 1", "duration: long", "'long' is no number of seconds"),
        (PUBLISH, "duration: 1", "duration: -1", "must be a number of seconds"),
        (PUBLISH, "duration: 1", "rate: 1e9", "must be from 0 to 1000 Hz"),
        (PUBLISH, "duration: 1", "queue: 0", "must be from 1 to 1000"),
        (PUBLISH, "duration: 1", "definition: 'x y z'", "act.type"),
        (PUBLISH, "duration: 1", "ros_master_uri: ftp://a", "not a protocol ROS masters speak"),
        (PUBLISH, "duration: 1", "caller_id: 'a b'", "not a name ROS allows for a node"),
        (PUBLISH, "duration: 1", "connect_within: 0", "must be above 0"),
        (SERVICE, "/set", "/s/../t", "not a name ROS allows for a service"),
        (SERVICE, "std_srvs/SetBool", "std_srvs/Setbool", "did you mean 'std_srvs/SetBool'"),
        (SERVICE, "data:", "datum:", "datum is no field"),
        (SERVICE, "type: std_srvs/SetBool\n", "definition: '---'\n", "the definition is that of a"),
        (ACTION, "/move_base", "move base", "not a name ROS allows"),
        (ACTION, "Action", "Acton", "is not the name of an action"),
        (ACTION, "move_base_msgs/M", "move_base_msgs/N", "did you mean 'move_base_msgs/MoveBase"),
        (ACTION, "target_pose", "target", "goal/target is no field"),
        (ACTION, "risk: moves", "risk: moves\nsafe_stop: ''", "needs a safe_stop"),
        (ACTION, "risk: moves", "risk: moves\nsilent_within: 0", "must be from 0.5"),
    ],
)
def test_declarations_that_are_wrong(
    text: str, old: str, new: str, what: str, tmp_path: Path
) -> None:
    assert old in text
    with pytest.raises(ConfigurationError, match=what):
        declared(tmp_path, text.replace(old, new))


@pytest.mark.parametrize("text", [PUBLISH, SERVICE, ACTION])
def test_declarations_that_are_right(text: str, tmp_path: Path) -> None:
    assert declared(tmp_path, text).has("safe_stop") is (text != SERVICE)
    stop = "safe_stop: {service: /stop, type: std_srvs/Empty}\n"
    assert declared(tmp_path, SERVICE + stop).has("safe_stop")


def test_a_type_that_is_not_known_here_is_left_to_the_robot(tmp_path: Path) -> None:
    text = PUBLISH.replace("geometry_msgs/Twist", "my_msgs/Speed")
    assert declared(tmp_path, text).config.type == "my_msgs/Speed"
    known = text + "definition: 'geometry_msgs/Vector3 linear'\n"
    assert declared(tmp_path, known)
    with pytest.raises(ConfigurationError, match="linear is no field"):
        declared(tmp_path, known.replace("Vector3 linear", "Vector3 angular"))


@pytest.mark.parametrize("text", [PUBLISH, SERVICE, ACTION])
def test_the_twin_waits_and_gives_the_declared_result(text: str, tmp_path: Path) -> None:
    name = "speed" if text == PUBLISH else "on" if text == SERVICE else "x"
    twin = f'simulated: {{value: "{{{name}}}"}}\nsimulated_for: 0.01\n'
    action = declared(tmp_path, text + twin)
    assert action.has("simulated")
    assert action.module.simulated(action.config, ManualContext({name: 1})) == {"value": 1}
    stopped = ManualContext({name: 1})
    stopped.stop()
    assert action.module.simulated(action.config, stopped) is None
    assert not declared(tmp_path, text).has("simulated")


@pytest.mark.parametrize("text", [PUBLISH, SERVICE, ACTION])
def test_without_a_master_nothing_is_started(text: str, tmp_path: Path) -> None:
    parameters = {"speed": 0.5, "on": True, "x": 0.5}
    action = declared(tmp_path, text + "ros_master_uri: http://127.0.0.1:1\n")
    with pytest.raises(NotStartedError):
        action.module.run(action.config, ManualContext(parameters))
    stopped = ManualContext(parameters)
    stopped.stop()
    assert BackgroundRun(action, stopped).join() is None


def test_the_folder_is_read_as_the_robot_does(tmp_path: Path) -> None:
    declared(tmp_path, PUBLISH)
    assert load_action(tmp_path, "act").options.risk == "moves"


@pytest.mark.parametrize(
    ("rate_hz", "duration_s", "expected"),
    [
        (10.0, 0.0, [0.0]),
        (0.0, 0.0, [0.0]),
        (0.0, 3.0, [3.0]),
        (2.0, 1.0, [0.5, 1.0]),
        (2.0, 1.2, [0.5, 1.0, 1.2]),
        (10.0, 0.3, [0.1, 0.2, 0.3]),
    ],
)
def test_when_messages_are_due(rate_hz: float, duration_s: float, expected: list[float]) -> None:
    assert list(_due_times(rate_hz, duration_s)) == pytest.approx(expected)
