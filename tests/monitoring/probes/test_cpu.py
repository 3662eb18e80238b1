"""Load of the processor, from two readings of the kernel's counters."""

from __future__ import annotations

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.cpu import judge, measure

BEFORE = """\
cpu  100 0 50 800 50 0 0 0 7 0
cpu0 50 0 25 400 25 0 0 0 7 0
cpu1 50 0 25 400 25 0 0 0 0 0
intr 5
"""
AFTER = """\
cpu  160 0 60 900 80 0 0 0 9 0
cpu0 100 0 25 440 35 0 0 0 9 0
cpu1 60 0 35 460 45 0 0 0 0 0
intr 9
"""
LOAD = "1.25 0.80 0.50 2/300 4711\n"


@pytest.mark.parametrize(("subject", "percent"), [("all", 35.0), ("cpu0", 50.0), ("cpu1", 20.0)])
def test_waiting_for_a_disk_is_not_busy(subject: str, percent: float) -> None:
    assert judge(subject, BEFORE, AFTER, LOAD) == {
        "ok": True,
        "percent": percent,
        "load_1m": 1.25,
        "cores": 2,
    }


def test_counters_that_stand_still_tell_nothing() -> None:
    assert judge("all", BEFORE, BEFORE, LOAD)["percent"] is None


def test_a_core_that_is_not_there_is_named() -> None:
    with pytest.raises(UsageError, match="no core 'cpu7'") as refused:
        judge("cpu7", BEFORE, AFTER, LOAD)
    assert refused.value.hint == "known: all, cpu0, cpu1"


def test_this_computer() -> None:
    found = measure("all")
    assert 0 <= found["percent"] <= 100
    assert found["cores"] >= 1
