"""The actor and its parent, as real processes: whatever dies or hangs, the robot is stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.agent.actor import COMMAND, Ended, Task
from amberbox.agent.actor_supervisor import ActorProcess, Outcome, SupervisedActor
from amberbox.core.errors import UsageError
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.zmq_robot import ZmqRobot, boot_s, zmq_robot

SOON_S = 10.0
"""What comes at once, on a busy machine; what goes on by itself takes 60 s."""
DRIVE = """\
drive:
  kind: zmq_request
  endpoint: ENDPOINT
  connect_within: 60 s
  answer_within: 60 s
  request: {do: linear, distance_m: "{distance_m}"}
  poll: {do: state}
  until: {moving: false}
  poll_every: 0.05 s
  safe_stop: {do: stop}
  simulated: {ok: true}
  simulated_for: 0 s
  parameters:
    distance_m: {unit: m, min: -2, max: 2}
  risk: moves
  timeout: 60 s
"""
OWN = """\
own:
  kind: python
  file: own.py
  function: act
  SAFE_STOP
  risk: RISK
  timeout: 60 s
  stop_timeout: STOP_S s
"""
TELL = """\
import json, os, sys, time, threading
import zmq
def tell(what):
    socket = zmq.Context.instance().socket(zmq.REQ)
    socket.linger = 0
    socket.connect("ENDPOINT")
    socket.send_json({"do": what})
    socket.recv()
    socket.close()
"""
STOP = """\
def stop(context):
    tell("stop")
"""


@pytest.fixture
def robot() -> Iterator[ZmqRobot]:
    with zmq_robot() as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path, robot: ZmqRobot) -> Path:
    """A robot folder whose action ``drive`` moves the robot until it is told to stop."""
    (tmp_path / "actions").mkdir()
    text = DRIVE.replace("ENDPOINT", robot.endpoint)
    (tmp_path / "actions" / "drive.yaml").write_text(text)
    return tmp_path


Own = Callable[..., Task]


@pytest.fixture
def own(folder: Path, robot: ZmqRobot) -> Own:
    """Declare the action ``own`` with Python code for ``act`` and ``stop``; return its task."""

    def declare(act: str, stop: str = STOP, stop_s: float = 30.0, **more: Any) -> Task:
        declared = OWN.replace("RISK", "moves" if stop else "state").replace("STOP_S", f"{stop_s}")
        declared = declared.replace("SAFE_STOP", "safe_stop: stop" if stop else "")
        code = TELL.replace("ENDPOINT", robot.endpoint) + textwrap.dedent(act) + stop
        (folder / "actions" / "own.yaml").write_text(declared)
        (folder / "actions" / "own.py").write_text(code)
        return Task(str(folder), "own", **more)

    return declare


def drive(folder: Path, **more: Any) -> Task:
    return Task(str(folder), "drive", '{"distance_m": 1.5}', **more)


def to_end(actor: SupervisedActor, *, renew: bool = True) -> Outcome:
    """Renew the lease until the action has ended."""
    end_s = time.monotonic() + PATIENCE_S
    while (outcome := actor.wait(0.1)) is None:
        if renew:
            actor.renew()
        assert time.monotonic() < end_s, "the actor ends"
    assert actor.filenos() == ()
    return outcome


def until_running(actor: SupervisedActor) -> None:
    def runs() -> bool:
        actor.renew()
        assert actor.wait(0.02) is None, actor.outcome
        return actor.is_running

    wait_until(runs, "the action runs")


def moving(actor: SupervisedActor, robot: ZmqRobot) -> None:
    """Wait until the robot moves."""

    def moves() -> bool:
        actor.renew()
        assert actor.wait(0.02) is None, actor.outcome
        return robot.moving

    wait_until(moves, "the robot moves")


def test_done(folder: Path, robot: ZmqRobot) -> None:
    actor = SupervisedActor(drive(folder))
    moving(actor, robot)
    robot.moving = False  # it has arrived
    outcome = to_end(actor)
    assert (outcome.state, outcome.reason) == ("done", "")
    assert json.loads(outcome.result) == {"ok": True, "moving": False}
    assert robot.hears[0][1] == {"do": "linear", "distance_m": 1.5}
    assert robot.heard("stop") == []
    assert actor.step() == outcome, "it stays so"


def test_a_process_that_waits_for_its_task_saves_the_start(folder: Path, robot: ZmqRobot) -> None:
    robot.answers["state"] = b'{"moving": false}'
    process = ActorProcess()
    outcome = to_end(SupervisedActor(drive(folder), process=process))
    assert outcome.state == "done"
    spare = ActorProcess()
    spare.close()
    assert spare.process.returncode is not None


def test_simulated_twin_needs_no_robot(folder: Path, robot: ZmqRobot) -> None:
    outcome = to_end(SupervisedActor(drive(folder, simulated=True)))
    assert (outcome.state, json.loads(outcome.result)) == ("done", {"ok": True})
    assert robot.hears == []


def test_killed_while_the_robot_moves(folder: Path, robot: ZmqRobot) -> None:
    actor = SupervisedActor(drive(folder))
    moving(actor, robot)
    killed_s = boot_s()
    os.kill(actor.pid, signal.SIGKILL)
    outcome = to_end(actor)
    assert outcome.state == "outcome_unknown"
    assert outcome.reason == "its process was killed (SIGKILL)"
    assert not robot.moving
    assert robot.heard("stop")[0] > killed_s


def test_killed_while_it_stops(own: Own, robot: ZmqRobot) -> None:
    stop = """
def stop(context):
    tell("stop")
    if not os.path.exists("stopped_once"):
        open("stopped_once", "w").close()
        time.sleep(1000)
"""
    actor = SupervisedActor(own("def act(context):\n    context.wait(60)\n", stop))
    until_running(actor)
    actor.abort("by anna")
    robot.wait_until("stop")
    os.kill(actor.pid, signal.SIGKILL)
    outcome = to_end(actor)
    assert outcome == Outcome("outcome_unknown", "its process was killed (SIGKILL)")
    assert len(robot.heard("stop")) == 2


def test_only_stops_after_a_run_that_nobody_has_seen_end(folder: Path, robot: ZmqRobot) -> None:
    ended = Ended("outcome_unknown", "the robot was restarted")
    outcome = to_end(SupervisedActor(drive(folder, after=ended)))
    assert outcome == Outcome("outcome_unknown", "the robot was restarted")
    assert [said["do"] for _, said in robot.hears] == ["stop"]
    twin = drive(folder, simulated=True, after=ended)
    assert to_end(SupervisedActor(twin)) == outcome, "nothing has to be stopped"
    assert len(robot.hears) == 1


def test_an_actor_that_fails_itself_stops_without_its_parent(own: Own, robot: ZmqRobot) -> None:
    act = """
    def act(context):
        tell("linear")
        import select
        select.select = None
        time.sleep(1000)
    """
    with subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        assert process.stdin is not None
        process.stdin.write(msgspec.json.encode(own(act)) + b"\n")
        process.stdin.flush()
        robot.wait_until("stop")
    assert not robot.moving


def test_lost_renewals(folder: Path, robot: ZmqRobot) -> None:
    actor = SupervisedActor(drive(folder))
    moving(actor, robot)
    last_s = boot_s()
    actor.renew()
    outcome = to_end(actor, renew=False)
    assert outcome == Outcome("aborted", "lease lost: no renewal for 3 s")
    assert 2.9 < robot.heard("stop")[0] - last_s < 3 + SOON_S
    assert not robot.moving


def test_abort_twice(folder: Path, robot: ZmqRobot) -> None:
    actor = SupervisedActor(drive(folder))
    moving(actor, robot)
    aborted_s = boot_s()
    actor.abort("by anna")
    actor.abort("by bert")
    outcome = to_end(actor)
    actor.abort("by nobody")
    assert outcome == Outcome("aborted", "by anna")
    assert actor.step() == outcome
    assert len(robot.heard("stop")) == 1
    assert robot.heard("stop")[0] - aborted_s < SOON_S


def test_abort_before_it_begins(folder: Path, robot: ZmqRobot) -> None:
    actor = SupervisedActor(drive(folder))
    actor.abort()
    assert to_end(actor).state == "aborted"
    assert robot.heard("linear") == []


def raw(task: Task) -> subprocess.Popen[bytes]:
    """Start an actor without its parent."""
    process = subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    process.stdin.write(msgspec.json.encode(task) + b"\n")
    process.stdin.flush()
    return process


def states(process: subprocess.Popen[bytes]) -> list[Any]:
    assert process.stdout is not None
    with process.stdout:
        found = [json.loads(line) for line in process.stdout]
    assert process.wait(PATIENCE_S) == 0
    return found


def test_the_parent_is_gone(folder: Path, robot: ZmqRobot) -> None:
    process = raw(drive(folder))
    robot.wait_until("linear")
    assert process.stdin is not None
    ended_s = boot_s()
    process.stdin.close()
    found = states(process)
    assert [state["state"] for state in found] == ["running", "stopping", "aborted"]
    assert found[-1]["reason"] == "lease lost: the process that held it is gone"
    assert robot.heard("stop")[0] - ended_s < SOON_S


def test_terminated(folder: Path, robot: ZmqRobot) -> None:
    process = raw(drive(folder))
    robot.wait_until("linear")
    process.terminate()
    process.terminate()
    found = states(process)
    assert process.stdin is not None
    process.stdin.close()
    assert found[-1] == {"state": "aborted", "reason": "its process was terminated"}
    assert len(robot.heard("stop")) == 1


@pytest.mark.parametrize("line", [b"{}\n", b"\xff\n", b'{"folder": 1}\n', b"[" * 300_000])
def test_what_is_no_task(line: bytes) -> None:
    found = subprocess.run(COMMAND, input=line, stdout=subprocess.PIPE, timeout=PATIENCE_S)
    assert found.returncode in (0, 1)
    assert [json.loads(state)["state"] for state in found.stdout.splitlines()] in (["failed"], [])


def test_no_task(folder: Path) -> None:
    found = subprocess.run(COMMAND, input=b"", capture_output=True, timeout=PATIENCE_S)
    assert (found.returncode, found.stdout, found.stderr) == (0, b"", b"")
    with pytest.raises(UsageError, match="at most"):
        SupervisedActor(Task(str(folder), "drive", "x" * 100_000))


def test_out_of_time(own: Own, robot: ZmqRobot) -> None:
    task = own('def act(context):\n    tell("linear")\n    context.wait(60)\n', timeout_s=0.3)
    began_s = boot_s()
    outcome = to_end(SupervisedActor(task))
    assert outcome == Outcome("failed", "not done within 0.3 s")
    assert 0.3 <= robot.heard("stop")[0] - began_s < 3 * SOON_S


def test_a_run_that_hangs_is_ended_before_the_last_stop(own: Own, robot: ZmqRobot) -> None:
    """It goes on commanding the robot, and takes no notice that it must end."""
    act = """
    def act(context):
        while True:
            tell("linear")
            time.sleep(0.005)
    """
    actor = SupervisedActor(own(act))
    moving(actor, robot)
    aborted_s = boot_s()
    actor.abort()
    outcome = to_end(actor)
    assert outcome.state == "aborted", outcome
    stops = robot.heard("stop")
    assert stops[0] - aborted_s < SOON_S
    assert len(stops) == 2
    assert robot.heard("linear")[-1] < stops[-1], "nothing commands it after the last stop"
    assert not robot.moving


def test_a_run_that_holds_the_interpreter(own: Own, robot: ZmqRobot) -> None:
    """No other thread of the process can run: its parent kills it and stops the robot afresh."""
    act = """
    import re
    def act(context):
        tell("linear")
        re.match("(a*)*b", "a" * 40)
    """
    actor = SupervisedActor(own(act))
    moving(actor, robot)
    actor.abort("by anna")
    outcome = to_end(actor)
    assert outcome.state == "aborted"
    assert outcome.reason == "by anna; its process did not react and was killed"
    assert not robot.moving


def test_a_safe_stop_that_hangs(own: Own, robot: ZmqRobot) -> None:
    stop = 'def stop(context):\n    tell("stop")\n    time.sleep(1000)\n'
    act = "def act(context):\n    context.wait(60)\n"
    actor = SupervisedActor(own(act, stop, stop_s=0.5))
    until_running(actor)
    aborted_s = boot_s()
    actor.abort("by anna")
    outcome = to_end(actor)
    assert outcome.state == "outcome_unknown", "nobody knows whether the robot stands"
    what = "the safe stop did not end within 0.5 s and was given up"
    assert outcome.reason == f"by anna; {what}"
    assert len(robot.heard("stop")) == 2, "once more in a process in which nothing else hangs"
    assert boot_s() - aborted_s < 30


def test_a_safe_stop_that_fails_and_one_that_dies(own: Own) -> None:
    act = "def act(context):\n    context.wait(60)\n"
    for stop, what in (
        ("raise OSError('no bus')", "the safe stop failed: OSError: no bus (own.py:13)"),
        ("os._exit(3)", "the safe stop failed: its process ended with exit status 3"),
    ):
        actor = SupervisedActor(own(act, f"def stop(context):\n    {stop}\n"))
        until_running(actor)
        actor.abort("by anna")
        outcome = to_end(actor)
        assert outcome.state == "outcome_unknown"
        assert outcome.reason.endswith(what), outcome.reason


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("raise ValueError('seven')", "ValueError: seven (own.py:11)"),
        ("sys.exit('enough')", "SystemExit: enough (own.py:11)"),
        ("raise KeyboardInterrupt", "KeyboardInterrupt (own.py:11)"),
        ("x = 'x' * (4 << 30)", "MemoryError (own.py:11)"),
        ("def f(): f()\n    f()", "RecursionError: maximum recursion depth exceeded (own.py:11)"),
        ("raise Exception('a\\n\\x1b[2Jb' * 1000)", "Exception: a \\u001b[2Jba"),
    ],
)
def test_an_action_may_raise_anything(own: Own, robot: ZmqRobot, code: str, reason: str) -> None:
    outcome = to_end(SupervisedActor(own(f"def act(context):\n    {code}\n")))
    assert outcome.state == "failed"
    assert outcome.reason.startswith(reason)
    assert "Traceback" not in outcome.reason + outcome.printed
    assert len(outcome.reason) <= 600
    assert len(robot.heard("stop")) == 1, "it may have moved before it failed"


def test_a_process_that_leaves_without_a_word(own: Own, robot: ZmqRobot) -> None:
    outcome = to_end(
        SupervisedActor(own('def act(context):\n    tell("linear")\n    os._exit(0)\n'))
    )
    assert outcome == Outcome("outcome_unknown", "its process ended with exit status 0")
    assert not robot.moving


def test_without_a_safe_stop(own: Own, robot: ZmqRobot) -> None:
    act = 'def act(context):\n    tell("state")\n    context.wait(60)\n'
    actor = SupervisedActor(own(act, ""))
    until_running(actor)
    os.kill(actor.pid, signal.SIGKILL)
    assert to_end(actor).state == "outcome_unknown"
    actor = SupervisedActor(own(act, ""))
    until_running(actor)
    actor.abort("by anna")
    assert to_end(actor) == Outcome("aborted", "by anna")
    assert robot.heard("stop") == []


def test_killed_before_it_began(folder: Path, robot: ZmqRobot) -> None:
    actor = SupervisedActor(drive(folder))
    os.kill(actor.pid, signal.SIGKILL)
    outcome = to_end(actor)
    assert (outcome.state, outcome.reason[-15:]) == ("failed", "before it began")
    assert robot.hears == []


def test_prints_and_reports_a_lot(own: Own, robot: ZmqRobot) -> None:
    act = """
    def act(context):
        for number in range(20000):
            print("x" * 1000)
            os.write(2, b"y" * 100)
            context.report("line " + str(number) + "z" * 10000)
        print("the end")
        return {"ok": True}
    """
    reports: list[str] = []
    outcome = to_end(SupervisedActor(own(act), reports.append))
    assert (outcome.state, outcome.result) == ("done", '{"ok": true}')
    assert len(outcome.printed) <= 4096
    assert outcome.printed.endswith("the end\n")
    assert reports[0].startswith("line 0zzz")
    assert max(map(len, reports)) <= 500
    assert len(reports) < 2000


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("{'far': float('nan')}", "its result is no JSON"),
        ("{'x': 'y' * 100000}", "its result has 100009 bytes and was left out"),
        ("{'x': object()}", "its result is no JSON"),
    ],
)
def test_results_that_are_left_out(own: Own, value: str, reason: str) -> None:
    outcome = to_end(SupervisedActor(own(f"def act(context):\n    return {value}\n")))
    assert (outcome.state, outcome.result) == ("done", "")
    assert outcome.reason.startswith(reason)


def test_what_an_action_leaves_behind_ends_with_it(own: Own, tmp_path: Path) -> None:
    act = """
    import subprocess
    def act(context):
        print(subprocess.Popen(["sleep", "1000"]).pid)
    """
    outcome = to_end(SupervisedActor(own(act)))
    assert outcome.state == "done"
    pid = int(outcome.printed)

    def is_gone() -> bool:
        try:
            return "Z" in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return True

    wait_until(is_gone, "the child is gone")


@pytest.mark.parametrize(
    ("action", "parameters", "reason"),
    [
        ("drve", "{}", "this robot has no action 'drve'; did you mean 'drive'?"),
        ("drive", '{"distance_m": 2.5}', "distance_m: 2.5 is above the largest value, 2 m"),
        ("drive", '{"distance_m": NaN}', "the parameters are no JSON: NaN is no number"),
        ("drive", "{}", "distance_m is missing"),
    ],
)
def test_refused_before_it_begins(
    folder: Path, robot: ZmqRobot, action: str, parameters: str, reason: str
) -> None:
    outcome = to_end(SupervisedActor(Task(str(folder), action, parameters)))
    assert (outcome.state, outcome.reason) == ("failed", reason)
    assert robot.hears == []


def test_nobody_listens(folder: Path, robot: ZmqRobot) -> None:
    text = DRIVE.replace("ENDPOINT", "tcp://127.0.0.1:9")
    text = text.replace("connect_within: 60 s", "connect_within: 0.2 s")
    (folder / "actions" / "drive.yaml").write_text(text)
    outcome = to_end(SupervisedActor(drive(folder)))
    assert (outcome.state, outcome.reason) == ("failed", "nobody listens at tcp://127.0.0.1:9")
    assert "is the peer running" in outcome.hint
