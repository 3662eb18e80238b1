"""Every mode has a rule test beside it, and passes it."""

from __future__ import annotations

from pathlib import Path

import pytest

import amberbox.monitoring.modes
from amberbox.core.errors import Problem
from amberbox.core.plugins import find
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.ruletests.files import read_rules
from amberbox.monitoring.ruletests.running import run_rules

FOLDER = Path(amberbox.monitoring.modes.__path__[0]) / "rules"
NOBODY = Plan("", "")


@pytest.mark.parametrize("mode", find("amberbox.monitoring.modes", defines=("Config", "evaluate")))
def test_each_mode_passes_its_rules(mode: str) -> None:
    problems: list[Problem] = []
    rules = read_rules(FOLDER / f"{mode}.test.yaml", f"{mode}.test.yaml", FOLDER, problems)
    assert rules is not None, problems
    assert rules.mode is not None and (rules.mode.mapping or {})["monitor"].text == mode
    assert run_rules(rules, NOBODY) == []
