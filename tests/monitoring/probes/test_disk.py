"""Use of disks: this computer's, and simulated ones."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.host import FileSystemMount, mount_of, usage_of_disk
from amberbox.core.probe import Measured
from amberbox.monitoring.probes import disk
from amberbox.monitoring.probes.disk import measure

DATA = FileSystemMount(Path("/data"), read_only=False)
MOUNTINFO = """\
22 1 8:2 / / rw,relatime shared:1 - ext4 /dev/sda2 rw,errors=remount-ro
23 22 8:3 / /data rw,noatime shared:2 - ext4 /dev/sda3 ro,errors=remount-ro
24 22 8:2 /home /home ro,relatime shared:1 - ext4 /dev/sda2 rw,errors=remount-ro
25 22 0:40 / /media/my\\040disk rw - vfat /dev/sdb1 rw
26 22 0:41 / /data2 rw - tmpfs tmpfs rw
27 22 0:42 / /data2 rw - tmpfs tmpfs ro
"""


def judge(found: os.statvfs_result, mount: FileSystemMount) -> Measured:
    return disk.judge(usage_of_disk(found, mount))


def answer(blocks: int, free: int, available: int, files: int = 0) -> os.statvfs_result:
    values = (4096, 4096, blocks, free, available, files, files // 4, files // 4, 0, 255)
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
    assert judge(answer(blocks=100, free=40, available=20, files=1000), DATA) == {
        "ok": True,
        "used_percent": 75.0,
        "free_bytes": 20 * 4096,
        "inodes_percent": 75.0,
        "read_only": False,
        "mount": "/data",
    }


def test_a_full_disk_and_one_that_went_read_only_are_not_ok() -> None:
    assert judge(answer(100, 5, 0), DATA)["ok"] is False
    assert judge(answer(100, 50, 50), DATA._replace(read_only=True))["ok"] is False


@pytest.mark.parametrize(
    ("path", "point", "read_only"),
    [
        ("/", "/", False),
        ("/var/log", "/", False),
        ("/data", "/data", True),
        ("/data/run/7", "/data", True),
        ("/database", "/", False),
        ("/home/robot", "/home", False),
        ("/media/my disk/x", "/media/my disk", False),
        ("/data2/x", "/data2", True),
    ],
)
def test_the_file_system_says_whether_it_is_read_only(
    path: str, point: str, read_only: bool
) -> None:
    assert mount_of(Path(path), MOUNTINFO) == (Path(point), read_only)


def test_what_is_no_disk_is_unknown(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match="no disk behind it"):
        measure("/proc")
    with pytest.raises(AmberboxError, match="nothing is mounted"):
        mount_of(Path("/data"), "")
    with pytest.raises(FileNotFoundError):
        measure(str(tmp_path / "data"))
    with pytest.raises(UsageError, match="no absolute path"):
        measure("data")
