"""A diagnosis asks for a unit test and an experiment; the verdict of the test re-ranks it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.consult.run_answers import store_run_answers
from tests.cli.diagnosed import FMEA, Bench, write_folder
from tests.cli.test_diagnose import found, leading

EXPERIMENT = """\
<?xml version="1.0" encoding="UTF-8"?>
<definitions xmlns="http://www.omg.org/spec/BPMN/20100524/MODEL" id="d"
  xmlns:amberbox="urn:amberbox:experiment:1" targetNamespace="urn:test">
<process id="p" isExecutable="true"><extensionElements><amberbox:experiment>
duration: 180 s
</amberbox:experiment></extensionElements>
<startEvent id="a"/><sequenceFlow id="f" sourceRef="a" targetRef="b"/>
<serviceTask id="b"><extensionElements><amberbox:step>
action: spin
</amberbox:step></extensionElements></serviceTask>
<sequenceFlow id="g" sourceRef="b" targetRef="c"/><endEvent id="c"/>
</process></definitions>
"""
ACTION = "spin: {kind: shell, command: ['true'], risk: moves, safe_stop: ['true']}\n"
UNIT_TEST = """\
import pytest


@pytest.mark.parametrize("end", ["drive", "other"])
def test_sounds_smooth(end):
    assert end == "other", "it is rough"


@pytest.mark.risk("moves")
def test_sounds_smooth_at_night():
    assert False
"""


def folder_with_runs(place: Path) -> Path:
    folder = write_folder(place)
    text = FMEA.replace(
        "sound: {check: Listen to the motor.,", "sound: {unit_test: motor.sounds_smooth-drive,"
    )
    text = text.replace(
        "ohms: {check: Measure the winding., minutes: 10, outcomes",
        "ohms: {experiment: winding, text: it spins, role: technician, outcomes",
    )
    assert text.count("unit_test") == text.count("experiment") == 1
    (folder / "fmea.yaml").write_text(text)
    for name, content in {
        "tests/test_motor.py": UNIT_TEST,
        "experiments/winding.bpmn": EXPERIMENT,
        "actions/spin.yaml": ACTION,
    }.items():
        (folder / name).parent.mkdir()
        (folder / name).write_text(content)
    return folder


def waiting(folder: Path) -> list[str]:
    """Return the requests that wait for the watcher."""
    place = open_store(load_folder(folder).store_path).path / "requests"
    return [path.name for path in place.glob("*.json")]


def test_the_verdict_of_a_unit_test_re_ranks_the_diagnosis(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(folder_with_runs(tmp_path / "robot"))
    folder = str(bench.folder)
    run = ["test", folder, "-k", "motor.sounds_smooth-drive"]
    with bench.watched():
        bench.run(4)
        assert main(run) == 1
        assert waiting(bench.folder) == [], "no diagnosis asks"
        bench.run(3, temperature=90, speed=0)
        capsys.readouterr()
        before = found(capsys, bench.folder)
        runs = {test["id"]: (test["kind"], test["run"], test["moves"], test["cost_s"])
                for test in before["next_tests"]}  # fmt: skip
        assert runs == {
            "motor.sound": ("unit_test", "motor.sounds_smooth-drive", False, 60.0),
            "motor.ohms": ("experiment", "winding", True, 180.0),
        }
        assert main(["diagnose", folder]) == 1
        text = " ".join(capsys.readouterr().out.split())
        assert "un the unit test motor.sounds_smooth-drive (1 min)" in text
        assert f"To run it: amberbox test {folder} -k motor.sounds_smooth-drive" in text
        assert main([*run, "--no-answer"]) == 1 and waiting(bench.folder) == []
        capsys.readouterr()
        assert main(run) == 1
        output = capsys.readouterr()
        assert "motor.sound = rough" in output.err and "1 failed" in output.out
        bench.run(2, temperature=90, speed=0)
        after = found(capsys, bench.folder)
    bench.box.close()
    share = {tuple(h["faults"]): h["probability"] for h in before["hypotheses"]}
    now = {tuple(h["faults"]): h["probability"] for h in after["hypotheses"]}
    assert leading(after) == ["motor#worn"] and now[("motor#worn",)] > share[("motor#worn",)]
    assert "motor.sound" not in [test["id"] for test in after["next_tests"]]


def test_the_verdict_of_an_experiment_is_stored_for_the_watcher(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(folder_with_runs(tmp_path / "robot"))
    robot = load_folder(bench.folder)
    assert store_run_answers(robot, "experiment", {"winding": "failed"}, "anna") == ()
    with bench.watched():
        bench.run(4)
        bench.run(3, temperature=90, speed=0)
        assert leading(found(capsys, bench.folder)) == ["motor#worn"]
        assert store_run_answers(robot, "experiment", {"winding": "aborted"}, "anna") == []
        given = store_run_answers(robot, "experiment", {"winding": "failed"}, "anna")
        assert [(one.test, one.answer, one.who) for one in given] == [("motor.ohms", "low", "anna")]
        bench.run(2, temperature=90, speed=0)
        assert leading(found(capsys, bench.folder)) == ["motor#short"]
        assert main(["diagnose", str(bench.folder)]) == 1
    bench.box.close()


def test_check_names_runs_that_are_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = folder_with_runs(tmp_path / "robot")
    fmea = folder / "fmea.yaml"
    good = fmea.read_text()
    assert main(["fmea", "check", str(folder)]) == 0
    fmea.write_text(good.replace("experiment: winding", "experiment: windings"))
    assert main(["fmea", "check", str(folder)]) == 2
    assert "there is no experiment 'windings'; did you mean 'winding'?" in capsys.readouterr().out
    fmea.write_text(good.replace("smooth-drive", "smooth-drives"))
    assert main(["check", str(folder), "--json"]) == 2
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert any("finds no unit test 'motor.sounds_smooth-drives'" in p["what"] for p in problems)
