"""Check the disk: room, file system and mount options, latency of durable writes, wear."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from amberbox.agent.doctor.subject import (
    DAY_S,
    MOUNTS,
    DoctorFinding,
    ExaminedRobot,
    HostSystem,
    MountPoint,
    Traffic,
    disk_of,
    error,
    in_time,
    mount_of,
    ok,
    warn,
)
from amberbox.blackbox.robot_folder.robot_yaml import StoreOptions
from amberbox.core.units import bytes_text

_NEWEST_S = DAY_S  # data of the newest day are not deleted without a warning
_FORGETFUL = {"tmpfs": "memory", "ramfs": "memory", "overlay": "an overlay"}
_TEARABLE = ("vfat", "msdos", "exfat", "ntfs", "ntfs3", "fuseblk", "ext2")
_REMOTE = ("nfs", "nfs4", "cifs", "smb3", "9p", "fuse.sshfs", "ceph", "glusterfs")


def space(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check the free space and how long it lasts."""
    disk = shutil.disk_usage(subject.ground)
    yield judged_space(
        disk.total, disk.free, _used(subject.store_path), subject.options, subject.traffic
    )


def judged_space(
    total: int, free: int, used: int, options: StoreOptions, traffic: Traffic | None
) -> DoctorFinding:
    """Check the free bytes of the partition and the size of the store against its limits."""
    limit = min(options.quota or total, total * options.quota_percent / 100)
    room = max(0.0, min(limit - used, free - options.min_free))
    found = f"{bytes_text(free)} of {bytes_text(total)} free, the record takes {bytes_text(used)}"
    found += f" and may take {bytes_text(used + room)}"
    rate = traffic.kept_bytes if traffic else 0.0
    if rate:
        lasts = in_time(room / rate * DAY_S)
        found += f"; {bytes_text(rate)} per day of recording: the oldest goes in {lasts}"
    if free < min(options.min_free, 2 * options.rotate_bytes):
        hint = "make room, or record elsewhere (robot.yaml store.path)"
        return error("free space", found, hint)
    if free < options.min_free:
        hint = f"less than store.min_free ({bytes_text(options.min_free)}) is left: make room"
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
    except OSError:  # deleted meanwhile, or not readable
        return 0


def file_system(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check the file system of the store."""
    mount = mount_of(subject.ground, host.text(MOUNTS))
    if mount is None:
        yield warn("file system", "this system does not tell its mounts", "look at it yourself")
    else:
        yield judged_file_system(mount)


def judged_file_system(mount: MountPoint) -> DoctorFinding:
    """Check whether the record survives a power cut or a lost network on this file system."""
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


def _judged_options(check: str, found: str, options: frozenset[str]) -> DoctorFinding:
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


def root(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check whether a power cut can prevent the computer from booting."""
    table = host.text(MOUNTS)
    mount = mount_of(Path("/"), table)
    if mount is None:
        return
    own = mount_of(subject.ground, table)
    yield judged_root(mount, own is not None and own.point != "/")


def judged_root(mount: MountPoint, has_own_partition: bool) -> DoctorFinding:
    """Check the root file system; ``has_own_partition`` states whether the store has its own."""
    if mount.kind == "overlay" or "ro" in mount.options:
        return ok("root file system", f"{mount.kind}, not written: a power cut cannot damage it")
    hint = "a box bolted to a robot lives longer with a read-only root (docs/robot/appliance.md)"
    if not has_own_partition:
        hint += " and the store on a partition of its own"
    return ok("root file system", f"{mount.kind}, written by the system", hint)


COUNT = 16
_BYTES = 65_536


def latency(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Measure the write latency in the store's folder; needs write permission there."""
    try:
        writes, syncs = probe(subject.ground)
    except OSError as trouble:
        hint = "run the doctor as the user who records"
        yield warn("disk latency", f"not measured: {trouble.strerror}", hint)
        return
    options = subject.options
    yield judged_latency(writes, syncs, options.write_s, options.sync_s)


def probe(place: Path) -> tuple[list[float], list[float]]:
    """Return the seconds of each write and each ``fdatasync``; the file is temporary."""
    block = os.urandom(_BYTES)  # incompressible
    writes, syncs = [], []
    with tempfile.TemporaryFile(dir=place, prefix=".doctor-") as file:
        for _ in range(COUNT):
            began = time.perf_counter()
            os.write(file.fileno(), block)
            written = time.perf_counter()
            os.fdatasync(file.fileno())
            writes.append(written - began)
            syncs.append(time.perf_counter() - written)
    return writes, syncs


def judged_latency(
    writes: Sequence[float], syncs: Sequence[float], write_s: float, sync_s: float
) -> DoctorFinding:
    """Check measured latencies (seconds) against the configured intervals."""
    found = f"write {_range(writes)}, sync {_range(syncs)} (64 kB)"
    if median(syncs) > sync_s:
        hint = (
            f"a sync takes longer than store.sync_s ({sync_s:g} s): raise it, or use a faster disk"
        )
        return error("disk latency", found, hint)
    if max(syncs) > sync_s or max(writes) > write_s:
        hint = f"at times slower than store.write_s ({write_s:g} s) or store.sync_s ({sync_s:g} s) "
        return warn("disk latency", found, f"{hint}promise; use a faster disk or raise them")
    return ok("disk latency", found)


def _range(seconds: Sequence[float]) -> str:
    return f"{1e3 * median(seconds):.1f} ms, at most {1e3 * max(seconds):.1f} ms"


# write cycles of a whole device: careful guesses, as vendors rarely state them
ENDURANCE = {"SD card": 300, "eMMC": 1000, "disk": 600}
_SYNC_BYTES = 16_384  # cost of a sync beside its data: a page or two of file system journal
_SECTOR = 512
_ENOUGH_YEARS = 3.0
_WORN_PERCENT = 80


@dataclass(frozen=True, slots=True)
class BlockDevice:
    """Data of /sys about a disk; None where unknown."""

    name: str
    kind: str
    size_bytes: int
    written_bytes: int
    flushes: int | None
    life_percent: int | None
    spare: int | None


def wear(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check how fast recording wears out the disk below the store."""
    mount = mount_of(subject.ground, host.text(MOUNTS))
    folder = disk_of(mount, host) if mount else None
    disk = read_disk(folder) if folder else None
    yield judged_traffic(subject.traffic, subject.options.sync_s, disk)
    if disk is not None:
        yield judged_disk(disk, uptime_s(host))


def uptime_s(host: HostSystem) -> float:
    """Return the uptime of the system in seconds."""
    words = host.text("/proc/uptime").split()
    return float(words[0]) if words else 0.0


def read_disk(folder: Path) -> BlockDevice:
    """Read the kernel's counters since boot, and the device's own."""
    stat = _numbers(folder / "stat")
    size = _numbers(folder / "size")
    life = _numbers(folder / "device" / "life_time")
    spare = _numbers(folder / "device" / "pre_eol_info")
    return BlockDevice(
        folder.name,
        _kind(folder),
        size[0] * _SECTOR if size else 0,
        stat[6] * _SECTOR if len(stat) > 6 else 0,
        stat[15] if len(stat) > 15 else None,
        10 * max(life, default=0) or None,
        max(spare, default=0) or None,
    )


def _kind(folder: Path) -> str:
    try:
        kind = (folder / "device" / "type").read_text().strip()
    except OSError:
        kind = ""
    return {"SD": "SD card", "MMC": "eMMC"}.get(kind, "disk")


def _numbers(path: Path) -> list[int]:
    """Return integers such as ``0x01 0x02`` or ``42 7`` from a file; empty if it cannot be read."""
    try:
        return [int(word, 16 if word.startswith("0x") else 10) for word in path.read_text().split()]
    except (OSError, ValueError):
        return []


def judged_traffic(
    traffic: Traffic | None, sync_s: float, disk: BlockDevice | None
) -> DoctorFinding:
    """Check a day of recording against the endurance of the device."""
    if traffic is None:
        return ok("wear", "nothing measured yet: it needs some seconds of recording")
    syncs = traffic.syncs(sync_s)
    found = f"a day of recording writes {bytes_text(traffic.journal_bytes)} of journals and "
    found += f"{bytes_text(traffic.segment_bytes)} of segments and syncs {syncs:,.0f} times"
    if disk is None or not disk.size_bytes:
        return ok("wear", found)
    daily = traffic.kept_bytes + syncs * _SYNC_BYTES
    years = disk.size_bytes * ENDURANCE[disk.kind] / daily / 365
    found += f"; {disk.name}, {disk.kind} of {bytes_text(disk.size_bytes)}, stands that for about "
    found += f"{in_time(years * 365 * DAY_S)} (if written whole {ENDURANCE[disk.kind]} times)"
    if years < _ENOUGH_YEARS:
        hint = "raise store.sync_s, record less (max_frequency, change, keep: ring), or take "
        return warn("wear", found, f"{hint}a larger or an industrial device")
    return ok("wear", found)


def judged_disk(disk: BlockDevice, up_s: float) -> DoctorFinding:
    """Check the bytes written since boot, and the wear that the device reports."""
    check = f"disk {disk.name}"
    flushes = f", {disk.flushes:,} flushes" if disk.flushes is not None else ""
    found = f"{bytes_text(disk.written_bytes)} written{flushes} in {in_time(up_s)} since the start"
    if disk.life_percent is None and disk.spare is None:
        hint = "smartctl or nvme tell the age of an SSD; SD cards do not tell theirs"
        return ok(check, found, hint)
    if disk.life_percent is not None:
        found += f"; {min(disk.life_percent, 100)} % of its life used, as it says itself"
    if (disk.spare or 0) > 1 or (disk.life_percent or 0) >= _WORN_PERCENT:
        return warn(check, found, "it wears out: replace it, and keep a copy of the record now")
    return ok(check, found)
