"""Runs over a server from a terminal: steps, signatures, codes, Ctrl-C; lists, reports, tests."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

import amberbox.sim
from amberbox.cli.main import main
from amberbox.client import credentials, signing_key
from amberbox.client.transport import ConflictError
from amberbox.core.interrupt import Interrupt
from tests.support.commanded import ROBOT, Commanded, commanded, simulated_robot
from tests.support.commands import ANNA
from tests.support.experiments import DRIVE, DRIVE_FILES, DRIVE_YAML
from tests.support.processes import command, wait_for
from tests.support.terminal import AtTerminal

ACTIONS = Path(amberbox.sim.__file__).parent / "folder" / "actions" / "sim.yaml"
TESTS = """\
def test_fine():
    print("seen")


def test_wrong():
    assert 1 == 2, "not the same"
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commanded]:
    folder = tmp_path_factory.mktemp("world")
    with simulated_robot(folder) as endpoint:
        actions = ACTIONS.read_text().replace("tcp://127.0.0.1:5557", endpoint)
        files = {**DRIVE_FILES, "tests/test_it.py": TESTS}
        with commanded(folder, endpoint, actions, files=files) as found:
            with found.fleet() as fleet:
                wait_for(lambda: fleet.experiments(ROBOT), "the robot's experiments")
                wait_for(lambda: fleet.tests(ROBOT), "the robot's unit tests")
            yield found


@pytest.fixture(autouse=True)
def at_home(world: Commanded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anna's computer, with her key."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv(credentials.VARIABLE, world.tokens["anna"])
    monkeypatch.setattr("amberbox.core.ed25519.new_private_key", lambda: ANNA.private)
    signing_key.make_key("anna")


def newest(world: Commanded) -> str:
    with world.fleet() as fleet:
        return fleet.runs(ROBOT)[0].id


def test_one_person_carries_out_a_drive(
    world: Commanded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    words = ("distance_m=0.3", "--sign", "--report", str(page))
    person = AtTerminal("experiment", "run", world.where, "drive", *words)
    person.wait("Nobody stands before the robot")
    person.wait("1 pass")
    person.type("/deviation it squeaks\n1\n")
    person.wait("the robot will move (drive_linear: distance_m 0.3")
    person.wait("1 yes")
    person.type("1\n")
    person.wait("code")
    person.wait("a text")
    person.type(f"{world.code()}\n")
    person.wait("What is to be seen?")
    person.wait("Enter: none")
    person.type("\n")
    person.wait("verdict: passed")
    assert person.end() == 0
    assert "it squeaks" in page.read_text()
    run = newest(world)
    assert main(["experiment", "show", world.where, run, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "passed"
    assert [event["text"] for event in report["events"] if event["kind"] == "deviation"] == [
        "it squeaks"
    ]
    out = tmp_path / "report.xml"
    assert main(["experiment", "report", world.where, run, "-o", str(out)]) == 0
    assert ElementTree.parse(out).getroot().get("failures") == "0"
    assert main(["experiment", "report", world.where, run, "-o", str(tmp_path / "x.pdf")]) == 2
    capsys.readouterr()
    assert main(["experiment", "runs", world.where]) == 0
    assert run in capsys.readouterr().out


def test_ctrl_c_aborts_the_run(world: Commanded) -> None:
    person = AtTerminal("experiment", "run", world.where, "drive", "--sign", "--yes")
    person.wait("1 pass")
    person.type("1\n")
    person.wait("signed: drive_linear")
    person.wait("a text")
    person.type("\x03")
    person.wait("verdict: aborted")
    assert person.end() == Interrupt.STATUS
    with world.fleet() as fleet:
        line = fleet.run(ROBOT, newest(world)).run
    assert (line.state, line.reason) == ("aborted", "aborted by anna: Ctrl-C")


def test_runs_are_repeated_and_compared(
    world: Commanded, capsys: pytest.CaptureFixture[str]
) -> None:
    person = AtTerminal("experiment", "run", world.where, "drive", "--repeat", "2")
    for _ in range(2):  # not clear: it ends at once, as aborted, which ends a series
        person.wait("1 pass")
        person.type("/abort enough\n")
        break
    person.wait("1 more runs were wanted")
    assert person.end() == 1
    with world.fleet() as fleet:
        ids = [line.id for line in fleet.runs(ROBOT, name="drive")][:2]
    assert main(["experiment", "compare", world.where, *ids, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"] == sorted(ids, key=ids[::-1].index)
    assert main(["experiment", "compare", world.where, "drive", "--since", "9.9"]) == 2
    assert "no run has version '9.9'" in capsys.readouterr().err


def test_steps_of_others_are_left_to_them(world: Commanded) -> None:
    words = ("--sign", "--yes", "--as", "technician")
    person = AtTerminal("experiment", "run", world.where, "drive", *words)
    person.wait("waits for a operator")
    run = newest(world)
    with world.fleet("olga") as olga:
        task = olga.run(ROBOT, run).people[0].task
        olga.complete_step(ROBOT, run, task, {"path_clear": False})
    person.wait("done by olga")
    person.wait("verdict: aborted")
    assert person.end() == 1


def test_experiments_are_uploaded_and_withdrawn(
    world: Commanded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.bpmn").write_text(DRIVE)
    pictured = DRIVE_YAML.replace("clear:\n", "clear:\n    picture: way.png\n")
    (tmp_path / "other.yaml").write_text(pictured)
    (tmp_path / "way.png").write_bytes(bytes(3 << 20))
    assert main(["experiment", "upload", world.url, str(tmp_path / "other.bpmn")]) == 0
    assert "other.bpmn, other.yaml, way.png" in capsys.readouterr().out
    with world.fleet() as fleet:
        assert len(fleet.picture(ROBOT, "way.png", "other")) == 3 << 20
    assert main(["experiment", "list", world.where, "--json"]) == 0
    listed = {line["name"]: line for line in json.loads(capsys.readouterr().out)}
    assert {name: line["who"] for name, line in listed.items()} == {"drive": "", "other": "anna"}
    assert main(["experiment", "withdraw", world.url, "other"]) == 0
    capsys.readouterr()
    assert main(["experiment", "list", world.url]) == 0
    assert "no experiments" in capsys.readouterr().out
    (tmp_path / "other.yaml").write_text("experiment: {title: 3}\n")
    assert main(["experiment", "upload", world.url, str(tmp_path / "other.bpmn")]) == 2
    assert "other.yaml" in capsys.readouterr().err


def test_a_run_at_the_robot_is_listed_on_the_server(world: Commanded) -> None:
    person = AtTerminal("experiment", "run", str(world.folder), "drive", "--yes")
    person.wait("1 pass")
    person.type("1\n")
    person.wait("Enter: none")
    person.type("/note all is well\n\n")
    person.wait("verdict: passed")
    assert person.end() == 0
    with world.fleet() as fleet:
        line = wait_for(
            lambda: next((r for r in fleet.runs(ROBOT) if r.at_robot and r.is_over), None),
            "the robot's run",
        )
        assert (line.state, line.title) == ("passed", "Drive a little")
        detail = fleet.run(ROBOT, line.id)
        assert [event.text for event in detail.events if event.kind == "note"] == ["all is well"]
        assert json.loads(fleet.run_report(ROBOT, line.id))["verdict"] == "passed"
        assert "is-done" in fleet.diagram(ROBOT, run=line.id)
        with pytest.raises(ConflictError, match="the run is passed"):
            fleet.note_run(ROBOT, line.id, "later")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "{url}", "drvie"), "no experiment 'drvie'; did you mean 'drive'?"),
        (("run", "{url}", "drive", "distance_m=9"), "above the largest value"),
        (("run", "{url}", "drive", "--simulated"), "--simulated"),
        (("run", "{url}", "drive", "--yes"), "--yes and --key go with --sign"),
        (("check", "{url}"), "takes files"),
        (("show", "{url}", "r-0123456789abcdef"), "no such run"),
        (("run", "folder", "drive", "--queue"), "--queue goes with the address of a server"),
        (("upload", "folder", "x.bpmn"), "goes with the address of a server"),
    ],
)
def test_wrong_usage_is_explained(
    world: Commanded, words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiment", *(word.format(url=world.where) for word in words)]) == 2
    assert message in capsys.readouterr().err


def test_unit_tests_run_on_the_robot(
    world: Commanded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "results.xml"
    assert main(["test", world.where, "--list"]) == 0
    assert "it.fine" in capsys.readouterr().out
    words = ("--sign", "--yes", "--junit", str(junit), "--json")
    ended = subprocess.run(
        command("test", world.where, *words), capture_output=True, stdin=subprocess.DEVNULL,
        check=False,
    )  # fmt: skip
    assert ended.returncode == 1, ended.stderr
    results = json.loads(ended.stdout)["results"]
    assert {one["name"]: one["outcome"] for one in results} == {
        "it.fine": "passed", "it.wrong": "failed",
    }  # fmt: skip
    assert "not the same" in junit.read_text()
    person = AtTerminal("test", world.where, "it.fine", "--sign")
    person.wait("the robot will act (test.it.fine)")
    person.wait("1 yes")
    person.type("1\n")
    person.wait("1 passed")
    assert person.end() == 0
    assert main(["test", world.where, "it.fien"]) == 2
    assert "did you mean 'it.fine'" in capsys.readouterr().err
