"""The examples of docs/reference/expressions.md run, and every function and operator is in it."""

from __future__ import annotations

import doctest
from pathlib import Path

from amberbox.core.expressions.parser import FUNCTIONS, KEYWORDS
from amberbox.core.units import TIME_NS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "expressions.md"


def test_examples_run() -> None:
    result = doctest.testfile(str(PAGE), module_relative=False)
    assert result.attempted >= 10
    assert result.failed == 0


def test_nothing_is_undocumented() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert all(f"`{name}(" in page for name in FUNCTIONS)
    assert all(word in page for word in KEYWORDS)
    assert " ".join(TIME_NS) in page
