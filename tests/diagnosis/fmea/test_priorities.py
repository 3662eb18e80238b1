"""Priority tables of the user: the first matching line counts, wrong lines are reported."""

from __future__ import annotations

from pathlib import Path

from amberbox.core.errors import Problem
from amberbox.diagnosis.fmea.criticality import load_priorities, priority
from amberbox.diagnosis.fmea.model import RiskRanks

TABLE = "S,O,D,priority\n9-10,4-10,,high\n9-10,1-3,5-10,medium\n7-8,6-10,,high\n,,,low\n"


def test_the_first_line_that_fits_counts(tmp_path: Path) -> None:
    problems: list[Problem] = []
    path = tmp_path / "table.csv"
    path.write_text(TABLE, encoding="utf-8")
    rules = load_priorities(path, problems)
    assert not problems
    given = [(9, 4, 1), (10, 3, 5), (10, 3, 4), (8, 5, 10), (7, 6, 1)]
    assert [priority(RiskRanks(*ranks), rules) for ranks in given] == [
        "high", "medium", "low", "low", "high",
    ]  # fmt: skip
    assert priority(RiskRanks(9, 4, None), rules) == ""
    assert priority(RiskRanks(9, 4, 1), rules[1:2]) == ""


def test_wrong_tables_are_told_with_their_line(tmp_path: Path) -> None:
    problems: list[Problem] = []
    path = tmp_path / "table.csv"
    path.write_text("S,O,D,priority\n9-11,1,1,x\n\n5-3,1,1,x\n1,1,1,\na,1,1,x\n", encoding="utf-8")
    assert load_priorities(path, problems) == []
    assert [(problem.line, problem.where) for problem in problems] == [
        (2, "S"), (4, "S"), (5, "priority"), (6, "S"),
    ]  # fmt: skip
    path.write_text("S;O;D\n", encoding="utf-8")
    assert load_priorities(path, problems) == []
    assert load_priorities(tmp_path / "none.csv", problems) == []
    assert [problem.where for problem in problems[4:]] == ["columns", "file"]
