"""Runs of an experiment at the robot, as processes: a person types, actions are programs."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import pytest

from amberbox.blackbox.query import record
from amberbox.cli.main import main
from amberbox.testing.clock import PATIENCE_S
from tests.experiments.procedures import bpmn_of, catch, node, process
from tests.support.processes import command, wait_for

ACTIONS = """\
go:
  kind: python
  file: going.py
  function: go
  safe_stop: stop
  parameters: {far_m: {min: 0, max: 5}}
  risk: moves
"""
# It ends when the file "let-go" is there, and counts how often it was begun and stopped
GOING = """\
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]


def count(name):
    with (FOLDER / name).open("a") as file:
        file.write("x\\n")


def go(context):
    count("begun")
    context.report("going")
    while not (FOLDER / "let-go").exists():
        if context.wait(0.02):
            return None
    return {"moved_m": context.parameters["far_m"]}


def stop(context):
    count("stopped")
"""
DRIVE = process(
    node("start", "start", "clear"),
    node("clear", "person", "g"),
    node("g", "exclusive", ("go", "path_clear"), "not_begun"),
    node("not_begun", "end"),
    node("go", "robot", "end", boundaries=(catch("trouble", "", "recover"),)),
    node("recover", "person", "bad"),
    node("bad", "error_end", code="test_failed"),
    node("end", "end"),
)
BESIDE = """\
experiment:
  title: Drive <b>far</b>
  parameters: {far_m: {min: 0, max: 5, default: 1}}
  ends: {not_begun: aborted}
steps:
  clear: {fields: {path_clear: {kind: pass_fail, label: Clear?}}}
  go: {action: go, parameters: {far_m: "=far_m"}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "robot.yaml").write_text("id: r1\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {}\n")
    for name in ("actions", "experiments"):
        (tmp_path / name).mkdir()
    (tmp_path / "actions" / "a.yaml").write_text(ACTIONS)
    (tmp_path / "actions" / "going.py").write_text(GOING)
    (tmp_path / "experiments" / "drive.bpmn").write_text(bpmn_of(DRIVE))
    (tmp_path / "experiments" / "drive.yaml").write_text(BESIDE)
    return tmp_path


@contextmanager
def typed(folder: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``amberbox experiment`` with a pipe as its terminal; kill it behind the block."""
    process = subprocess.Popen(
        command("experiment", *words), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def say(process: subprocess.Popen[str], *lines: str) -> None:
    pipe: IO[str] | None = process.stdin
    assert pipe is not None
    pipe.write("".join(f"{line}\n" for line in lines))
    pipe.flush()


def count(folder: Path, name: str) -> int:
    path = folder / name
    return len(path.read_text().splitlines()) if path.exists() else 0


def shown(folder: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return the report of the newest run."""
    capsys.readouterr()
    assert main(["experiment", "runs", str(folder), "--json"]) == 0
    run = json.loads(capsys.readouterr().out)[-1]["run"]
    assert main(["experiment", "show", str(folder), run, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_a_run_is_carried_out_recorded_and_reported(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = folder / "page.html"
    (folder / "let-go").touch()
    with typed(folder, "run", str(folder), "drive", "far_m=2", "--report", str(page)) as process:
        say(process, "/deviation it <i>hums</i>", "1", "1")
        output = process.communicate(timeout=PATIENCE_S)[0]
    assert process.returncode == 0, output
    assert "verdict: passed" in output
    report = shown(folder, capsys)
    assert (report["verdict"], report["parameters"]) == ("passed", {"far_m": 2.0})
    assert [step["state"] for step in report["steps"]] == ["done", "done"]
    assert report["steps"][1]["parameters"] == {"far_m": 2.0}
    html = page.read_text()
    assert "it &lt;i&gt;hums&lt;/i&gt;" in html and "Drive &lt;b&gt;far&lt;/b&gt;" in html
    assert "<script" not in html and 'data-bpmn-id="go"' in html
    with record.open(folder / "store") as opened:
        rows = opened.query("amberbox_experiment", ["number", "kind", "values"])
        assert rows.values("kind") == [event["kind"] for event in report["events"]]
        assert rows.values("number") == list(range(1, len(rows) + 1))


def test_a_killed_run_goes_on_and_its_action_is_not_done_again(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with typed(folder, "run", str(folder), "drive", "--yes") as process:
        say(process, "1")
        wait_for(lambda: count(folder, "begun"), "the action has begun")
        process.kill()
        process.wait(PATIENCE_S)
    wait_for(lambda: count(folder, "stopped"), "the action is stopped")
    run = shown(folder, capsys)["run"]
    with typed(folder, "resume", str(folder), run) as process:
        say(process, "1")
        output = process.communicate(timeout=PATIENCE_S)[0]
    assert process.returncode == 1, output
    report = shown(folder, capsys)
    assert (report["run"], report["verdict"]) == (run, "failed")
    assert "outcome unknown" in output
    assert count(folder, "begun") == 1
    assert main(["experiment", "resume", str(folder), run]) == 2
    assert "is over" in capsys.readouterr().err


@pytest.mark.parametrize("way", ["typed", "Ctrl-C"])
def test_an_abort_stops_the_action(
    folder: Path, capsys: pytest.CaptureFixture[str], way: str
) -> None:
    with typed(folder, "run", str(folder), "drive", "--yes") as process:
        say(process, "1")
        wait_for(lambda: count(folder, "begun"), "the action has begun")
        if way == "typed":
            say(process, "/abort a person came in")
        else:
            process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=PATIENCE_S)[0]
    assert process.returncode == (1 if way == "typed" else 130), output
    assert count(folder, "stopped") >= 1
    assert shown(folder, capsys)["verdict"] == "aborted"


def test_nothing_moves_without_a_free_way_or_a_person(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with typed(folder, "run", str(folder), "drive") as process:
        say(process, "1", "2", "1")
        output = process.communicate(timeout=PATIENCE_S)[0]
    assert "the way is not free" in output
    assert shown(folder, capsys)["verdict"] == "failed"
    with typed(folder, "run", str(folder), "drive") as process:
        output = process.communicate(timeout=PATIENCE_S)[0]  # the end of its input
    assert shown(folder, capsys)["verdict"] == "aborted"
    assert count(folder, "begun") == 0


def test_runs_are_repeated_and_compared(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "let-go").touch()
    with typed(folder, "run", str(folder), "drive", "--yes", "--repeat", "2") as process:
        say(process, "1", "1")
        output = process.communicate(timeout=PATIENCE_S)[0]
    assert process.returncode == 0, output
    assert main(["experiment", "compare", str(folder), "drive", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["verdicts"].values()) == ["passed", "passed"]
    assert [one["n"] for one in found["measures"]] == [2]
    assert main(["experiment", "compare", str(folder), found["runs"][0]]) == 2
    assert "at least two runs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["drve"], "there is no experiment 'drve'; did you mean 'drive'?"),
        (["drive", "far_m=9"], "9 is above the largest value, 5"),
        (["drive", "far=1"], "there is no parameter 'far'; did you mean 'far_m'?"),
        (["drive", "--repeat", "0"], "--repeat must be from 1 to 1000"),
    ],
)
def test_wrong_words_begin_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], what: str
) -> None:
    assert main(["experiment", "run", str(folder), *words]) == 2
    assert what in capsys.readouterr().err
    assert not list(folder.glob("store/experiments/*"))


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        (">path_clear<", '>__import__("os").getpid() &gt; 0<', "drive.bpmn"),
        (">path_clear<", ">path_cleer<", "did you mean 'path_clear'?"),
        ("action: go", "action: fly", "the robot has no action 'fly'"),
    ],
)
def test_a_wrong_experiment_is_not_begun(
    folder: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, what: str
) -> None:
    for path in (folder / "experiments").iterdir():
        path.write_text(path.read_text().replace(old, new))
    assert main(["experiment", "run", str(folder), "drive"]) == 2
    assert what in capsys.readouterr().err
    assert not list(folder.glob("store/experiments/*")) and count(folder, "begun") == 0
