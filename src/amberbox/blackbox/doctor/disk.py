"""Where the record goes: room, file system, how it is mounted, and the root beside it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from amberbox.blackbox.doctor.finding import Finding, error, in_time, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.mount import MOUNTS, Mount, mount_of
from amberbox.blackbox.doctor.subject import Subject
from amberbox.blackbox.doctor.traffic import DAY_S, Traffic
from amberbox.blackbox.folder.robot import StoreOptions
from amberbox.core.units import in_bytes

_NEWEST_S = DAY_S
"""What shall never be deleted unseen: the newest day."""
_FORGETFUL = {"tmpfs": "memory", "ramfs": "memory", "overlay": "an overlay"}
_TEARABLE = ("vfat", "msdos", "exfat", "ntfs", "ntfs3", "fuseblk", "ext2")
_REMOTE = ("nfs", "nfs4", "cifs", "smb3", "9p", "fuse.sshfs", "ceph", "glusterfs")


def space(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say how much room is left and how long it lasts."""
    disk = shutil.disk_usage(subject.ground)
    yield judged_space(
        disk.total, disk.free, _used(subject.store_path), subject.options, subject.traffic
    )


def judged_space(
    total: int, free: int, used: int, options: StoreOptions, traffic: Traffic | None
) -> Finding:
    """Judge free bytes of the partition and the store's own use against its limits."""
    limit = min(options.quota or total, total * options.quota_percent / 100)
    room = max(0.0, min(limit - used, free - options.min_free))
    found = f"{in_bytes(free)} of {in_bytes(total)} free, the record takes {in_bytes(used)}"
    found += f" and may take {in_bytes(used + room)}"
    rate = traffic.kept_bytes if traffic else 0.0
    if rate:
        lasts = in_time(room / rate * DAY_S)
        found += f"; {in_bytes(rate)} per day of recording: the oldest goes in {lasts}"
    if free < min(options.min_free, 2 * options.rotate_bytes):
        hint = "make room, or record elsewhere (robot.yaml store.path)"
        return error("free space", found, hint)
    if free < options.min_free:
        hint = f"less than store.min_free ({in_bytes(options.min_free)}) is left: make room"
        return warn("free space", found, hint)
    if rate and (used + room) / rate * DAY_S < _NEWEST_S:
        hint = "less than a day fits: raise store.quota, or record less (max_frequency, keep: ring)"
        return warn("free space", found, hint)
    return ok("free space", found)


def _used(store: Path) -> int:
    return sum(_size(Path(place) / name) for place, _, names in os.walk(store) for name in names)


def _size(path: Path) -> int:
    try:
        return path.lstat().st_blocks * 512
    except OSError:  # deleted meanwhile, or not ours to see
        return 0


def file_system(subject: Subject, host: Host) -> Iterator[Finding]:
    """Judge the file system that the store lies on."""
    mount = mount_of(subject.ground, host.text(MOUNTS))
    if mount is None:
        yield warn("file system", "this system does not tell its mounts", "look at it yourself")
    else:
        yield judged_file_system(mount)


def judged_file_system(mount: Mount) -> Finding:
    """Judge whether a power cut or a lost network takes the record along."""
    found = f"{mount.kind} on {mount.source} at {mount.point}"
    check = "file system"
    if "ro" in mount.options:
        return error(check, f"{found} cannot be written", "mount it writable, or move store.path")
    for kinds, what, hint in (
        (tuple(_FORGETFUL), "forgets everything at power-off", "move store.path to a real disk"),
        (_TEARABLE, "has no journal: a power cut may damage it whole", "use ext4, f2fs or btrfs"),
        (_REMOTE, "is elsewhere: without the network there is no record", "use a local disk"),
    ):
        if mount.kind in kinds:
            return warn(check, f"{found} {what}", hint)
    return _judged_options(check, found, mount.options)


def _judged_options(check: str, found: str, options: frozenset[str]) -> Finding:
    if options & {"nobarrier", "barrier=0"}:
        hint = "mount it with barriers: without, sync_s promises nothing in a power cut"
        return warn(check, f"{found}, without barriers", hint)
    if "data=writeback" in options:
        hint = "data=ordered: with writeback, old bytes may appear in files after a power cut"
        return warn(check, f"{found}, data=writeback", hint)
    if options & {"sync", "dirsync"}:
        hint = "mount it without sync: the box syncs itself, each write twice wears the disk"
        return warn(check, f"{found}, sync", hint)
    if not options & {"noatime", "relatime", "nodiratime"}:
        return warn(check, f"{found}, writes at each read", "mount it with noatime")
    return ok(check, found)


def root(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say whether a power cut can keep the computer itself from starting."""
    table = host.text(MOUNTS)
    mount = mount_of(Path("/"), table)
    if mount is None:
        return
    own = mount_of(subject.ground, table)
    yield judged_root(mount, own is not None and own.point != "/")


def judged_root(mount: Mount, has_own_partition: bool) -> Finding:
    """Judge the root file system; ``has_own_partition`` is about the store."""
    if mount.kind == "overlay" or "ro" in mount.options:
        return ok("root file system", f"{mount.kind}, not written: a power cut cannot damage it")
    hint = "a box bolted to a robot lives longer with a read-only root (docs/appliance.md)"
    if not has_own_partition:
        hint += " and the store on a partition of its own"
    return ok("root file system", f"{mount.kind}, written by the system", hint)
