"""How fast the disk wears: what the box writes per day, what the disk says of itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.doctor.finding import Finding, in_time, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.mount import MOUNTS, disk_of, mount_of
from amberbox.blackbox.doctor.subject import Subject
from amberbox.blackbox.doctor.traffic import DAY_S, Traffic
from amberbox.core.units import in_bytes

ENDURANCE = {"SD card": 300, "eMMC": 1000, "disk": 600}
"""How often a whole device can be written: careful guesses, for nobody prints it on a card."""
_SYNC_BYTES = 16_384
"""What a sync costs beside its data: a page or two of file system journal."""
_SECTOR = 512
_ENOUGH_YEARS = 3.0
_WORN_PERCENT = 80


@dataclass(frozen=True, slots=True)
class Disk:
    """What /sys says about a disk; None where it does not."""

    name: str
    kind: str
    size_bytes: int
    written_bytes: int
    flushes: int | None
    life_percent: int | None
    spare: int | None


def wear(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say what recording costs the disk below the store."""
    mount = mount_of(subject.ground, host.text(MOUNTS))
    folder = disk_of(mount, host) if mount else None
    disk = read_disk(folder) if folder else None
    yield judged_traffic(subject.traffic, subject.options.sync_s, disk)
    if disk is not None:
        yield judged_disk(disk, uptime_s(host))


def uptime_s(host: Host) -> float:
    """Return how long the system has been up."""
    words = host.text("/proc/uptime").split()
    return float(words[0]) if words else 0.0


def read_disk(folder: Path) -> Disk:
    """Read the counters that the kernel keeps since the start, and the device's own."""
    stat = _numbers(folder / "stat")
    size = _numbers(folder / "size")
    life = _numbers(folder / "device" / "life_time")
    spare = _numbers(folder / "device" / "pre_eol_info")
    return Disk(
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
        told = (folder / "device" / "type").read_text().strip()
    except OSError:
        told = ""
    return {"SD": "SD card", "MMC": "eMMC"}.get(told, "disk")


def _numbers(path: Path) -> list[int]:
    """Read whole numbers such as ``0x01 0x02`` or ``42 7``; none if they are not there."""
    try:
        return [int(word, 16 if word.startswith("0x") else 10) for word in path.read_text().split()]
    except (OSError, ValueError):
        return []


def judged_traffic(traffic: Traffic | None, sync_s: float, disk: Disk | None) -> Finding:
    """Judge a day of recording against what such a device stands."""
    if traffic is None:
        return ok("wear", "nothing measured yet: it needs some seconds of recording")
    syncs = traffic.syncs(sync_s)
    found = f"a day of recording writes {in_bytes(traffic.journal_bytes)} of journals and "
    found += f"{in_bytes(traffic.segment_bytes)} of segments and syncs {syncs:,.0f} times"
    if disk is None or not disk.size_bytes:
        return ok("wear", found)
    daily = traffic.kept_bytes + syncs * _SYNC_BYTES
    years = disk.size_bytes * ENDURANCE[disk.kind] / daily / 365
    found += f"; {disk.name}, {disk.kind} of {in_bytes(disk.size_bytes)}, stands that for about "
    found += f"{in_time(years * 365 * DAY_S)} (if written whole {ENDURANCE[disk.kind]} times)"
    if years < _ENOUGH_YEARS:
        hint = "raise store.sync_s, record less (max_frequency, change, keep: ring), or take "
        return warn("wear", found, f"{hint}a larger or an industrial device")
    return ok("wear", found)


def judged_disk(disk: Disk, up_s: float) -> Finding:
    """Judge what everybody together has written since the start, and the device's own word."""
    check = f"disk {disk.name}"
    flushes = f", {disk.flushes:,} flushes" if disk.flushes is not None else ""
    found = f"{in_bytes(disk.written_bytes)} written{flushes} in {in_time(up_s)} since the start"
    if disk.life_percent is None and disk.spare is None:
        hint = "smartctl or nvme tell the age of an SSD; SD cards do not tell theirs"
        return ok(check, found, hint)
    if disk.life_percent is not None:
        found += f"; {min(disk.life_percent, 100)} % of its life used, as it says itself"
    if (disk.spare or 0) > 1 or (disk.life_percent or 0) >= _WORN_PERCENT:
        return warn(check, found, "it wears out: replace it, and keep a copy of the record now")
    return ok(check, found)
