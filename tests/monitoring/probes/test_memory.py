"""Memory of this computer, and of one with and without swap."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.monitoring.probes.memory import measure

MEMINFO = """\
MemTotal:        8000000 kB
MemFree:          500000 kB
MemAvailable:    2000000 kB
Buffers:          100000 kB
Cached:          1000000 kB
Shmem:             10000 kB
Active:          3000000 kB
Inactive:        2000000 kB
HugePages_Total:       0
SwapTotal:       1000000 kB
SwapFree:         900000 kB
"""


def proc(place: Path, monkeypatch: pytest.MonkeyPatch, meminfo: str) -> None:
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(place))
    (place / "meminfo").write_text(meminfo)
    (place / "vmstat").write_text("pswpin 0\npswpout 0\n")


def test_memory_that_can_be_had_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    proc(tmp_path, monkeypatch, MEMINFO)
    assert measure("ram") == {
        "ok": True,
        "used_percent": 75.0,
        "available_bytes": 2_048_000_000,
    }
    assert measure("swap")["used_percent"] == 10.0


def test_without_swap_it_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proc(tmp_path, monkeypatch, "SwapTotal: 0 kB\nSwapFree: 0 kB\n")
    with pytest.raises(AmberboxError, match="no swap"):
        measure("swap")


def test_this_computer() -> None:
    found = measure("ram")
    assert 0 < found["used_percent"] < 100
    assert found["available_bytes"] > 1 << 20


def test_other_memory_is_refused() -> None:
    with pytest.raises(UsageError, match="no memory 'gpu'"):
        measure("gpu")
