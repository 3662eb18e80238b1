"""Every mode has rule tests beside it, and passes them."""

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


MODES = find("amberbox.monitoring.modes", defines=("Config", "evaluate"))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.test.yaml")), ids=lambda path: path.stem)
def test_modes_pass_their_rules(path: Path) -> None:
    problems: list[Problem] = []
    rules = read_rules(path, path.name, FOLDER, problems)
    assert rules is not None, problems
    assert run_rules(rules, NOBODY) == []


def test_every_mode_has_rules() -> None:
    tested = set()
    for path in FOLDER.glob("*.test.yaml"):
        rules = read_rules(path, path.name, FOLDER, [])
        assert rules is not None and rules.mode is not None
        tested.add((rules.mode.mapping or {})["monitor"].text)
    assert tested == set(MODES)
