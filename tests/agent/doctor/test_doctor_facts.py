"""Sources of the doctor's facts: /proc, /sys, /etc and the store, on a simulated computer."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.agent.doctor import processes as checked
from amberbox.agent.doctor.checkup import CHECKS, checkup
from amberbox.agent.doctor.disk import probe, read_disk
from amberbox.agent.doctor.processes import find_unit, writer_pid
from amberbox.agent.doctor.subject import (
    DoctorFinding,
    HostSystem,
    disk_of,
    mount_of,
    subject,
    traffic,
)
from amberbox.agent.systemd_unit import service_of, unit_text
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import create_store, open_store
from amberbox.core.plugins import find
from amberbox.testing.clock import ManualClock
from amberbox.testing.contract import sample_config
from tests.support.manual_recorder import COUNT, ManualBox, number

SIM = "- sim:\n    seed: 1\n"
PLUGINS = find("amberbox.blackbox.sources", defines=("Config", "Source"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "robot"
    made.mkdir()
    (made / "robot.yaml").write_text("id: r\n")
    (made / "black_box.yaml").write_text(SIM)
    return made


@pytest.fixture
def host(tmp_path: Path) -> HostSystem:
    (tmp_path / "host").mkdir()
    return HostSystem(tmp_path / "host", ManualClock())


def write(host: HostSystem, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        host.path(name).parent.mkdir(parents=True, exist_ok=True)
        host.path(name).write_text(text)


def record(folder: Path, seconds: int = 20, clock: ManualClock | None = None) -> ManualBox:
    """Record a number each second; the run continues."""
    box = ManualBox(folder / "store", clock=clock or ManualClock())
    for value in range(seconds):
        box.hear(COUNT, number(value))
        box.write(1)
    return box


def one(folder: Path, check: str, host: HostSystem) -> DoctorFinding:
    (found,) = (finding for finding in checkup(folder, host) if finding.check == check)
    return found


# -- configuration and passivity


@pytest.mark.parametrize("name", PLUGINS)
def test_every_source_says_why_it_does_not_disturb(name: str) -> None:
    module = PLUGINS[name].load()
    config = sample_config(module, name)
    said = module.PASSIVE.format(config=config)
    assert len(said) > 20 and "{" not in said and "\n" not in said


def test_a_ros_source_names_its_node(folder: Path, host: HostSystem) -> None:
    block = "- ros: {topics: [{name: /odom}], caller_id: box7}\n"
    (folder / "black_box.yaml").write_text(block)
    finding = one(folder, "source ros", host)
    assert finding.level == "ok" and "as node /box7" in finding.found
    (folder / "black_box.yaml").write_text(block.replace("caller_id: box7", "invisible: true"))
    assert "not registered" in one(folder, "source ros", host).found


def test_a_configuration_with_errors_is_told_and_the_rest_goes_on(
    folder: Path, host: HostSystem
) -> None:
    (folder / "black_box.yaml").write_text("- sim: {sed: 1}\n- can't: {}\n")
    findings = checkup(folder, host)
    assert findings[0].level == "error" and "'sed'" in findings[0].found
    assert "and 1 more" in findings[0].found
    assert {"recorder", "clock", "free space", "keys"} <= {finding.check for finding in findings}
    (folder / "robot.yaml").write_text("id: [\n")
    assert one(folder, "configuration", host).level == "error"


def test_a_folder_that_names_nothing_built(folder: Path, host: HostSystem) -> None:
    (folder / "black_box.yaml").write_text("- opcua: {}\n")
    assert "source 'opcua' is not built yet" in one(folder, "configuration", host).found
    create_store(folder / "store").next_run()
    assert "no source that can be recorded" in one(folder, "configuration", host).found


def test_power_is_watched(folder: Path, host: HostSystem) -> None:
    write(host, {"/sys/class/power_supply/BAT0/type": "Battery"})
    assert "BAT0" in one(folder, "power", host).hint
    (folder / "black_box.yaml").write_text("- power:\n")
    assert one(folder, "power", host).level == "ok"


# -- clock


def test_who_sets_the_clock(folder: Path, host: HostSystem) -> None:
    write(host, {"/proc/1/comm": "systemd\n", "/proc/77/comm": "chronyd\n"})
    finding = one(folder, "clock", host)
    assert (finding.level, finding.found) == ("ok", "synchronised (chrony)")
    assert one(folder, "real-time clock", host).level == "warn"
    write(host, {"/sys/class/rtc/rtc0/name": "rtc-ds1307"})
    assert one(folder, "real-time clock", host).level == "ok"


# -- the disk below


def sd_card(host: HostSystem, folder: Path) -> None:
    disk = "/sys/devices/mmc/mmcblk0"
    write(
        host,
        {
            f"{disk}/stat": "1 0 8 0 5 0 4096 0 0 0 0 0 0 0 0 77 0\n",
            f"{disk}/size": "62333952\n",
            f"{disk}/device/type": "SD\n",
            f"{disk}/mmcblk0p2/partition": "2\n",
            "/proc/uptime": "3600.1 7000.0\n",
            "/proc/self/mountinfo": (
                "27 1 179:1 / / ro,noatime - squashfs /dev/mmcblk0p1 ro\n"
                f"28 27 179:2 / {folder} rw,noatime - ext4 /dev/mmcblk0p2 rw\n"
            ),
        },
    )
    link(host, "/sys/dev/block/179:2", f"{disk}/mmcblk0p2")


def link(host: HostSystem, name: str, target: str) -> None:
    host.path(name).parent.mkdir(parents=True, exist_ok=True)
    host.path(name).symlink_to(host.path(target))


def test_the_disk_below_the_store(folder: Path, host: HostSystem) -> None:
    sd_card(host, folder)
    finding = one(folder, "disk mmcblk0", host)
    assert finding.found.startswith("2.1 MB written, 77 flushes in 60 min")
    assert one(folder, "file system", host).level == "ok"
    assert "squashfs, not written" in one(folder, "root file system", host).found


def test_an_encrypted_volume_leads_to_its_disk(host: HostSystem) -> None:
    write(
        host, {"/sys/devices/nvme0n1/size": "1\n", "/sys/devices/nvme0n1/nvme0n1p3/partition": "3"}
    )
    write(host, {"/sys/devices/dm-0/size": "1\n"})
    host.path("/sys/devices/dm-0/slaves").mkdir()
    link(host, "/sys/devices/dm-0/slaves/nvme0n1p3", "/sys/devices/nvme0n1/nvme0n1p3")
    link(host, "/sys/class/block/crypt", "/sys/devices/dm-0")
    mount = mount_of(Path("/"), "1 0 0:30 / / rw - btrfs /dev/mapper/crypt rw\n")
    assert mount is not None
    disk = disk_of(mount, host)
    assert disk is not None and disk.name == "nvme0n1"
    assert disk_of(replace(mount, source="none"), host) is None


def test_an_emmc_tells_its_age(host: HostSystem) -> None:
    place = "/sys/devices/mmcblk1"
    write(host, {f"{place}/device/type": "MMC", f"{place}/device/life_time": "0x01 0x03",
                 f"{place}/device/pre_eol_info": "0x02"})  # fmt: skip
    disk = read_disk(host.path(place))
    assert (disk.kind, disk.life_percent, disk.spare, disk.flushes) == ("eMMC", 30, 2, None)
    write(host, {f"{place}/device/life_time": "0x00 0x00", f"{place}/device/pre_eol_info": "?"})
    disk = read_disk(host.path(place))
    assert (disk.life_percent, disk.spare) == (None, None)


def test_a_system_that_tells_nothing(folder: Path, host: HostSystem) -> None:
    assert one(folder, "file system", host).level == "warn"
    checks = {finding.check for finding in checkup(folder, host)}
    assert "root file system" not in checks and "wear" in checks


def test_traffic_is_bytes_per_day_of_recording(folder: Path) -> None:
    record(folder, 100).close()
    found = traffic(open_store(folder / "store"))
    files = list((folder / "store" / "journal").glob("*.mcap"))
    assert found is not None and found.writers == 1
    assert found.seconds == pytest.approx(100, abs=2)
    size = sum(path.stat().st_size for path in files)
    assert found.journal_bytes == pytest.approx(size / 100 * 86_400, rel=0.05)
    assert found.syncs(2.0) == 43_200


def test_too_little_traffic_says_nothing(folder: Path) -> None:
    record(folder, 3).close()
    assert traffic(open_store(folder / "store")) is None


def test_the_probe_leaves_no_trace(tmp_path: Path) -> None:
    writes, syncs = probe(tmp_path)
    assert len(writes) == len(syncs) == 16 and min(syncs) > 0
    assert list(tmp_path.iterdir()) == []


# -- the record


def test_nothing_recorded_yet(folder: Path, host: HostSystem) -> None:
    before = sorted(folder.rglob("*"))
    assert "nothing has been recorded" in one(folder, "recorder", host).found
    assert "made at the first start" in one(folder, "keys", host).found
    assert sorted(folder.rglob("*")) == before


def test_while_recording_and_after(folder: Path, host: HostSystem) -> None:
    clock = ManualClock()
    host = replace(host, clock=clock)
    box = record(folder, clock=clock)
    assert writer_pid(open_store(folder / "store")) == os.getpid()
    finding = one(folder, "recorder", host)
    assert finding.level == "ok" and f"process {os.getpid()}" in finding.found
    clock.advance(60)
    finding = one(folder, "recorder", host)
    assert finding.level == "error" and "hangs: last write 60 s ago" in finding.found
    box.write()
    assert one(folder, "recorder", host).level == "ok"
    box.close()
    assert one(folder, "recorder", host).level == "warn"
    assert writer_pid(open_store(folder / "store")) is None


def test_a_head_that_cannot_be_read_at_once_is_read_again(
    folder: Path, host: HostSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock()
    host = replace(host, clock=clock)
    box = record(folder, clock=clock)
    head = read_head(open_store(folder / "store").folder("main"))
    assert head is not None
    answers = iter([None, None, head])
    monkeypatch.setattr(checked, "read_head", lambda _: next(answers))
    assert one(folder, "recorder", host).level == "ok"
    monkeypatch.setattr(checked, "read_head", lambda _: None)
    monkeypatch.setattr(checked, "_PATIENCE_S", 0.05)
    assert "hangs: no last write" in one(folder, "recorder", host).found
    box.close()
    assert "not running" in one(folder, "recorder", host).found


def test_a_store_that_everybody_can_read_is_warned_of(folder: Path, host: HostSystem) -> None:
    store = create_store(folder / "store")
    assert store.path.stat().st_mode & 0o777 == 0o750 & ~_umask()
    assert "store" not in {finding.check for finding in checkup(folder, host)}
    store.path.chmod(0o755)
    found = one(folder, "store", host)
    assert found.level == "warn" and "chmod -R o-rwx" in found.hint


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def test_keys(folder: Path, host: HostSystem) -> None:
    record(folder).close()
    store = folder / "store"
    (store / "key").unlink(missing_ok=True)
    (store / "key.pub").unlink(missing_ok=True)
    assert "not signed" in one(folder, "keys", host).found
    (store / "key.pub").write_text("public")
    assert "only key.pub" in one(folder, "keys", host).found
    (store / "key").write_text("private")
    (store / "key").chmod(0o600)
    finding = one(folder, "keys", host)
    assert finding.level == "ok" and "off the robot" in finding.hint
    (store / "key").chmod(0o640)
    finding = one(folder, "keys", host)
    assert finding.level == "error" and "mode 0640" in finding.found and "chmod 600" in finding.hint
    (store / "key").chmod(0o600)
    (store / "key.pub").unlink()
    assert one(folder, "keys", host).level == "warn"


def test_the_unit_that_records_this_folder(folder: Path, host: HostSystem) -> None:
    run = service_of(load_folder(folder), "box", "root", "run")
    text = unit_text(service_of(load_folder(folder), "box", "root"))
    write(host, {
        "/etc/systemd/system/a.service": "[Service]\nExecStart=/usr/bin/true\n",
        "/etc/systemd/system/b.service": text.replace(str(folder), f"{folder}2"),
        "/etc/systemd/system/c.service": text.replace(str(folder), f"/srv{folder}"),
    })  # fmt: skip
    assert find_unit(folder, host) is None
    write(host, {"/etc/systemd/system/box.service": text})
    unit = find_unit(folder, host)
    assert unit is not None and (unit.name, unit.enabled, unit.watchdog) == (
        "box.service", False, "10"
    )  # fmt: skip
    write(host, {"/etc/systemd/system/box.service": unit_text(run)})
    assert find_unit(folder, host) == unit, "one that supervises the recorder records, too"
    link(host, "/etc/systemd/system/multi-user.target.wants/box.service",
         "/etc/systemd/system/box.service")  # fmt: skip
    box = record(folder)
    write(host, {f"/proc/{os.getpid()}/cgroup": "0::/system.slice/box.service\n"})
    assert one(folder, "service", host).level == "ok"
    box.close()
    assert "not active" in one(folder, "service", host).found


def test_a_check_that_cannot_look_does_not_end_the_others(
    folder: Path, host: HostSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    def power_meter(*_: object) -> list[DoctorFinding]:
        raise PermissionError(13, "Permission denied", "/secret")

    def thermometer(*_: object) -> list[DoctorFinding]:
        raise OSError("broken")

    monkeypatch.setattr(
        "amberbox.agent.doctor.checkup.CHECKS", (power_meter, thermometer, CHECKS[0])
    )
    findings = checkup(folder, host)
    assert [finding.check for finding in findings] == [
        "power meter", "thermometer", "configuration"
    ]  # fmt: skip
    assert "/secret may not be read" in findings[0].found
    assert "broken" in findings[1].found


def test_a_store_that_is_to_be_made_lies_where_its_parent_is(folder: Path) -> None:
    (folder / "robot.yaml").write_text("store: {path: records/of/r}\n")
    assert subject(folder).ground == folder.resolve()
