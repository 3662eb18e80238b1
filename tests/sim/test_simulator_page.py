"""docs/start/simulator.md matches the simulator: its tables are those of the code."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.sim.faults import catalogue
from amberbox.sim.tables import disturbance_table, fault_table, topic_tables
from amberbox.sim.topics import TOPICS

PAGE = Path(__file__).parents[2] / "docs" / "start" / "simulator.md"


def test_every_fault_and_topic_stands_in_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [fault_id for fault_id in catalogue() if f"`{fault_id}`" not in text] == []
    assert [spec.name for spec in TOPICS if f"### {spec.name}\n" not in text] == []


@pytest.mark.parametrize("table", [fault_table, topic_tables, disturbance_table])
def test_the_tables_are_those_of_the_code(table: object) -> None:
    assert callable(table)
    assert table() in PAGE.read_text(encoding="utf-8"), "python -m amberbox.sim.tables"


def test_the_pages_example_entry_stands_in_the_catalogue() -> None:
    entry = PAGE.read_text(encoding="utf-8").split("```yaml\n")[-1]
    source = Path(__file__).parents[2] / "src" / "amberbox" / "sim" / "faults.yaml"
    assert entry.splitlines()[0] in source.read_text(encoding="utf-8")
