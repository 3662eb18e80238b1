"""Gaps that are open while the clock drifts."""

from __future__ import annotations

from pathlib import Path

import amberbox
from amberbox.core.clock import NS
from tests.support.manual_recorder import COUNT, ManualBox, number


def test_a_gap_closes_although_the_clock_has_drifted_meanwhile(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    box.sink.link_up("/count", "robot")
    box.hear(COUNT, number(1))
    box.write()
    box.sink.link_down("/count", "robot", "cable pulled")
    lost_ns = box.clock.wall_ns()
    for _ in range(30):
        box.clock.step(1e-6)  # as no two readings of two clocks are taken at once
        box.write(1.0)
    box.sink.link_up("/count", "robot")
    found_ns = box.clock.wall_ns()
    box.write(20.0)
    box.close()
    gaps = [g for g in amberbox.open(box.store).gaps("ros_count") if g.reason == "cable pulled"]
    assert len(gaps) == 1
    assert abs(gaps[0].from_ns - lost_ns) < NS // 1000
    assert abs(gaps[0].to_ns - found_ns) < NS // 1000
