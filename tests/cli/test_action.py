"""``amberbox action``: what a robot can do, and doing it by hand; ``check`` judges it."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.testing.clock import PATIENCE_S
from tests.support.processes import command
from tests.support.zmq_robot import ZmqRobot, zmq_robot

ACTIONS = """\
drive:
  description: Drive straight ahead
  kind: zmq_request
  endpoint: ENDPOINT
  connect_within: 60 s
  answer_within: 60 s
  request: {do: linear, distance_m: "{distance_m}", slow: "{slow}", where: "{where}"}
  poll: {do: state}
  until: {moving: false}
  poll_every: 0.05 s
  safe_stop: {do: stop}
  simulated: {at: "{distance_m}"}
  simulated_for: 0 s
  parameters:
    distance_m: {unit: m, min: -2, max: 2}
    slow: {type: bool, default: false}
    where: {type: string, default: hall}
  risk: moves
list:
  description: List a folder
  kind: shell
  command: [ls, "{folder}"]
  parameters:
    folder: {choices: [actions, nowhere]}
  risk: state
"""


@pytest.fixture
def robot() -> Iterator[ZmqRobot]:
    with zmq_robot() as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path, robot: ZmqRobot) -> str:
    (tmp_path / "robot.yaml").write_text("id: r1\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {}\n")
    (tmp_path / "actions").mkdir()
    (tmp_path / "actions" / "a.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
    return str(tmp_path)


def test_list(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["action", folder]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == [
        "drive", "moves", "distance_m", "-2", "..", "2", "m,", "slow", "bool,", "where", "string",
        "Drive", "straight", "ahead",
    ]  # fmt: skip
    assert main(["action", "list", folder, "--json"]) == 0
    actions = json.loads(capsys.readouterr().out)["actions"]
    assert [action["name"] for action in actions] == ["drive", "list"]


def test_nothing_and_what_is_wrong(
    tmp_path: Path, folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "actions" / "b.yaml").write_text("turn: {kind: shel, risk: state}\n")
    assert main(["action", folder]) == 2
    out, err = capsys.readouterr()
    assert "drive" in out
    assert "b.yaml:1: turn.kind: there is no kind of action 'shel'; did you mean 'shell'?" in err
    (tmp_path / "empty").mkdir()
    assert main(["action", str(tmp_path / "empty")]) == 0
    assert main(["action", str(tmp_path / "absent")]) == 2
    assert main(["action", "run", folder]) == 2
    assert main(["action", "list", folder, "drive"]) == 2


def test_check(tmp_path: Path, folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", folder]) == 0
    text = capsys.readouterr().out
    shown = " ".join(text.split())
    assert (
        "can do: drive moves Drive straight ahead (distance_m -2 .. 2 m, slow bool, where string)"
        in shown
    )
    assert main(["check", folder, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [action["name"] for action in report["actions"]] == ["drive", "list"]
    wrong = ACTIONS.replace("risk: moves", "risk: move").replace("{folder}", "{foldr}")
    (tmp_path / "actions" / "a.yaml").write_text(wrong)
    assert main(["check", folder]) == 2
    text = capsys.readouterr().out
    assert "a.yaml:18: drive.risk: expected one of record, state, moves, got text 'move'" in text
    assert "list.command: there is no parameter 'foldr'; did you mean 'folder'?" in text
    assert text.endswith("errors, 0 notes\n")


def test_run_and_fail(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["action", "run", folder, "list", "folder=actions", "--json"]) == 0
    outcome = json.loads(capsys.readouterr().out)
    assert (outcome["state"], outcome["result"]["output"]) == ("done", "a.yaml\n")
    assert main(["action", "run", folder, "list", "folder=nowhere"]) == 1
    assert "error: list: failed: ls ended with exit status 2: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["drve"], "this robot has no action 'drve'; did you mean 'drive'?"),
        (["drive"], "distance_m is missing"),
        (["drive", "distance_m=3"], "distance_m: 3 is above the largest value, 2 m"),
        (["drive", "distance_m=nan"], "the parameters are no JSON: NaN is no number"),
        (["drive", "distance_m=far"], "distance_m: 'far' is no number"),
        (["drive", "distance_m=1", "slow=maybe"], "slow: 'maybe' is neither true nor false"),
        (["drive", "distance_m=1", "distance_m=1"], "'distance_m' is given twice"),
        (["drive", "1"], "'1' is no parameter"),
        (["drive", "distance=1"], "there is no parameter 'distance'; did you mean 'distance_m'?"),
        (["drive", "distance_m=1"], "drive moves the robot"),
        (["list", "folder=actions", "--simulated"], "list has no simulated twin"),
    ],
)
def test_wrong_words(
    folder: str,
    robot: ZmqRobot,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    error: str,
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))  # no terminal: nobody can answer
    assert main(["action", "run", folder, *words]) == 2
    assert error in capsys.readouterr().err
    assert robot.hears == []


def test_the_twin_moves_nothing(
    folder: str, robot: ZmqRobot, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["action", "run", folder, "drive", "distance_m=-1.5", "--simulated"]) == 0
    assert capsys.readouterr().out == 'done: {"at": -1.5}\n'
    assert robot.hears == []


class Terminal(io.StringIO):
    """A keyboard."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("answer", ["y\n", "\n", "n\n", "", "yep\n"])
def test_asks_before_the_robot_moves(
    folder: str,
    robot: ZmqRobot,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    answer: str,
) -> None:
    robot.answers["state"] = b'{"moving": false}'
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    words = ["drive", "distance_m=1", "slow=yes", "where=a b"]
    status = main(["action", "run", folder, *words])
    question = "drive distance_m=1.0 slow=True where=a b moves the robot. Is its way free? [y/N] "
    assert capsys.readouterr().out.startswith(question)
    assert (status, len(robot.heard("linear"))) == ((0, 1) if answer == "y\n" else (2, 0))
    if answer == "y\n":
        told = {"do": "linear", "distance_m": 1, "slow": True, "where": "a b"}
        assert robot.hears[0][1] == told


def test_ctrl_c_stops_the_robot(folder: str, robot: ZmqRobot) -> None:
    words = command("action", "run", folder, "drive", "distance_m=1", "--yes")
    process = subprocess.Popen(words, stdout=subprocess.PIPE)
    robot.wait_until("state")
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out) == (130, b"aborted: Ctrl-C\n")
    assert len(robot.heard("stop")) == 1
    assert not robot.moving


def test_killed_by_hand_stops_the_robot(folder: str, robot: ZmqRobot) -> None:
    process = subprocess.Popen(command("action", "run", folder, "drive", "distance_m=1", "--yes"))
    robot.wait_until("state")
    process.kill()
    process.wait(PATIENCE_S)
    robot.wait_until("stop")
    assert not robot.moving
