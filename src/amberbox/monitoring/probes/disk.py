"""How full a disk is, and whether it can still be written."""

from __future__ import annotations

from pathlib import Path

from amberbox.core.errors import UsageError
from amberbox.core.host import DiskUsage, disk_usage
from amberbox.core.probe import Measured

MEASURES = {
    "used_percent": ("float", "%", "of what users may fill, as df counts it"),
    "free_bytes": ("int", "bytes", "what users may still fill"),
    "inodes_percent": ("float", "%", "of the files that it can hold; null if it has no limit"),
    "read_only": ("bool", "", "whether the file system takes no writes, as after a disk fault"),
    "mount": ("string", "", "where what was measured is mounted"),
}
SUBJECT = "an absolute path on the disk, such as /data; see mount for what is measured"
PERIOD_S = 2.0


def measure(subject: str) -> Measured:
    """Measure the disk of a path; it is ok when it can still be written to."""
    path = Path(subject)
    if not path.is_absolute():
        raise UsageError(f"'{subject}' is no absolute path", "begin it with /")
    return judge(disk_usage(path))


def judge(found: DiskUsage) -> Measured:
    """Return the measurement from the use of a disk."""
    return {
        "ok": not found.read_only and found.free_bytes > 0,
        "used_percent": found.used_percent,
        "free_bytes": found.free_bytes,
        "inodes_percent": found.inodes_percent,
        "read_only": found.read_only,
        "mount": found.mount,
    }
