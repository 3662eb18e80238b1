"""``amberbox rules``: checking, asking, reasons, export."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main

RULES = """
motor(m1). motor(m2). hot(m1).
broken(X) :- motor(X), hot(X).
"""


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "robot.pl"
    path.write_text(RULES)
    return str(path)


def test_what_is_defined(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rules", file]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "broken/1: 0 facts, 1 rules", "hot/1: 1 facts, 0 rules", "motor/1: 2 facts, 0 rules",
    ]  # fmt: skip


def test_ask_and_why(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rules", file, "--ask", "broken(X)", "--why"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "X = m1"
    assert lines[1] == f"  broken(m1)   rule, {file}:3"
    assert main(["rules", file, "--ask", "broken(m2)"]) == 0
    assert capsys.readouterr().out == "no\n"


def test_why_not(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rules", file, "--ask", "broken(m2)", "--why-not"]) == 0
    assert "fails: hot(m2)   the one clause does not fit" in capsys.readouterr().out


def test_json(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rules", file, "--ask", "broken(X)", "--why", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["answers"] == [{"X": "m1"}]
    assert [fact["goal"] for fact in found["proof"][0][0]["because"]] == ["motor(m1)", "hot(m1)"]
    assert main(["rules", file, "--ask", "broken(m2)", "--why-not", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["answers"], found["failed"][0]["goal"]) == ([], "broken(m2)")


def test_export(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "for_swi.pl"
    assert main(["rules", file, "--export", str(target)]) == 0
    assert capsys.readouterr().out == ""
    assert "broken(X) :-\n    motor(X),\n    hot(X).\n" in target.read_text()


@pytest.mark.parametrize(
    ("text", "arguments", "status", "message"),
    [
        ("p(a b).", [], 2, "robot.pl:1: column 5: 'b' is not expected here"),
        ("p :- mottor(x).\nmotor(x).", [], 2, "did you mean 'motor'?"),
        ("p.", ["--why"], 2, "--why and --why-not explain an answer"),
        ("p.", ["--ask", "q"], 2, "there is no predicate q/0"),
        ("p.", ["--steps", "0"], 2, "must be above 0"),
        ("p :- p.", ["--ask", "p", "--steps", "5000"], 1, "stopped after 5,"),
        ("p(X) :- q(X, Y).\n:- dynamic q/2.", [], 0, "note: column 1: Y occurs only once"),
    ],
)
def test_what_is_wrong(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    arguments: list[str],
    status: int,
    message: str,
) -> None:
    path = tmp_path / "robot.pl"
    path.write_text(text)
    assert main(["rules", str(path), *arguments]) == status
    assert message in capsys.readouterr().err
