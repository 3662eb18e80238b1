"""The page on rule tests: its examples run, its notation is valid, its error message is right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.core.errors import Problem
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.rule_tests import (
    LoadedRuleTests,
    read_rule_tests,
    read_series,
    run_rule_tests,
)
from tests.sim.monitored import plan_of
from tools.findings import ROOT
from tools.markdown import fences

PAGE = (ROOT / "docs" / "robot" / "rule-tests.md").read_text(encoding="utf-8")
OF_ROBOT, ON_BENCH = (fence.text for fence in fences(PAGE) if fence.info == "yaml")
FAILURE = next(fence.text for fence in fences(PAGE) if not fence.info).strip()


def _read(text: str, folder: Path) -> LoadedRuleTests:
    path = folder / "page.test.yaml"
    path.write_text(text)
    problems: list[Problem] = []
    rules = read_rule_tests(path, "components/laser_front.test.yaml", folder, problems)
    assert rules is not None, problems
    return rules


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> MonitoringPlan:
    return plan_of(tmp_path_factory.mktemp("robot") / "r")[0]


def test_the_example_of_a_robot_passes(plan: MonitoringPlan, tmp_path: Path) -> None:
    assert run_rule_tests(_read(OF_ROBOT, tmp_path), plan) == []


def test_a_failure_looks_as_shown(plan: MonitoringPlan, tmp_path: Path) -> None:
    harmless = OF_ROBOT.replace("0.154x20", "0.1x20").split("    transitions:")[0]
    told = [str(problem) for problem in run_rule_tests(_read(harmless, tmp_path), plan)]
    assert re.sub(r":\d+:", ":8:", told[0]) == FAILURE


def test_the_example_on_the_bench_passes(tmp_path: Path) -> None:
    assert run_rule_tests(_read(ON_BENCH, tmp_path), MonitoringPlan("", "")) == []


def test_the_notation_of_the_page_can_be_read() -> None:
    table = PAGE.split("## Series")[1].split("## What")[0]
    cells = re.findall(r"^\| (`.+?) \|", table, re.M)
    series = [text.strip('"') for cell in cells for text in re.findall(r"`([^`]+)`", cell)]
    assert len(series) >= 14
    assert all(read_series(text) for text in series)
