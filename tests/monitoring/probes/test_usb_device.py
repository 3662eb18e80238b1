"""USB devices by vendor and product, by serial number, and those that are gone."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.usb_device import read


@pytest.fixture
def bus(tmp_path: Path) -> Path:
    device(tmp_path, "usb1", idVendor="1d6b", idProduct="0002", speed="480")
    (tmp_path / "1-2:1.0").mkdir()  # an interface of a device has none of the files
    device(tmp_path, "1-2", idVendor="15d1", idProduct="0000", speed="12", serial="H1234",
           product="URG-Series USB Driver")  # fmt: skip
    device(tmp_path, "1-4.1", idVendor="15D1", idProduct="0000", speed="1.5", serial="H5678")
    return tmp_path


def device(root: Path, port: str, **files: str) -> None:
    (root / port).mkdir()
    for name, text in files.items():
        (root / port / name).write_text(f"{text}\n")


def test_all_devices_of_a_kind_are_counted(bus: Path) -> None:
    assert read(bus, "15d1:0000") == {
        "ok": True,
        "count": 2,
        "port": "1-2",
        "speed_mbit": 12.0,
        "name": "URG-Series USB Driver",
    }


@pytest.mark.parametrize("subject", ["15D1:0000:H5678", "H5678"])
def test_one_of_two_alike_is_told_by_its_serial_number(bus: Path, subject: str) -> None:
    found = read(bus, subject)
    assert (found["count"], found["port"], found["speed_mbit"]) == (1, "1-4.1", 1.5)
    assert found["name"] is None


@pytest.mark.parametrize("subject", ["15d1:0001", "H9", "15d1:0000:H9", "h1234"])
def test_what_is_not_connected_is_not_ok(bus: Path, subject: str) -> None:
    assert read(bus, subject) == {"ok": False, "count": 0}


def test_without_a_usb_bus_nothing_is_known(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "bus", "15d1:0000")


@pytest.mark.parametrize("subject", ["", "15d1:", "15d1:00", ":H1"])
def test_what_names_no_device_is_refused(bus: Path, subject: str) -> None:
    with pytest.raises(UsageError, match="no USB device"):
        read(bus, subject)
