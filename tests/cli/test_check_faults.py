"""``amberbox check`` reports the problems of failure modes and rules like their own verbs, once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.cli.main import main
from tests.cli.diagnosed import FMEA, write_folder


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Make a robot folder with failure modes."""
    return write_folder(tmp_path / "robot")


def problems(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, Any]]:
    """Return the errors that a verb finds."""
    capsys.readouterr()
    assert main([*arguments, "--json"]) == 2
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["problems"]
    return [problem for problem in found if problem["is_error"]]


def test_failure_modes_are_judged_once(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(made)]) == 0
    path = made / "fmea.yaml"
    path.write_text(FMEA.replace("[fan/speed/turns]", "[fan/speed/turn]"))
    found = problems(capsys, "check", str(made))
    assert found == problems(capsys, "fmea", "check", str(made))
    (wrong,) = found
    assert wrong["file"] == str(path) and "did you mean 'fan/speed/turns'?" in wrong["what"]


def test_rules_are_judged_by_line(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = made / "rules"
    rules.mkdir()
    (rules / "a.pl").write_text("weak(X) :- drives(X, Y), slow(Y).\ndrives(motor_1, wheel_1).\n")
    (rules / "b.pl").write_text("slow(wheel_1).\n")
    assert main(["check", str(made)]) == 0, "files of a folder are one program"
    (rules / "b.pl").write_text("slow(wheel_1.\n")
    (wrong,) = problems(capsys, "check", str(made))
    assert wrong["file"] == str(rules / "b.pl") and wrong["line"] == 1
    (rules / "b.pl").write_text("slwo(wheel_1).\n")
    (wrong,) = problems(capsys, "check", str(made))
    assert wrong["file"] == str(rules / "a.pl") and "slow/1" in wrong["what"]
