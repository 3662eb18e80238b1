"""Whether the robot is in its dock, by its recorded variables."""

from __future__ import annotations

from pathlib import Path

from amberbox.blackbox.store.live_condition import LiveCondition
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import COUNT, ManualBox, number


def wait_for(dock: LiveCondition, docked: bool) -> None:
    wait_until(lambda: dock.value is docked, f"docked={docked} {dock.problem}")


def test_the_last_value_counts(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", [TopicOptions("/count")])
    box.hear(COUNT, number(0))
    box.write()
    dock = LiveCondition(tmp_path / "store", "ros_count.data > 5")
    assert dock.value is None
    dock.start()
    wait_for(dock, docked=False)
    box.hear(COUNT, number(9))
    box.write()
    wait_for(dock, docked=True)
    box.hear(COUNT, number(1))
    box.write()
    wait_for(dock, docked=False)
    dock.close()
    box.close()


def test_nobody_knows_without_an_expression(tmp_path: Path) -> None:
    dock = LiveCondition(tmp_path, "")
    dock.start()
    assert dock.value is None
