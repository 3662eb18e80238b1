"""Every mode has rule tests beside it, and passes them."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import Problem
from amberbox.core.plugins import find
from amberbox.monitoring import modes
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.rule_tests import read_rule_tests, run_rule_tests

FOLDER = Path(modes.__path__[0]) / "rules"
NOBODY = MonitoringPlan("", "")


MODES = find("amberbox.monitoring.modes", defines=("Config", "evaluate"))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.test.yaml")), ids=lambda path: path.stem)
def test_modes_pass_their_rules(path: Path) -> None:
    problems: list[Problem] = []
    rules = read_rule_tests(path, path.name, FOLDER, problems)
    assert rules is not None, problems
    assert run_rule_tests(rules, NOBODY) == []


def test_every_mode_has_rules() -> None:
    tested = set()
    for path in FOLDER.glob("*.test.yaml"):
        rules = read_rule_tests(path, path.name, FOLDER, [])
        assert rules is not None and rules.mode is not None
        tested.add((rules.mode.mapping or {})["monitor"].text)
    assert tested == set(MODES)
