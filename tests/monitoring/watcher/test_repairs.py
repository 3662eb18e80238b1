"""Faults of the simulated robot that are repaired, in virtual time: alarms, titles, what stays."""

from __future__ import annotations

import pytest

from benchmarks.repairs import lives, row_of


@pytest.mark.timeout(600)
def test_two_faults_one_after_the_other_have_an_alarm_each_and_leave_when_repaired() -> None:
    """A battery that may catch fire, then a wheel unit without power; each is repaired."""
    faults = ["battery_overheats", "wheel_front_left_power_stage_trips"]
    hot, trips = lives(row_of(faults, lasts_s=15, after_s=80))
    for life in (hot, trips):
        assert life.titled and not life.unalarmed
        assert life.alarms == 1
        assert life.left_s is not None and life.left_s <= 150
