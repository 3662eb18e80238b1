"""Readers of the power state: kernel supplies, upsd, GPIO lines and files."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.sources.power import (
    Config,
    Nut,
    Supply,
    SupplyReading,
    Sysfs,
    UnreadableError,
    combine_readings,
)

BATTERY = {"type": "Battery", "status": "Discharging", "capacity": "87", "voltage_now": "12100000"}
MAINS = {"type": "Mains", "online": "1"}


def write_supply(place: Path, name: str, files: Mapping[str, str]) -> Path:
    folder = place / name
    folder.mkdir(exist_ok=True)
    for file, text in files.items():
        (folder / file).write_text(f"{text}\n")
    return folder


@pytest.mark.parametrize(
    ("supplies", "state"),
    [
        ([MAINS, BATTERY], "mains"),
        ([MAINS | {"online": "0"}, BATTERY], "battery"),
        ([MAINS | {"online": "0"}], "battery"),
        ([MAINS | {"online": "0"}, MAINS | {"type": "USB"}, BATTERY], "mains"),
        ([MAINS | {"online": "0"}, BATTERY | {"status": "Charging"}], "mains"),
        ([MAINS | {"online": "0"}, BATTERY | {"status": "Unknown"}], "battery"),
        ([MAINS | {"online": "0"}, BATTERY | {"capacity_level": "Critical"}], "low"),
        ([MAINS, BATTERY | {"capacity_level": "Critical"}], "mains"),
        ([BATTERY], "battery"),
        ([BATTERY | {"status": "Full"}], "mains"),
        ([BATTERY | {"status": "Not charging"}], "mains"),
        ([MAINS, BATTERY | {"scope": "Device"}], "mains"),
        ([MAINS | {"online": "0"}, BATTERY | {"scope": "Device", "status": "Charging"}], "battery"),
    ],
)
def test_the_kernels_supplies_tell_the_state(
    tmp_path: Path, supplies: list[dict[str, str]], state: str
) -> None:
    for number, files in enumerate(supplies):
        write_supply(tmp_path, f"supply{number}", files)
    assert Sysfs(tmp_path).read().state == state


def test_a_fuel_gauge_alone_does_not_tell_the_state(tmp_path: Path) -> None:
    write_supply(tmp_path, "battery", {"type": "Battery", "status": "Unknown", "capacity": "102"})
    with pytest.raises(UnreadableError, match="does not tell whether there is external power"):
        Sysfs(tmp_path).read()
    write_supply(tmp_path, "charger", MAINS)
    assert Sysfs(tmp_path).read() == SupplyReading("mains", 100.0)


def test_one_supply_by_its_own_folder(tmp_path: Path) -> None:
    write_supply(tmp_path, "AC", MAINS)
    battery = write_supply(tmp_path, "BAT0", BATTERY | {"current_now": "-1500000"})
    reading = Sysfs(battery).read()
    assert (reading.state, reading.percentage, reading.current) == ("battery", 87.0, -1.5)
    assert reading.voltage == pytest.approx(12.1)


@pytest.mark.parametrize(
    ("files", "minutes"),
    [
        ({"time_to_empty_now": "1800"}, 30),
        ({"time_to_empty_avg": "600"}, 10),
        ({"energy_now": "30000000", "power_now": "20000000"}, 90),
        ({"charge_now": "2000000", "current_now": "-4000000"}, 30),
        ({"energy_now": "30000000", "power_now": "0"}, None),
        ({"energy_now": "30000000", "power_now": "20000000", "status": "Charging"}, None),
        ({}, None),
    ],
)
def test_the_time_left(tmp_path: Path, files: dict[str, str], minutes: float | None) -> None:
    write_supply(tmp_path, "BAT0", BATTERY | files)
    assert Sysfs(tmp_path).read().minutes_left == (minutes and pytest.approx(minutes))


def test_percentage_from_what_is_left(tmp_path: Path) -> None:
    files = {"type": "Battery", "status": "Discharging"}
    write_supply(tmp_path, "A", files | {"energy_now": "30", "energy_full": "40"})
    write_supply(tmp_path, "B", files | {"charge_now": "1", "charge_full": "4"})
    assert Sysfs(tmp_path).read().percentage == pytest.approx(50)


def test_no_supply_at_all(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UnreadableError, match="holds no power supply"):
            Sysfs(place).read()


# -- upsd


@dataclass
class Upsd:
    """Answers as upsd does."""

    port: int = 0
    ups: dict[str, dict[str, str]] = field(default_factory=dict)
    error: str = ""
    is_silent: bool = False
    asked: list[str] = field(default_factory=list)

    def answer(self, question: str) -> str:
        self.asked.append(question)
        if self.error:
            return f"ERR {self.error}\n"
        if question == "LIST UPS":
            lines = [f'UPS {name} "of the \\"box\\""' for name in self.ups]
        else:
            name = question.removeprefix("LIST VAR ")
            if name not in self.ups:
                return "ERR UNKNOWN-UPS\n"
            lines = [f'VAR {name} {key} "{value}"' for key, value in self.ups[name].items()]
        return "\n".join([f"BEGIN {question}", *lines, f"END {question}", ""])

    def serve(self, link: socket.socket) -> None:
        with link, link.makefile("r") as questions:
            for question in questions:
                if not self.is_silent:
                    text = self.answer(question.strip()).encode()
                    link.sendall(text[:7])  # answers may come in pieces
                    link.sendall(text[7:])


@contextmanager
def running_upsd(**ups: dict[str, str]) -> Iterator[Upsd]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        upsd = Upsd(server.getsockname()[1], dict(ups))

        def accept() -> None:
            while True:
                try:
                    link, _ = server.accept()
                except OSError:
                    return
                threading.Thread(target=upsd.serve, args=(link,), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        yield upsd
        server.shutdown(socket.SHUT_RDWR)


UPS = {
    "battery.charge": "87",
    "battery.voltage": "13.50",
    "battery.runtime": "1380",
    "device.model": 'Back-UPS \\"ES\\"',
    "ups.status": "OB DISCHRG",
}


@pytest.fixture
def upsd() -> Iterator[Upsd]:
    with running_upsd(ups=dict(UPS)) as made:
        yield made


def test_upsd_is_asked_over_one_connection(upsd: Upsd) -> None:
    nut = Nut("127.0.0.1", upsd.port, "")
    assert [nut.read(), nut.read()] == [SupplyReading("battery", 87.0, 13.5, None, 23.0)] * 2
    assert upsd.asked == ["LIST UPS", "LIST VAR ups", "LIST VAR ups"]
    nut.close()


@pytest.mark.parametrize(
    ("status", "state"),
    [
        ("OL", "mains"),
        ("OL CHRG LB", "mains"),
        ("BYPASS", "mains"),
        ("OB DISCHRG", "battery"),
        ("OB LB", "low"),
        ("FSD OL", "low"),
    ],
)
def test_the_status_of_a_ups(upsd: Upsd, status: str, state: str) -> None:
    upsd.ups["ups"]["ups.status"] = status
    assert Nut("127.0.0.1", upsd.port, "ups").read().state == state


def test_what_upsd_cannot_say(upsd: Upsd) -> None:
    upsd.ups["ups"]["ups.status"] = "WAIT"
    nut = Nut("127.0.0.1", upsd.port, "ups")
    with pytest.raises(UnreadableError, match="says 'WAIT'"):
        nut.read()
    upsd.error = "DATA-STALE"
    with pytest.raises(UnreadableError, match="upsd says ERR DATA-STALE to LIST VAR ups"):
        nut.read()
    upsd.error, upsd.ups["other"] = "", {}
    with pytest.raises(UnreadableError, match=r"has 2 UPS \(ups, other\); name one"):
        Nut("127.0.0.1", upsd.port, "").read()
    upsd.ups.clear()
    with pytest.raises(UnreadableError, match="has no UPS"):
        Nut("127.0.0.1", upsd.port, "").read()
    with pytest.raises(UnreadableError, match="UNKNOWN-UPS"):
        Nut("127.0.0.1", upsd.port, "gone").read()


def test_a_silent_upsd_is_given_up_and_asked_anew(upsd: Upsd) -> None:
    nut = Nut("127.0.0.1", upsd.port, "ups")
    upsd.is_silent = True
    with pytest.raises(UnreadableError, match=f"upsd at 127.0.0.1:{upsd.port}: timed out"):
        nut.read()
    upsd.is_silent = False
    assert nut.read().state == "battery"


def test_no_upsd() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(UnreadableError, match="refused"):
        Nut("127.0.0.1", port, "ups").read()


# -- lines and files


def supply(**options: Any) -> Supply:
    made = Supply(**options)
    assert list(made.check()) == []
    return made


@pytest.mark.parametrize(
    ("options", "zero", "one"),
    [
        ({}, "battery", "mains"),
        ({"active": "low"}, "mains", "battery"),
        ({"means": "battery"}, "mains", "battery"),
        ({"means": "battery", "active": "low"}, "battery", "mains"),
        ({"means": "low"}, "mains", "low"),
    ],
)
def test_a_line(tmp_path: Path, options: dict[str, Any], zero: str, one: str) -> None:
    value = tmp_path / "value"
    reader = supply(kind="gpio", path=str(value), **options).reader()
    for text, state in (("0\n", zero), ("1\n", one)):
        value.write_text(text)
        assert reader.read().state == state
    value.write_text("high")
    with pytest.raises(UnreadableError, match=r"says 'high', which is none of [01], [01]"):
        reader.read()
    value.unlink()
    with pytest.raises(UnreadableError, match="No such file"):
        reader.read()


def test_a_file_of_words_with_battery_files_that_move(tmp_path: Path) -> None:
    (tmp_path / "hwmon3").mkdir()
    (tmp_path / "hwmon3" / "in1_input").write_text("3710\n")
    (tmp_path / "state").write_text("On Battery\0\n")
    (tmp_path / "percent").write_text("41.5")
    reader = (
        supply(
            kind="file", path="state", battery=["on battery"], percent_path="percent",
            voltage_path="hwmon*/in1_input", voltage_scale=0.001,
        )
        .in_folder(tmp_path)
        .reader()
    )  # fmt: skip
    reading = reader.read()
    assert (reading.state, reading.percentage) == ("battery", 41.5)
    assert reading.voltage == pytest.approx(3.71)
    (tmp_path / "percent").write_text("nan")
    with pytest.raises(UnreadableError, match="no finite number"):
        reader.read()
    (tmp_path / "percent").write_text("?")
    with pytest.raises(UnreadableError, match="is no number"):
        reader.read()
    (tmp_path / "hwmon3" / "in1_input").unlink()
    (tmp_path / "percent").write_text("7")
    with pytest.raises(UnreadableError, match="nothing fits"):
        reader.read()


# -- limits, and several supplies


@pytest.mark.parametrize(
    ("reading", "state"),
    [
        (SupplyReading("battery", 21), "battery"),
        (SupplyReading("battery", 20), "low"),
        (SupplyReading("mains", 5, 9.0), "mains"),
        (SupplyReading("battery", 90, 10.51), "battery"),
        (SupplyReading("battery", 90, 10.5), "low"),
        (SupplyReading("battery"), "battery"),
    ],
)
def test_limits_hold_on_battery_only(reading: SupplyReading, state: str) -> None:
    assert supply(low_percent=20, low_voltage=10.5).judged(reading).state == state


def test_the_worst_supply_counts() -> None:
    first = SupplyReading("mains", 100, 5.1)
    second = SupplyReading("battery", 60, 12.0, -1.0, 40)
    third = SupplyReading("battery", 50, None, None, 90)
    assert combine_readings([first, second, third]) == SupplyReading("battery", 50, 12.0, -1.0, 40)
    assert combine_readings([first]) == first
    assert combine_readings([SupplyReading("low"), second]).state == "low"


@pytest.mark.parametrize(
    ("options", "key", "words"),
    [
        ({"kind": "gpio"}, "path", "is missing"),
        ({"kind": "file", "path": "x", "low": ["battery"]}, "mains", "means two things"),
        ({"port": 0}, "port", "between"),
        ({"low_percent": 100}, "low_percent", "below 100"),
        ({"low_voltage": 0}, "low_voltage", "above 0"),
        ({"kind": "nut", "ups": "a b"}, "ups", "one word"),
    ],
)
def test_a_supply_that_cannot_work(options: dict[str, Any], key: str, words: str) -> None:
    ((where, what),) = Supply(**options).check()
    assert where == key and words in what


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"supplies": ()}, "supplies"),
        ({"supplies": (Supply(), Supply())}, "supplies"),
        ({"poll_s": 0.0}, "poll_s"),
        ({"for_s": -1.0}, "for_s"),
        ({"record_s": 0.0}, "record_s"),
        ({"low_after_s": 0.0}, "low_after_s"),
    ],
)
def test_a_block_that_cannot_work(options: dict[str, Any], key: str) -> None:
    assert [where for where, _ in Config(**options).check()] == [key]
    assert list(Config().check()) == []
