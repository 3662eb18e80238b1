"""docs/robot/components.md names every key, and its examples are those that run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.core.options import describe
from amberbox.monitoring.component_files import (
    LEGACY_KEYS,
    ComponentFileOptions,
    FlappingOptions,
    MappingOptions,
    ModeFileOptions,
    OutputOptions,
    RecoveryOptions,
)
from amberbox.monitoring.legacy_mode_files import LEGACY_MONITORS
from tests.monitoring.configuration.folders import errors, plan_of

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "robot" / "components.md").read_text(encoding="utf-8")
EXAMPLE = ROOT / "examples" / "laser" / "components"
CLASSES = (
    ComponentFileOptions,
    ModeFileOptions,
    MappingOptions,
    OutputOptions,
    FlappingOptions,
    RecoveryOptions,
)


@pytest.mark.parametrize("cls", CLASSES)
def test_every_key_is_documented(cls: type[object]) -> None:
    for row in describe(cls):
        for key in (row.key.rpartition(".")[2], *row.aliases):
            assert re.search(rf"`([\w\[\]]+\.)?{key}`", PAGE), f"{row.key}, {key}"


def test_the_listings_are_the_example() -> None:
    shown = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    files = [EXAMPLE / name for name in ("laser.yaml", "laser/device.yaml", "laser/heartbeat.yaml")]
    assert shown[:3] == [path.read_text(encoding="utf-8") for path in files]


def test_the_other_example_loads(tmp_path: Path) -> None:
    navigation = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[3]
    files = {
        "navigation.yaml": navigation,
        "localisation.yaml": "component_name: localisation\n",
        "planner.yaml": "component_name: planner\n",
        "ros.yaml": "component_name: ros\nmodes: [master.yaml]\n",
        "master.yaml": "name: ros_master_monitor\nmappings:\n"
        "    - {inputs: [], outputs: [{name: status, type: bool}]}\n",
    }
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == []
    edges = {edge.name: edge for edge in plan.components[1].dependencies}
    assert edges["roscore"].mode == "ros_master_monitor"
    assert not edges["planner"].judged


def test_the_predecessor_s_names_are_listed() -> None:
    for name, entry in LEGACY_MONITORS.items():
        line = next((text for text in PAGE.splitlines() if f"`{name}`" in text), "")
        assert f"`{entry.monitor}`" in line, name
    for key in LEGACY_KEYS:
        assert f"`{key.rpartition('.')[2]}`" in PAGE
