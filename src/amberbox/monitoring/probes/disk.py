"""How full a disk is, and whether it can still be written."""

from __future__ import annotations

import os
from pathlib import Path

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "used_percent": ("float", "%", "of what users may fill, as df counts it"),
    "free_bytes": ("int", "bytes", "what users may still fill"),
    "inodes_percent": ("float", "%", "of the files that it can hold; null if it has no limit"),
    "read_only": ("bool", "", "whether it is mounted read-only, as after a fault of the disk"),
    "mount": ("string", "", "where what was measured is mounted"),
}
SUBJECT = "an absolute path on the disk, such as /data; see mount for what is measured"
PERIOD_S = 10.0


def measure(subject: str) -> Measured:
    """Measure the disk of a path; it is ok when something can still be written."""
    path = Path(subject)
    if not path.is_absolute():
        raise UsageError(f"'{subject}' is no absolute path", "begin it with /")
    return judge(os.statvfs(path)) | {"mount": str(_mount(path.resolve()))}


def judge(found: os.statvfs_result) -> dict[str, object]:
    """Read what the system says of a file system."""
    if not found.f_blocks:
        raise AmberboxError("there is no disk behind it")
    used = found.f_blocks - found.f_bfree
    read_only = bool(found.f_flag & os.ST_RDONLY)
    return {
        "ok": not read_only and found.f_bavail > 0,
        "used_percent": _percent(used, used + found.f_bavail),
        "free_bytes": found.f_bavail * found.f_frsize,
        "inodes_percent": _percent(found.f_files - found.f_ffree, found.f_files),
        "read_only": read_only,
    }


def _percent(part: int, whole: int) -> float | None:
    return 100 * part / whole if whole else None


def _mount(path: Path) -> Path:
    return path if path.is_mount() or path == path.parent else _mount(path.parent)
