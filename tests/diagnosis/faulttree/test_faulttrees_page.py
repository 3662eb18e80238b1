"""The page of the documentation: its example runs and its results are right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.diagnosis.faulttree.tree import ARITY, FUNCTIONS

PAGE = Path(__file__).resolve().parents[3] / "docs" / "robot" / "faulttrees.md"


def test_the_examples_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "ropod_001"]) == 0
    drawn, compiled = re.findall(
        r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    )
    lines = _printed(drawn, capsys)
    assert lines[0].endswith("(0, 1, 3)") and lines[1] == "['power']"
    assert lines[-2:] == ["('left',) ('rear',) 0.2", "('left',) ('right',) 0.1"]
    effects = [line.split()[0] for line in _printed(compiled, capsys)[::2]]
    assert "see_people" in effects and "know_floor" in effects


def _printed(example: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    capsys.readouterr()
    exec(compile(example, str(PAGE), "exec"), {})
    return capsys.readouterr().out.splitlines()


def test_all_gates_and_expressions_are_named() -> None:
    text = PAGE.read_text(encoding="utf-8")
    words = set(re.findall(r"[\w-]+", " ".join(re.findall(r"`([^`\n]+)`", text))))
    assert {*ARITY, *FUNCTIONS} <= words
