"""How full a disk is: this computer's, and what the system says of others."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.monitoring.probes.disk import judge, measure


def answer(
    blocks: int, free: int, available: int, files: int = 0, flag: int = 0
) -> os.statvfs_result:
    values = (4096, 4096, blocks, free, available, files, files // 4, files // 4, flag, 255)
    return os.statvfs_result(values)


def test_the_disk_of_a_folder(tmp_path: Path) -> None:
    found = measure(str(tmp_path))
    asked = os.statvfs(tmp_path)
    assert found["ok"] is True
    assert found["read_only"] is False
    assert abs(found["free_bytes"] - asked.f_bavail * asked.f_frsize) < 1 << 30
    assert 0 < found["used_percent"] < 100
    assert Path(found["mount"]).is_mount()
    assert tmp_path.is_relative_to(found["mount"])


def test_what_is_kept_for_root_counts_as_df_counts_it() -> None:
    found = judge(answer(blocks=100, free=40, available=20, files=1000))
    assert found["used_percent"] == 75.0
    assert found["free_bytes"] == 20 * 4096
    assert found["inodes_percent"] == 75.0


def test_a_full_disk_and_one_that_went_read_only_are_not_ok() -> None:
    assert judge(answer(100, 5, 0))["ok"] is False
    broken = judge(answer(100, 50, 50, flag=os.ST_RDONLY))
    assert (broken["ok"], broken["read_only"]) == (False, True)


def test_what_is_no_disk_is_unknown(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match="no disk behind it"):
        measure("/proc")
    with pytest.raises(FileNotFoundError):
        measure(str(tmp_path / "data"))
    with pytest.raises(UsageError, match="no absolute path"):
        measure("data")
