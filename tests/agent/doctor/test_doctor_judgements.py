"""Findings of the doctor: each check is given numbers and words, without a computer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.agent.doctor.checkup import OPTIONAL, judged_clock, judged_packages, judged_power
from amberbox.agent.doctor.disk import (
    BlockDevice,
    judged_disk,
    judged_file_system,
    judged_latency,
    judged_root,
    judged_space,
    judged_traffic,
)
from amberbox.agent.doctor.processes import (
    SystemdUnit,
    judged_recorder,
    judged_service,
    why_only_events,
)
from amberbox.agent.doctor.subject import DoctorFinding, MountPoint, Traffic, in_time, mount_of
from amberbox.blackbox.journal.tail import JournalHead
from amberbox.blackbox.robot_folder.robot_yaml import StoreOptions
from amberbox.blackbox.store.store import create_store
from amberbox.core.clock import NS
from amberbox.core.units import bytes_text

GB = 1_000_000_000
FOLDER = Path("/data/robot")
TABLE = """\
20 1 0:18 / /proc rw - proc proc rw
27 1 254:1 / / rw,relatime - ext4 /dev/mmcblk0p2 rw
30 27 254:2 / /data rw,noatime - ext4 /dev/sda1 rw,data=ordered
31 30 0:40 / /data/my\\040stick ro,relatime - vfat /dev/sdb1 ro
32 27 0:41 / /database rw - tmpfs tmpfs rw
"""


def assert_finding(finding: DoctorFinding, level: str, *words: str) -> None:
    assert finding.level == level, finding
    assert all(word in f"{finding.found} {finding.hint}" for word in words), finding
    assert finding.hint or level == "ok", "what is not well needs a next step"


@pytest.mark.parametrize(
    ("synchronised", "daemon", "level", "word"),
    [
        (True, "chrony", "ok", "chrony"),
        (True, "", "ok", "not known"),
        (False, "chrony", "warn", "not synchronised"),
        (None, "ntpd", "warn", "does not say"),
        (False, "", "warn", "install chrony"),
        (None, "", "warn", "install chrony"),
    ],
)
def test_clock(synchronised: bool | None, daemon: str, level: str, word: str) -> None:
    assert_finding(judged_clock(synchronised, daemon), level, word)


@pytest.mark.parametrize(
    ("path", "point"),
    [
        ("/", "/"),
        ("/var/lib", "/"),
        ("/data/robot/store", "/data"),
        ("/data/my stick/store", "/data/my stick"),
        ("/database/x", "/database"),
    ],
)
def test_the_mount_of_a_path(path: str, point: str) -> None:
    mount = mount_of(Path(path), TABLE)
    assert mount is not None and mount.point == point


def test_a_later_mount_covers_an_earlier_one() -> None:
    mount = mount_of(Path("/data/x"), f"{TABLE}40 30 0:50 / /data rw - xfs /dev/sdc rw\n")
    assert mount == MountPoint("/data", "0:50", "xfs", "/dev/sdc", frozenset({"rw"}))
    assert mount_of(Path("/data"), "nonsense\n\n1 2 - x\n") is None


EXT4 = MountPoint("/data", "254:2", "ext4", "/dev/sda1", frozenset({"rw", "noatime"}))


@pytest.mark.parametrize(
    ("kind", "options", "level", "word"),
    [
        ("ext4", "rw,noatime", "ok", "/dev/sda1"),
        ("ext4", "rw,relatime,data=ordered", "ok", "ext4"),
        ("ext4", "ro,noatime", "error", "cannot be written"),
        ("ext4", "rw", "warn", "noatime"),
        ("ext4", "rw,noatime,data=writeback", "warn", "ordered"),
        ("ext4", "rw,noatime,nobarrier", "warn", "barriers"),
        ("ext4", "rw,noatime,sync", "warn", "without sync"),
        ("tmpfs", "rw,relatime", "warn", "power-off"),
        ("overlay", "rw,relatime", "warn", "power-off"),
        ("vfat", "rw,noatime", "warn", "no journal"),
        ("nfs4", "rw,noatime", "warn", "network"),
    ],
)
def test_file_system(kind: str, options: str, level: str, word: str) -> None:
    mount = replace(EXT4, kind=kind, options=frozenset(options.split(",")))
    assert_finding(judged_file_system(mount), level, word)


def test_root_file_system() -> None:
    assert_finding(judged_root(replace(EXT4, kind="overlay"), True), "ok", "cannot damage")
    assert_finding(judged_root(replace(EXT4, options=frozenset({"ro"})), True), "ok", "cannot")
    own, shared = judged_root(EXT4, True), judged_root(EXT4, False)
    assert "partition of its own" not in own.hint and "read-only" in own.hint
    assert "partition of its own" in shared.hint


DAILY = Traffic(journal_bytes=1e9, segment_bytes=1e9, writers=1, seconds=3600)


@pytest.mark.parametrize(
    ("free_gb", "used_gb", "options", "traffic", "level", "words"),
    [
        (50, 10, StoreOptions(), DAILY, "ok", ["goes in 24 days", "may take 59.0 GB"]),
        (50, 10, StoreOptions(quota=20 * GB), DAILY, "ok", ["goes in 5 days", "20.0 GB"]),
        (90, 0, StoreOptions(), None, "ok", ["may take 80.0 GB"]),
        (50, 0, StoreOptions(quota=1 * GB), DAILY, "warn", ["less than a day fits"]),
        (0.5, 10, StoreOptions(), DAILY, "warn", ["min_free", "goes in 0 s"]),
        (0.1, 10, StoreOptions(), DAILY, "error", ["make room"]),
        (0.1, 10, StoreOptions(min_free=0), DAILY, "ok", ["goes in 72 min"]),
    ],
)
def test_space(
    free_gb: float, used_gb: float, options: StoreOptions, traffic: Traffic | None, level: str,
    words: Sequence[str],
) -> None:  # fmt: skip
    found = judged_space(100 * GB, int(free_gb * GB), int(used_gb * GB), options, traffic)
    assert_finding(found, level, *words)


CARD = BlockDevice("mmcblk0", "SD card", 32 * GB, 5 * GB, 8600, None, None)


def test_wear_by_the_boxs_own_traffic() -> None:
    assert_finding(judged_traffic(None, 1, CARD), "ok", "nothing measured")
    small = judged_traffic(DAILY, 1, CARD)
    assert_finding(small, "ok", "1.0 GB of journals", "syncs 86,400 times", "SD card of 32.0 GB")
    heavy = judged_traffic(replace(DAILY, journal_bytes=20e9), 1, CARD)
    assert_finding(heavy, "warn", "raise store.sync_s", "days")
    assert_finding(judged_traffic(replace(DAILY, journal_bytes=20e9), 1, None), "ok", "20.0 GB")


def test_more_syncs_wear_more() -> None:
    card, tiny = replace(CARD, size_bytes=4 * GB), replace(DAILY, journal_bytes=0, segment_bytes=0)
    assert judged_traffic(tiny, 0.1, card).level == "warn"
    assert judged_traffic(tiny, 10, card).level == "ok"


def test_wear_by_the_disks_own_word() -> None:
    assert_finding(
        judged_disk(CARD, 7300), "ok", "5.0 GB written, 8,600 flushes in 2 h", "SD cards"
    )
    emmc = replace(CARD, kind="eMMC", life_percent=20, spare=1)
    assert_finding(judged_disk(emmc, 60), "ok", "20 % of its life")
    assert_finding(judged_disk(replace(emmc, life_percent=90), 60), "warn", "replace it")
    assert_finding(judged_disk(replace(emmc, spare=2), 60), "warn", "replace it")
    assert_finding(judged_disk(replace(emmc, life_percent=110), 60), "warn", "100 %")


@pytest.mark.parametrize(
    ("writes", "syncs", "level"),
    [
        ([0.001, 0.02], [0.01, 0.3], "ok"),
        ([0.001, 0.2], [0.01, 0.3], "warn"),
        ([0.001, 0.02], [0.01, 0.02, 1.5], "warn"),
        ([0.001], [1.2, 1.2, 0.1], "error"),
    ],
)
def test_latency(writes: list[float], syncs: list[float], level: str) -> None:
    assert_finding(judged_latency(writes, syncs, 0.1, 1.0), level, " ms")


NOW_NS = 1_700_000_000 * NS
HEAD = JournalHead("id", 3, 500, 480, NOW_NS - NS // 5, "x.mcap", 1000)


@pytest.mark.parametrize(
    ("pid", "head", "level", "word"),
    [
        (7, HEAD, "ok", "20 records not yet synced"),
        (
            7,
            replace(HEAD, watermark_ns=NOW_NS - 9 * NS),
            "error",
            "process 7 hangs: last write 9 s",
        ),
        (7, replace(HEAD, watermark_ns=0), "error", "does not take data"),
        (7, None, "error", "hangs: no last write"),
        (
            None,
            replace(HEAD, watermark_ns=NOW_NS - 7200 * NS),
            "warn",
            "not running, last write 2 h",
        ),
        (None, None, "warn", "not running"),
    ],
)
def test_recorder(pid: int | None, head: JournalHead | None, level: str, word: str) -> None:
    assert_finding(judged_recorder(pid, head, NOW_NS, 2.0, FOLDER), level, word)


def test_a_store_that_takes_events_only_is_noticed(tmp_path: Path) -> None:
    store = create_store(tmp_path)
    assert why_only_events(store, 1_000) == ""
    (tmp_path / "reserve").touch()
    assert why_only_events(store, 0) == ""
    assert why_only_events(store, 1_000) == "disk full"
    (tmp_path / "full").write_text("nothing that is left may be deleted\n")
    assert why_only_events(store, 1_000) == "nothing that is left may be deleted"


UNIT = SystemdUnit("amberbox.service", True, "10")


@pytest.mark.parametrize(
    ("unit", "pid", "group", "level", "word"),
    [
        (UNIT, 7, "0::/system.slice/amberbox.service", "ok", "watchdog 10 s, active"),
        (UNIT, None, "", "warn", "systemctl status"),
        (UNIT, 7, "0::/user.slice/session-1.scope", "warn", "by hand"),
        (replace(UNIT, enabled=False), None, "", "warn", "systemctl enable --now"),
        (replace(UNIT, watchdog=""), None, "", "warn", "no watchdog"),
        (None, 7, "", "warn", "amberbox install-service /data/robot"),
    ],
)
def test_service(
    unit: SystemdUnit | None, pid: int | None, group: str, level: str, word: str
) -> None:
    assert_finding(judged_service(unit, pid, group, FOLDER), level, word)


def test_power() -> None:
    assert_finding(judged_power(["power"], []), "ok", "watched by power")
    assert_finding(judged_power([], ["AC", "BAT0"]), "warn", "the kernel knows AC, BAT0")
    assert_finding(judged_power([], []), "warn", "a supply of its own")


def test_packages() -> None:
    assert list(judged_packages(lambda name: "there")) == []
    (found,) = judged_packages(lambda name: None if name == "duckdb" else "there")
    assert_finding(found, "ok", "no SQL", "amberbox[query]")
    (found,) = judged_packages(lambda name: None)
    assert_finding(found, "warn", "not signed", "amberbox[keep,plot,query]", *OPTIONAL)


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (32_800, "32.8 kB"), (1.5e12, "1.5 TB"), (2e15, "2000.0 TB")],
)
def test_bytes_for_people(count: float, text: str) -> None:
    assert bytes_text(count) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(3, "3 s"), (600, "10 min"), (90_000, "25 h"), (864_000, "10 days"), (1e8, "3 years")],
)
def test_durations_for_people(seconds: float, text: str) -> None:
    assert in_time(seconds) == text
