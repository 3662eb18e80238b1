"""How full a disk is, and whether it can still be written."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

from amberbox.core.errors import AmberboxError, UsageError
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

_ESCAPED = re.compile(r"\\([0-7]{3})")


class _MountPoint(NamedTuple):
    """Where a file system is mounted, and whether it is read-only itself.

    A service may see a disk through a mount that is read-only for it alone, which does not count.
    """

    point: Path
    read_only: bool


def measure(subject: str) -> Measured:
    """Measure the disk of a path; it is ok when it can still be written to."""
    path = Path(subject)
    if not path.is_absolute():
        raise UsageError(f"'{subject}' is no absolute path", "begin it with /")
    found = os.statvfs(path)
    mounts = Path("/proc/self/mountinfo").read_text(errors="replace")
    return judge(found, mount_of(path.resolve(), mounts))


def judge(found: os.statvfs_result, mount: _MountPoint) -> Measured:
    """Return the measurement from the statistics of a file system."""
    if not found.f_blocks:
        raise AmberboxError("there is no disk behind it")
    used = found.f_blocks - found.f_bfree
    return {
        "ok": not mount.read_only and found.f_bavail > 0,
        "used_percent": _percent(used, used + found.f_bavail),
        "free_bytes": found.f_bavail * found.f_frsize,
        "inodes_percent": _percent(found.f_files - found.f_ffree, found.f_files),
        "read_only": mount.read_only,
        "mount": str(mount.point),
    }


def mount_of(path: Path, mountinfo: str) -> _MountPoint:
    """Find the mount of a path in ``/proc/self/mountinfo``; of several equal ones the last."""
    mounts = [_mount(line) for line in mountinfo.splitlines()]
    above = [mount for mount in mounts if path.is_relative_to(mount.point)]
    if not above:
        raise AmberboxError(f"nothing is mounted at {path}")
    return max(reversed(above), key=lambda mount: len(mount.point.parts))


def _mount(line: str) -> _MountPoint:
    fields, _, of_file_system = line.partition(" - ")
    point = _ESCAPED.sub(lambda code: chr(int(code[1], 8)), fields.split()[4])
    return _MountPoint(Path(point), "ro" in of_file_system.split()[-1].split(","))


def _percent(part: int, whole: int) -> float | None:
    return 100 * part / whole if whole else None
