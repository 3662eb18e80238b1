"""``docs/robot/modes.md`` has a section for each mode, and files that work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.core.options import describe
from amberbox.core.plugins import find
from amberbox.testing.modes import mode_file

PAGE = Path(__file__).parents[3] / "docs" / "robot" / "modes.md"
MODES = find("amberbox.monitoring.modes", defines=("Config", "evaluate"))


def section(name: str) -> str:
    """Return the section of a mode; fail if there is none."""
    found = re.search(rf"^## {name}\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.M | re.S)
    assert found, f"{PAGE.name} has no section '## {name}'"
    return found[1]


def test_the_page_has_no_section_of_a_mode_that_is_not_there() -> None:
    assert set(re.findall(r"^## (\w+)$", PAGE.read_text(), re.M)) <= set(MODES)


@pytest.mark.parametrize("name", MODES)
def test_section(name: str) -> None:
    module, text = MODES[name].load(), section(name)
    keys = [row.key.rpartition(".")[2] for row in describe(module.Config)]
    for word in (*keys, *(result.name for result in module.RESULTS)):
        assert re.search(rf"`[^`]*\b{word}\b[^`]*`", text), f"`{word}` is not described"
    examples = re.findall(r"```yaml\n(.*?)```", text, re.S)
    assert examples, "there is no example"
    for example in examples:
        assert mode_file(module, name, example).config is not None
