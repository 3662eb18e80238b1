"""``amberbox test``: unit tests of a folder are listed and run; ``check`` lists them too."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from amberbox.cli.main import main
from tests.support.unit_tests import write_tests

TESTS = '''
def test_good(measure):
    """It is well."""
    measure("length", 2.5, "m")
@pytest.mark.tests("laser#silent")
def test_bad():
    print("said this")
    assert 1 == 2, "too short"
'''
MOVES = '@pytest.mark.risk("moves")\ndef test_moves(): pass\n'


def test_results_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tests(tmp_path, a=TESTS)
    xml = tmp_path / "results.xml"
    assert main(["test", str(folder), "--junit", str(xml)]) == 1
    out = capsys.readouterr().out
    first, second, *more = out.splitlines()
    assert first.split()[:2] == ["passed", "a.good"] and first.endswith("length 2.5 m")
    assert second.split()[:2] == ["failed", "a.bad"] and second.endswith("too short")
    assert "    said this" in more and more[-1] == "1 passed, 1 failed"
    suite = ElementTree.parse(xml).getroot()[0]
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert suite[1].findtext("system-out") == "said this\n"
    assert main(["test", str(folder), "-k", "good"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["1 passed"]


def test_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tests(tmp_path, a=TESTS, wrong="import nowhere")
    assert main(["test", str(folder), "--json", "-k", "good"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [result["outcome"] for result in found["results"]] == ["passed"]
    assert found["problems"][0]["file"] == "tests/test_wrong.py"
    assert main(["test", str(folder), "--list", "--json"]) == 2
    listed = json.loads(capsys.readouterr().out)["tests"]
    assert listed[1] == {
        "name": "a.bad", "description": "", "risk": "state", "timeout_s": 30.0,
        "about": ["laser#silent"],
    }  # fmt: skip


def test_list(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["test", str(write_tests(tmp_path, a=TESTS)), "--list"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[1] == ["a.good", "record", "30", "s", "It", "is", "well."]


@pytest.mark.parametrize(
    ("files", "words", "what"),
    [
        ({}, (), "there are no tests in"),
        ({"a": TESTS}, ("-k", "nowhere"), "no test is chosen"),
        ({"a": TESTS}, ("-k", "and and"), "Wrong expression passed to '-k'"),
        ({"a": "import nowhere"}, (), "No module named 'nowhere'"),
        ({"a": MOVES}, (), "the robot would move: a.moves"),
    ],
)
def test_wrong_usage(
    files: dict[str, str], words: tuple[str, ...], what: str,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert main(["test", str(write_tests(tmp_path, **files)), *words]) == 2
    assert what in "".join(capsys.readouterr())


def test_no_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["test", "nowhere"]) == 2
    assert "there is no folder 'nowhere'" in capsys.readouterr().err


def test_what_moves_is_confirmed(tmp_path: Path) -> None:
    folder = write_tests(tmp_path, a=MOVES)
    assert main(["test", str(folder), "--yes"]) == 0
    assert main(["test", str(folder), "--simulated"]) == 0


def test_check_lists_tests_and_runs_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_tests(tmp_path, a="def test_a(): open('ran', 'w').close()")
    assert main(["check", str(folder)]) == 0
    assert "can test:\n  a.a  record" in capsys.readouterr().out
    write_tests(tmp_path, wrong="def f(:", about='@pytest.mark.tests("x#y")\ndef test_b(): pass')
    assert main(["check", str(folder), "--json"]) == 2
    report = json.loads(capsys.readouterr().out)
    assert [test["name"] for test in report["tests"]] == ["a.a", "about.b"]
    wrong = [p for p in report["problems"] if p["file"].endswith("test_wrong.py")]
    assert wrong[0]["is_error"] and "SyntaxError" in wrong[0]["what"]
    notes = [p["what"] for p in report["problems"] if not p["is_error"]]
    assert "there is no failure mode 'x#y'" in notes
    assert not (folder / "ran").exists()


def test_plain_pytest_has_the_fixtures_that_read(tmp_path: Path) -> None:
    folder = write_tests(tmp_path, a="def test_id(robot): assert robot.id\ndef test_act(act): pass")
    (folder / "robot.yaml").write_text("id: r1\n")
    words = ["-q", "-p", "amberbox.experiments.pytest_plugin", "-c", "/dev/null", "-rs"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words, "--rootdir", str(folder), str(folder / "tests")],
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},  # it may be installed
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "1 passed, 1 skipped" in done.stdout, done.stdout
    assert "amberbox test FOLDER" in done.stdout
