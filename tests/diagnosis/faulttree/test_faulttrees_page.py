"""The page of the documentation: its example runs and says what is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.diagnosis.faulttree.expression import FUNCTIONS
from amberbox.diagnosis.faulttree.formula import ARITY

PAGE = Path(__file__).resolve().parents[3] / "docs" / "faulttrees.md"


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(example, str(PAGE), "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("(0, 1, 3)") and lines[1] == "['power']"
    assert lines[-2:] == ["('left',) ('rear',) 0.2", "('left',) ('right',) 0.1"]


def test_all_gates_and_expressions_are_named() -> None:
    text = PAGE.read_text(encoding="utf-8")
    words = set(re.findall(r"[\w-]+", " ".join(re.findall(r"`([^`\n]+)`", text))))
    assert {*ARITY, *FUNCTIONS} <= words
