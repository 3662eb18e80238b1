"""Load of the processor, from two readings of the kernel's counters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import psutil
import pytest

from amberbox.core.errors import UsageError
from amberbox.core.host import core_times
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
Times = Mapping[str, Sequence[float]]


@pytest.fixture
def readings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Times, Times]:
    """Return what is read of both texts."""
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(tmp_path))
    found = []
    for text in (BEFORE, AFTER):
        (tmp_path / "stat").write_text(text)
        found.append(core_times())
    return found[0], found[1]


@pytest.mark.parametrize(("subject", "percent"), [("all", 35.0), ("cpu0", 50.0), ("cpu1", 20.0)])
def test_waiting_for_a_disk_is_not_busy(
    readings: tuple[Times, Times], subject: str, percent: float
) -> None:
    found = judge(subject, *readings)
    assert found["percent"] == pytest.approx(percent)
    assert (found["ok"], found["cores"]) == (True, 2)


def test_counters_that_stand_still_tell_nothing(readings: tuple[Times, Times]) -> None:
    assert judge("all", readings[0], readings[0])["percent"] is None


def test_a_core_that_is_not_there_is_named(readings: tuple[Times, Times]) -> None:
    with pytest.raises(UsageError, match="no core 'cpu7'") as refused:
        judge("cpu7", *readings)
    assert refused.value.hint == "known: all, cpu0, cpu1"


def test_this_computer() -> None:
    found = measure("all")
    assert 0 <= found["percent"] <= 100
    assert found["cores"] >= 1
    assert found["load_1m"] >= 0
