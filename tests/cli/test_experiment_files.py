"""``amberbox experiment check|list|draw|import``; ``check`` and ``new`` of a robot folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main
from tests.experiments.bpmn_files import line


@pytest.fixture
def robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """Return the folder of a simulated robot with its sample experiments."""
    folder = tmp_path / "robot"
    assert main(["new", str(folder)]) == 0
    capsys.readouterr()
    return folder


def test_check_judges_all_files_of_a_robot(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "check", str(robot)]) == 0
    assert "wheel_check.bpmn: fine" in capsys.readouterr().out
    assert main(["check", str(robot)]) == 0
    assert "experiments:\n  cart_transport" in capsys.readouterr().out
    about = robot / "experiments" / "localisation_check.bpmn"
    about.write_text(about.read_text().replace("#shift", "#shfit"))
    assert main(["check", str(robot)]) == 2
    assert "no failure mode 'localisation#shfit'; did you mean" in capsys.readouterr().out
    about.unlink()
    path = robot / "experiments" / "mine.bpmn"
    path.write_text(line("<scriptTask id='n' name='Run it'/>"))
    assert main(["experiment", "check", str(path)]) == 2
    out = capsys.readouterr().out
    assert ":8: n: the script task 'Run it' is not run: a file that is read runs no code" in out
    assert "1 error, 0 notes, 1 of its elements are not run" in out
    assert main(["check", str(robot)]) == 2
    assert "mine.bpmn:8: n: the script task" in capsys.readouterr().out
    assert main(["experiment", "check", str(path), "--json"]) == 2
    (one,) = json.loads(capsys.readouterr().out)["experiments"]
    assert one["not_run"][0]["id"] == "n"
    assert one["problems"][0]["error"] is True


def test_actions_are_those_of_the_folder_or_another(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other.bpmn"
    path.write_text(line("<serviceTask id='n'/>"))
    path.with_suffix(".yaml").write_text("steps: {n: {action: dokc}}")
    assert main(["experiment", "check", str(path)]) == 0
    assert main(["experiment", "check", str(path), "--folder", str(robot)]) == 2
    assert "no action 'dokc'; did you mean 'dock'?" in capsys.readouterr().out


def test_list(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "list", str(robot)]) == 0
    assert "localisation_check  Localisation check  technician, operator" in (
        capsys.readouterr().out
    )
    assert main(["experiment", "list", str(robot), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["experiments"]
    assert [one["name"] for one in found] == [
        "cart_transport", "localisation_check", "make_safe", "pivot_check", "wheel_check",
    ]  # fmt: skip


def test_draw(robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = robot / "experiments" / "wheel_check.bpmn", tmp_path / "out.svg"
    words = ["experiment", "draw", str(path)]
    assert main([*words, "-o", str(out), "--state", "current=drive,done=confirm_path"]) == 0
    assert 'serviceTask is-current" data-bpmn-id="drive"' in out.read_text()
    assert main([*words, "--list"]) == 0
    assert "  1. operator: Confirm that the path is clear." in capsys.readouterr().out
    assert main([*words, "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"][0]["id"] == "confirm_path"
    for more, what in (
        ([], "needs -o"),
        (["-o", str(out), "--state", "curent=drive"], "did you mean 'current'?"),
        (["-o", str(out), "--state", "current=drvie"], "did you mean 'drive'?"),
    ):
        assert main([*words, *more]) == 2
        assert what in capsys.readouterr().err
    assert main(["experiment", "draw", str(robot / "experiments" / "gone.bpmn"), "--list"]) == 2
    assert "there is no file" in capsys.readouterr().err


def test_import_writes_what_can_be_read_and_overwrites_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        'sm_id = "a"\nstates = ["GO"]\noutcomes = ["DONE"]\n[state_descriptions.GO]\n'
        'state_module_name = "x.goto"\ninitial_state = true\n'
        '[state_descriptions.GO.transitions]\ndone = "DONE"\n'
    )
    for place in ("one", "two"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "go.toml").write_text(text)
    (tmp_path / "two" / "lost.toml").write_text(text.replace('done = "DONE"', 'done = "DUNE"'))
    out = tmp_path / "out"
    words = ["experiment", "import", str(tmp_path / "one"), str(tmp_path / "two"), "-o", str(out)]
    assert main(words) == 2
    told = capsys.readouterr().out
    assert "goes to 'DUNE'" in told
    assert "2 experiments written" in told
    assert [path.name for path in sorted(out.iterdir())] == ["one_go.bpmn", "two_go.bpmn"]
    assert main(["experiment", "check", str(out)]) == 0
    assert main(words) == 2
    assert "is there already" in capsys.readouterr().err
