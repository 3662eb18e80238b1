"""Which file system a folder lies on, and the disk below it, as /proc and /sys tell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from amberbox.blackbox.doctor.host import Host

MOUNTS = "/proc/self/mountinfo"


@dataclass(frozen=True, slots=True)
class Mount:
    """A mounted file system; ``device`` is ``major:minor``."""

    point: str
    device: str
    kind: str
    source: str
    options: frozenset[str]


def mount_of(path: Path, table: str) -> Mount | None:
    """Find the mount that a path lies on in the text of mountinfo; later ones cover earlier."""
    best: Mount | None = None
    for mount in _mounts(table):
        holds = PurePosixPath(path).is_relative_to(mount.point)
        if holds and (best is None or len(mount.point) >= len(best.point)):
            best = mount
    return best


def _mounts(table: str) -> Iterator[Mount]:
    for line in table.splitlines():
        before, separator, after = line.partition(" - ")
        own, rest = before.split(), after.split()
        if separator and len(own) >= 6 and len(rest) >= 2:
            options = {*own[5].split(","), *(rest[2].split(",") if len(rest) > 2 else ())}
            yield Mount(_unescaped(own[4]), own[2], rest[0], _unescaped(rest[1]),
                        frozenset(options))  # fmt: skip


def _unescaped(text: str) -> str:
    """Undo the kernel's octal escapes of space, tab, newline and backslash."""
    for code, character in (("040", " "), ("011", "\t"), ("012", "\n"), ("134", "\\")):
        text = text.replace(f"\\{code}", character)
    return text


def disk_of(mount: Mount, host: Host) -> Path | None:
    """Return the /sys folder of the disk below a mount; None where there is none of its own."""
    found = host.path(f"/sys/dev/block/{mount.device}")
    if not found.exists():  # btrfs and others have made-up numbers
        found = host.path(f"/sys/class/block/{PurePosixPath(mount.source).name}")
    if not found.exists():
        return None
    disk = found.resolve()
    while below := sorted(disk.glob("slaves/*")):  # encrypted disks, logical volumes
        disk = below[0].resolve()
    return disk.parent if (disk / "partition").exists() else disk
