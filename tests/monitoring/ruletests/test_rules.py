"""Right rule tests pass; wrong ones report position, time, and the actual result."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.core.errors import Problem
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.rule_tests import find_rule_tests, read_rule_tests, run_rule_tests

FIXTURES = Path(__file__).parent / "fixtures"
NOBODY = MonitoringPlan("", "")


def _problems(path: Path) -> list[Problem]:
    problems: list[Problem] = []
    rules = read_rule_tests(path, path.name, path.parent, problems)
    return problems if rules is None else run_rule_tests(rules, NOBODY)


@pytest.mark.parametrize("path", sorted(FIXTURES.glob("*.good.yaml")), ids=lambda path: path.name)
def test_good_rules_pass(path: Path) -> None:
    assert _problems(path) == []


@pytest.mark.parametrize("path", sorted(FIXTURES.glob("*.bad.yaml")), ids=lambda path: path.name)
def test_bad_rules_say_where_and_what(path: Path) -> None:
    expected = re.findall(r"^# problem (\d+): (.+)$", path.read_text(), re.M)
    found = _problems(path)
    told = [f"{problem.where}: {problem.what}" for problem in found]
    assert [problem.line for problem in found] == [int(line) for line, _ in expected], told
    for text, (_, start) in zip(told, expected, strict=True):
        assert text.startswith(start)
    assert all(problem.is_error for problem in found)


def test_what_came_instead_is_told() -> None:
    told = "\n".join(problem.what for problem in _problems(FIXTURES / "differs.bad.yaml"))
    why = "cool is false, expected true: t is 90, at most 80"
    assert f"(at 5 s came tested/cooler: nominal -> cool: {why})" in told
    assert "(at 5 s came alarm of tested (urgent) open: cool is false" in told


def test_files_are_found_below_a_folder_but_not_in_the_record(tmp_path: Path) -> None:
    (tmp_path / "components" / "deep").mkdir(parents=True)
    (tmp_path / "store").mkdir()
    good = (FIXTURES / "cooler.good.yaml").read_text()
    (tmp_path / "components" / "deep" / "cooler.test.yaml").write_text(good)
    (tmp_path / "components" / "broken.test.yaml").write_text("tests: [")
    (tmp_path / "store" / "copy.test.yaml").write_text(good)
    found = find_rule_tests(tmp_path, skip=tmp_path / "store")
    assert [Path(rules.node.file).name for rules in found.rules] == ["cooler.test.yaml"]
    assert [Path(problem.file).name for problem in found.problems] == ["broken.test.yaml"]
