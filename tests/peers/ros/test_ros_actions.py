"""Actions over ROS 1 against a real master and real rospy and actionlib peers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from amberbox.core.errors import AmberboxError, NotStartedError
from amberbox.testing.actions import ManualContext
from amberbox.testing.clock import wait_until
from tests.support.action_runs import BackgroundRun, declared, timed
from tests.support.ros_nodes import PYTHON, Ros, missing_ros, system_state

FOLDER = Path(__file__).parent
COMMANDED_PACKAGES = ("actionlib", "std_srvs", "move_base_msgs", "geometry_msgs")
DRIVE = """
kind: ros1_publish
topic: /cmd_vel
type: geometry_msgs/Twist
message: {linear: {x: 0.5}}
rate: 20
duration: "{seconds}"
connect_within: 60
safe_stop: {message: {}}
parameters:
  seconds: {min: 0, max: 60}
risk: moves
"""
TEST = """
kind: ros1_action
server: /test
type: actionlib/TestAction
goal: {goal: "{what}"}
silent_within: 20
connect_within: 60
parameters:
  what: {type: int, min: 0, max: 9}
risk: moves
"""
BRIEFLY = ("connect_within: 60", "connect_within: 0.3")
AT_ONCE_S = 20.0
"""What does not wait, on a busy computer; what waits takes 60 s."""
SUCCEED, ABORT, UNTIL_PREEMPTED, DIE, IGNORE_CANCEL = 1, 2, 3, 4, 5


@dataclass
class Commanded:
    """The rospy robot that is commanded, and what it writes down."""

    ros: Ros
    out: Path
    process: subprocess.Popen[bytes]

    def notes(self, **fields: Any) -> list[dict[str, Any]]:
        """Return the notes that have these values."""
        notes = [json.loads(line) for line in self.out.read_text().splitlines() if line[-1] == "}"]
        return [note for note in notes if fields.items() <= note.items()]

    def wait_for(self, **fields: Any) -> dict[str, Any]:
        """Wait for a note with these values, and return the first."""
        wait_until(lambda: self.notes(**fields), f"a note of {fields}")
        return self.notes(**fields)[0]

    def run(self, text: str, **parameters: Any) -> Any:
        """Run an action to its end and return its result."""
        action = declared(self.ros.folder, text)
        return action.module.run(action.config, ManualContext(parameters))

    def begin(self, text: str, **parameters: Any) -> BackgroundRun:
        """Begin a run and return it."""
        return BackgroundRun(declared(self.ros.folder, text), ManualContext(parameters))

    def safe_stop(self, text: str, context: ManualContext | None = None) -> None:
        """Bring the robot to a safe state as the action's declaration says."""
        action = declared(self.ros.folder, text)
        action.module.safe_stop(action.config, context or ManualContext())

    def speeds(self) -> list[float]:
        """Return the speeds that were received."""
        return [note["x"] for note in self.notes(topic="/cmd_vel")]


@pytest.fixture
def robot(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> Iterator[Commanded]:
    if reason := missing_ros(COMMANDED_PACKAGES):
        pytest.skip(f"requires_ros: {PYTHON} cannot be commanded ({reason})")
    ros.master()
    monkeypatch.setenv("ROS_MASTER_URI", ros.uri)
    out = ros.folder / "commanded.jsonl"
    process = ros.processes.start([PYTHON, str(FOLDER / "commanded.py"), str(out)], ros.port)
    wait_until(lambda: out.exists() and out.read_text(), "the robot is ready")
    yield Commanded(ros, out, process)
    assert not ours(ros), "the actions have left registrations at the master"


def ours(ros: Ros) -> list[str]:
    """Return what the master has registered of our nodes."""
    return [
        f"{name} {node}"
        for table in system_state(ros.port)
        for name, nodes in table
        for node in nodes
        if node.startswith("/amberbox")
    ]


def test_a_message_is_repeated_for_a_time_and_then_the_robot_is_stopped(robot: Commanded) -> None:
    began = time.time()
    result = robot.run(DRIVE, seconds=0.5)
    assert result == {"published": 10, "subscribers": ["/commanded"]}
    wait_until(lambda: len(robot.speeds()) == 11, "all messages")
    assert robot.speeds() == [0.5] * 10 + [0.0]
    assert 0.45 <= robot.notes(topic="/cmd_vel")[-1]["t"] - began < AT_ONCE_S


def test_one_message_with_arrays_and_times(robot: Commanded) -> None:
    text = """
kind: ros1_publish
topic: path
type: nav_msgs/Path
message:
  header: {frame_id: map, stamp: {secs: 12, nsecs: 5}}
  poses:
    - {pose: {position: {x: "{x}"}}, header: {frame_id: a}}
    - {pose: {position: {x: -2}}}
parameters:
  x: {min: 0, max: 9}
risk: state
"""
    assert robot.run(text, x=1.5)["published"] == 1
    note = robot.wait_for(topic="/path")
    assert note == {
        "topic": "/path", "frame": "map", "secs": 12, "poses": [[1.5, "a"], [-2.0, ""]],
    }  # fmt: skip


def test_a_type_that_is_not_known_is_learnt_from_its_subscriber(robot: Commanded) -> None:
    text = """
kind: ros1_publish
topic: /goal_only
type: move_base_msgs/MoveBaseGoal
message: {target_pose: {pose: {position: {x: 3}}}}
risk: state
parameters: {}
"""
    assert robot.run(text)["published"] == 1
    assert robot.wait_for(topic="/goal_only")["x"] == 3.0


def test_a_late_subscriber_gets_the_latched_message(robot: Commanded) -> None:
    text = DRIVE.replace("rate: 20", "rate: 0\nlatch: true").replace("safe_stop: {message: {}}", "")
    run = robot.begin(text.replace("risk: moves", "risk: state"), seconds=60)
    robot.wait_for(topic="/cmd_vel", x=0.5)
    out = robot.ros.folder / "late.jsonl"
    robot.ros.processes.start([PYTHON, str(FOLDER / "listener.py"), str(out), "/cmd_vel"],
                              robot.ros.port)  # fmt: skip
    wait_until(lambda: out.exists() and out.read_text().endswith("\n"), "the late subscriber")
    heard = json.loads(out.read_text())
    assert heard["latching"] == "1" and heard["type"] == "geometry_msgs/Twist"
    run.context.stop()
    assert run.join() is None
    assert robot.speeds() == [0.5]


def test_an_abort_stops_the_robot_at_once(robot: Commanded) -> None:
    run = robot.begin(DRIVE, seconds=60)
    robot.wait_for(topic="/cmd_vel", x=0.5)
    aborted = time.time()
    run.context.stop()
    assert run.join() is None
    stopped = robot.wait_for(topic="/cmd_vel", x=0.0)["t"]
    assert stopped - aborted < AT_ONCE_S
    assert robot.speeds()[-1] == 0.0


def test_the_safe_stop_replaces_a_run_that_crashed(robot: Commanded) -> None:
    declared(robot.ros.folder, DRIVE)
    crash(robot, {"seconds": 60}, topic="/cmd_vel")
    assert ours(robot.ros) == ["/cmd_vel /amberbox_act_cmd_vel"]  # the master has not noticed
    assert timed(lambda: robot.safe_stop(DRIVE)) < AT_ONCE_S
    robot.wait_for(topic="/cmd_vel", x=0.0)
    assert robot.speeds()[-1] == 0.0


def crash(robot: Commanded, parameters: dict[str, Any], **fields: Any) -> None:
    """Run the declared action in another process, and kill that once the robot notes it."""
    script = (
        "import json, sys, pathlib\n"
        "from amberbox.experiments.action import load_action\n"
        "from amberbox.testing.actions import ManualContext\n"
        "action = load_action(pathlib.Path(sys.argv[1]), 'act')\n"
        "action.module.run(action.config, ManualContext(json.loads(sys.argv[2])))\n"
    )
    command = [sys.executable, "-c", script, str(robot.ros.folder), json.dumps(parameters)]
    environment = {**os.environ, "PYTHONPATH": str(FOLDER.parents[2])}
    process = subprocess.Popen(command, env=environment)
    try:
        robot.wait_for(**fields)
    finally:
        process.kill()
        process.wait()


def test_the_safe_stop_silences_a_run_that_goes_on(robot: Commanded) -> None:
    run = robot.begin(DRIVE, seconds=60)
    robot.wait_for(topic="/cmd_vel", x=0.5)
    robot.safe_stop(DRIVE)
    with pytest.raises(AmberboxError, match="shut down"):
        run.join()
    robot.wait_for(topic="/cmd_vel", x=0.0)
    assert robot.speeds()[-1] == 0.0


def test_a_subscriber_that_is_killed_ends_the_run(robot: Commanded) -> None:
    run = robot.begin(DRIVE, seconds=60)
    robot.wait_for(topic="/cmd_vel", x=0.5)
    robot.process.kill()
    with pytest.raises(AmberboxError, match="no subscriber of /cmd_vel"):
        run.join()


def test_a_subscriber_that_hangs_holds_up_nothing(robot: Commanded) -> None:
    run = robot.begin(DRIVE, seconds=1.0)
    robot.wait_for(topic="/cmd_vel", x=0.5)
    os.kill(robot.process.pid, signal.SIGSTOP)
    try:
        assert run.join()["published"] == 20  # the kernel takes them
    finally:
        os.kill(robot.process.pid, signal.SIGCONT)
    robot.wait_for(topic="/cmd_vel", x=0.0)


def test_a_subscriber_of_another_type_is_refused(robot: Commanded) -> None:
    text = """
kind: ros1_publish
topic: /cmd_vel
type: geometry_msgs/Vector3
connect_within: 3
risk: state
parameters: {}
"""
    with pytest.raises(NotStartedError, match=r"0 of 1 subscribers.*expects .*geometry_msgs/Twist"):
        robot.run(text)


def test_nothing_is_published_without_a_subscriber_or_a_master(robot: Commanded) -> None:
    briefly = DRIVE.replace(*BRIEFLY)
    with pytest.raises(NotStartedError, match="0 of 1 subscribers of /nobody"):
        robot.run(briefly.replace("/cmd_vel", "/nobody"), seconds=1)
    with pytest.raises(NotStartedError, match=r"127\.0\.0\.1:1"):
        robot.run(briefly + "ros_master_uri: http://127.0.0.1:1\n", seconds=1)
    assert robot.speeds() == []


SERVICE = """
kind: ros1_service
service: /{name}
answer_within: {within}
connect_within: 60
risk: state
parameters: {{}}
"""


def service(name: str, more: str = "", within: float = 60) -> str:
    return SERVICE.format(name=name, within=within) + more


def test_a_service_answers(robot: Commanded) -> None:
    assert robot.run(service("trigger")) == {"success": True, "message": "done"}
    result = robot.run(service("set", "type: std_srvs/SetBool\nrequest: {data: true}\n"))
    assert result == {"success": True, "message": "is True"}
    text = service("set", "request: {data: false}\nexpect: {success: true}\n")
    with pytest.raises(AmberboxError, match=r"/set answered .*not success: True"):
        robot.run(text)


def test_a_service_of_another_package_is_called_by_its_definition(robot: Commanded) -> None:
    text = """
type: nav_msgs/GetPlan
definition: |
  geometry_msgs/PoseStamped start
  geometry_msgs/PoseStamped goal
  float32 tolerance
  ---
  Path plan
request:
  start: {header: {frame_id: map}, pose: {position: {x: 1}}}
  goal: {pose: {position: {x: 2}}}
"""
    plan = robot.run(service("plan", text))["plan"]
    assert plan["header"]["frame_id"] == "map"
    assert [pose["pose"]["position"]["x"] for pose in plan["poses"]] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("name", "what", "started"),
    [
        ("fail", "/fail failed: .*the arm is stuck", True),
        ("hang", "/hang does not answer in time", True),
        ("die", "/die ended without a response", True),
        ("nothing", "there is no service /nothing", False),
    ],
)
def test_a_service_fails(robot: Commanded, name: str, what: str, started: bool) -> None:
    def call() -> None:
        with pytest.raises(AmberboxError, match=what) as caught:
            robot.run(service(name, within=0.5 if name == "hang" else 60))
        assert isinstance(caught.value, NotStartedError) is not started

    assert timed(call) < AT_ONCE_S


def test_a_service_with_another_md5sum_is_not_called(robot: Commanded) -> None:
    with pytest.raises(NotStartedError, match="md5"):
        robot.run(service("trigger", "type: std_srvs/SetBool\n"))
    assert robot.notes(service="/trigger") == []


def test_a_service_that_hangs_does_not_hold_up_an_abort(robot: Commanded) -> None:
    text = service("hang") + "safe_stop: {service: /trigger}\n"
    run = robot.begin(text)
    robot.wait_for(service="/hang")
    run.context.stop()
    assert timed(run.join) < AT_ONCE_S
    robot.safe_stop(text)
    assert robot.notes(service="/trigger")


def test_a_goal_succeeds(robot: Commanded) -> None:
    run = robot.begin(TEST, what=SUCCEED)
    assert run.join() == {"state": "succeeded", "text": "well done", "result": {"result": 42}}
    assert run.context.reports[-1] == "succeeded: well done"


def test_a_goal_of_move_base(robot: Commanded) -> None:
    text = """
kind: ros1_action
server: /move_base
type: move_base_msgs/MoveBaseAction
goal: {target_pose: {header: {frame_id: map, stamp: now}, pose: {position: {x: "{x}"}}}}
parameters:
  x: {min: -5, max: 5}
risk: moves
"""
    assert robot.run(text, x=-1.5)["state"] == "succeeded"
    assert robot.wait_for(action="/move_base") == {
        "action": "/move_base",
        "x": -1.5,
        "frame": "map",
    }


def test_a_goal_is_aborted(robot: Commanded) -> None:
    with pytest.raises(AmberboxError, match="the goal of /test is aborted: a wheel is blocked"):
        robot.run(TEST, what=ABORT)


def test_an_abort_cancels_the_goal(robot: Commanded) -> None:
    run = robot.begin(TEST, what=UNTIL_PREEMPTED)
    wait_until(lambda: '{"feedback": 30}' in run.context.reports, "the feedback")
    aborted = time.time()
    run.context.stop()
    assert run.join() is None
    assert robot.wait_for(action="/test", preempted=True)["t"] - aborted < AT_ONCE_S


def test_the_safe_stop_cancels_the_goal_of_a_run_that_crashed(robot: Commanded) -> None:
    declared(robot.ros.folder, TEST)
    crash(robot, {"what": UNTIL_PREEMPTED}, action="/test", goal=UNTIL_PREEMPTED)
    assert not robot.notes(preempted=True)
    robot.safe_stop(TEST)
    assert robot.notes(preempted=True)


def test_the_safe_stop_leaves_goals_of_others_alone(robot: Commanded) -> None:
    other = robot.begin(TEST + "caller_id: /somebody\n", what=UNTIL_PREEMPTED)
    robot.wait_for(action="/test", goal=UNTIL_PREEMPTED)
    robot.safe_stop(TEST)
    assert not robot.notes(preempted=True) and other.is_running
    robot.safe_stop(TEST + "safe_stop: cancel_all\n")
    robot.wait_for(preempted=True)
    with pytest.raises(AmberboxError, match="preempted: stopped"):
        other.join()


def test_a_goal_that_does_not_end_is_reported(robot: Commanded) -> None:
    run = robot.begin(TEST, what=IGNORE_CANCEL)
    robot.wait_for(action="/test", goal=IGNORE_CANCEL)
    run.context.stop()
    run.join()
    robot.wait_for(cancel=True)
    context = ManualContext()
    with ThreadPoolExecutor(1) as pool:
        stopping = pool.submit(robot.safe_stop, TEST, context)
        wait_until(lambda: len(robot.notes(cancel=True)) == 2 or stopping.done(), "a cancel")
        context.stop()
        with pytest.raises(AmberboxError, match="told to cancel, but its goals have not ended"):
            stopping.result()


def test_a_server_that_dies_loses_the_goal(robot: Commanded) -> None:
    with pytest.raises(AmberboxError, match="/test is lost: the action server is gone"):
        robot.run(TEST, what=DIE)


def test_a_server_that_hangs_loses_the_goal(robot: Commanded) -> None:
    run = robot.begin(TEST.replace("silent_within: 20", "silent_within: 2"), what=UNTIL_PREEMPTED)
    robot.wait_for(action="/test", goal=UNTIL_PREEMPTED)
    os.kill(robot.process.pid, signal.SIGSTOP)
    try:
        with pytest.raises(AmberboxError, match=r"/test is lost: .*(silent for|within) 2 s"):
            run.join()
    finally:
        os.kill(robot.process.pid, signal.SIGCONT)
    robot.wait_for(preempted=True)  # the cancel was waiting for it


def test_there_is_no_server(robot: Commanded) -> None:
    text = TEST.replace("/test", "/nowhere").replace(*BRIEFLY)
    with pytest.raises(NotStartedError, match="there is no action server /nowhere"):
        robot.run(text, what=SUCCEED)
