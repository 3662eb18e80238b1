"""Interfaces as the kernel shows them: real loopback, and trees of those that are not here."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.network_interface import measure, read


def interface(root: Path, name: str, **files: str) -> None:
    place = root / name
    (place / "statistics").mkdir(parents=True)
    for file in ("rx_errors", "tx_errors"):
        (place / "statistics" / file).write_text(f"{files.pop(file, '0')}\n")
    for file, text in files.items():
        (place / file).write_text(f"{text}\n")


def test_the_loopback_of_this_computer_is_up() -> None:
    found = measure("lo")
    assert (found["ok"], found["carrier"], found["state"]) == (True, True, "unknown")
    assert found["rx_errors"] == 0


def test_an_interface_that_works(tmp_path: Path) -> None:
    interface(tmp_path, "eth0", flags="0x1003", operstate="up", carrier="1", speed="1000",
              rx_errors="3", tx_errors="1")  # fmt: skip
    assert read(tmp_path, "eth0") == {
        "ok": True,
        "state": "up",
        "carrier": True,
        "speed_mbit": 1000,
        "rx_errors": 3,
        "tx_errors": 1,
    }


def test_a_cable_that_is_pulled(tmp_path: Path) -> None:
    interface(tmp_path, "eth0", flags="0x1003", operstate="down", carrier="0", speed="-1")
    found = read(tmp_path, "eth0")
    assert (found["ok"], found["carrier"], found["speed_mbit"]) == (False, False, None)


def test_an_interface_that_is_switched_off(tmp_path: Path) -> None:
    interface(tmp_path, "can0", flags="0x40080", operstate="down")
    found = read(tmp_path, "can0")
    assert (found["ok"], found["state"], found["carrier"]) == (False, "down", False)


def test_a_wireless_interface_that_is_not_let_in_yet(tmp_path: Path) -> None:
    interface(tmp_path, "wlan0", flags="0x1003", operstate="dormant", carrier="1")
    assert read(tmp_path, "wlan0")["ok"] is False


def test_an_adapter_that_is_pulled_out_is_absent(tmp_path: Path) -> None:
    assert read(tmp_path, "eth1") == {"ok": False, "state": "absent"}


def test_without_sysfs_nothing_is_known(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "sys", "eth0")


@pytest.mark.parametrize("name", ["", "..", "eth0/../lo"])
def test_what_is_no_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="no network interface"):
        read(tmp_path, name)
