"""Wireless interfaces: by the kernel's table, and without that table."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.monitoring.probes.wifi import judge, measure, network, read

TABLE = """\
Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE
 face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22
 wlan0: 0000   56.  -54.  -256        0      0      0      0     64        0
"""


@pytest.fixture
def wireless(tmp_path: Path) -> Path:
    for name, state in (("wlan0", "up"), ("wlan1", "down"), ("eth0", "up")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "operstate").write_text(f"{state}\n")
        if name != "eth0":
            (tmp_path / name / "wireless").mkdir()
    (tmp_path / "table").write_text(TABLE)
    return tmp_path


def test_the_table_is_read(wireless: Path) -> None:
    assert read(wireless / "table", wireless, "wlan0") == {
        "ok": True,
        "quality_percent": 80.0,
        "signal_dbm": -54.0,
    }


def test_an_interface_that_went_down_is_not_ok(wireless: Path) -> None:
    (wireless / "wlan0" / "operstate").write_text("dormant\n")
    assert read(wireless / "table", wireless, "wlan0")["ok"] is False


def test_one_that_is_not_connected_or_not_there_is_not_ok(wireless: Path) -> None:
    away = read(wireless / "table", wireless, "wlan1")
    assert away == {"ok": False, "error": "wlan1 is not connected"}
    gone = read(wireless / "table", wireless, "wlan9")
    assert gone == {"ok": False, "error": "there is no interface wlan9"}


def test_a_cable_has_no_signal(wireless: Path) -> None:
    with pytest.raises(AmberboxError, match="eth0 is no wireless interface"):
        read(wireless / "table", wireless, "eth0")


def test_a_kernel_without_the_table_is_unknown(wireless: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read(wireless / "none", wireless, "wlan0")


@pytest.mark.parametrize(
    ("fields", "ok", "percent", "dbm"),
    [
        (["0000", "70.", "-30.", "-256"], True, 100.0, -30.0),
        (["0000", "35", "196", "160"], True, 50.0, -60.0),
        (["0000", "94.", "0.", "0"], True, 100.0, None),
        (["0000", "0.", "-256.", "-256"], False, 0.0, -256.0),
    ],
)
def test_drivers_old_and_new(
    fields: list[str], ok: bool, percent: float, dbm: float | None
) -> None:
    found = {"ok": ok, "quality_percent": percent, "signal_dbm": dbm}
    assert judge(fields, is_up=True) == found


def test_an_interface_without_a_network_has_no_name_of_one() -> None:
    assert network("lo") is None
    with pytest.raises(AmberboxError, match="lo is no wireless interface"):
        measure("lo")


def test_what_is_no_name_is_refused() -> None:
    with pytest.raises(UsageError, match="no network interface"):
        measure("../wlan0")
