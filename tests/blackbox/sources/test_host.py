"""The source of the computer's own state: this computer's, and one whose files tests write."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from amberbox.blackbox.columns.json_schema import notes_of
from amberbox.blackbox.sources import host
from amberbox.blackbox.sources.host import Config, Source
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import MemorySink, observe


def config(*topics: str, **changes: Any) -> Config:
    return Config(period_s=0.1, topics=[TopicOptions(name) for name in topics], **changes)


def rows(sink: MemorySink, topic: str, count: int) -> Sequence[dict[str, Any]]:
    return [json.loads(data) for data in sink.wait_for(topic, count)]


def units(sink: MemorySink, topic: str) -> dict[str, str]:
    return {
        path: note.unit
        for known in sink.topics
        if known.name == topic
        for path, note in notes_of(known.schema).items()
    }


def test_this_computer_is_measured() -> None:
    with observe(Source(config(), "host")) as sink:
        cpu = rows(sink, "cpu", 3)[-1]
        ram = rows(sink, "memory", 3)[-1]
        lo = rows(sink, "network", 3)[-1]["lo"]
    assert 0 <= cpu["percent"] <= 100
    assert len(cpu["percent_of_cores"]) <= cpu["cores"]
    assert ram["total_bytes"] == psutil.virtual_memory().total
    assert 0 < ram["used_percent"] < 100
    first = json.loads(sink.of("network")[0])["lo"]
    assert (
        lo["is_up"] is lo["carrier"] is True
        and lo["rx_bytes_per_s"] >= 0
        and first["rx_bytes_per_s"] >= 0
    )
    assert {("up", name) for name in ("cpu", "memory", "network")} <= {
        (way, topic) for way, topic, *_ in sink.links
    }
    assert units(sink, "memory")["available_bytes"] == "bytes"
    assert units(sink, "network")["lo/rx_bytes_per_s"] == "bytes/s"
    assert units(sink, "cpu")["percent_of_cores"] == "%"
    assert [kind for kind, *_ in sink.events] == []


def test_libraries_are_imported_by_what_runs_only() -> None:
    names = ("host", "journald", "serial", "versions")
    program = "; ".join(
        [
            "import sys",
            *(f"import amberbox.blackbox.sources.{name}" for name in names),
            "assert not {'psutil', 'serial'} & sys.modules.keys()",
        ]
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_only_groups_that_are_chosen_are_recorded() -> None:
    with observe(Source(config("memory"), "host")) as sink:
        rows(sink, "memory", 3)
    assert {topic.name for topic in sink.topics} == {"memory"}


def test_disks_are_measured_where_they_are_asked_for(tmp_path: Path) -> None:
    with observe(Source(config("disk", mounts=[str(tmp_path)]), "host")) as sink:
        (row,) = rows(sink, "disk", 1)[:1]
    (name, found), *others = row.items()
    assert not others and name == str(tmp_path).strip("/").replace("/", "_").replace("-", "_")
    assert found["total_bytes"] == psutil.disk_usage(str(tmp_path)).total
    assert found["read_only"] is False and 0 < found["used_percent"] < 100


def test_a_disk_that_is_pulled_out_is_a_gap_of_its_group_only(tmp_path: Path) -> None:
    place = tmp_path / "usb"
    place.mkdir()
    with observe(Source(config("disk", "memory", mounts=[str(place)]), "host")) as sink:
        rows(sink, "disk", 1)
        place.rmdir()
        wait_until(lambda: ("down", "disk") in [link[:2] for link in sink.links], "a gap begins")
        rows(sink, "memory", len(sink.of("memory")) + 2)
        place.mkdir()
        rows(sink, "disk", len(sink.of("disk")) + 1)
    (event,) = sink.events
    assert event[0] == "host_unreadable" and str(place) in event[1]
    assert [way for way, topic, *_ in sink.links if topic == "disk"] == [
        "up", "down", "up", "down",
    ]  # fmt: skip


def test_processes_are_followed_over_a_restart(tmp_path: Path) -> None:
    program = tmp_path / "planner_amber"
    shutil.copy2(shutil.which("sleep") or "/bin/sleep", program)

    def newest(key: str, value: Any) -> bool:
        found = sink.of("process")
        return bool(found) and json.loads(found[-1])["planner"][key] == value

    processes = {"planner": "planner_amber", "absent": "*no such program*"}
    with observe(Source(config("process", processes=processes), "host")) as sink:
        wait_until(lambda: newest("count", 0), "none runs")
        for number in (1, 2):
            with subprocess.Popen([program, "600"]) as running:
                wait_until(lambda: newest("count", 1), "it runs")
                wait_until(lambda n=number: newest("restarts", n), "it is a new one")  # type: ignore[misc]  # bound now
                running.kill()
            wait_until(lambda: newest("count", 0), "it has ended")
        found = [json.loads(data) for data in sink.of("process")]
    alive = next(row["planner"] for row in found if row["planner"]["count"])
    assert alive["rss_mb"] > 0 and alive["threads"] == 1 and alive["open_files"] >= 0
    assert {row["absent"]["count"] for row in found} == {0}
    assert units(sink, "process")["planner/rss_mb"] == "MB"


def test_sensors_are_read_where_there_are_some(monkeypatch: pytest.MonkeyPatch) -> None:
    from psutil._ntuples import sbattery, sfan

    fans = {"thinkpad": [sfan("", 2900), sfan("pump", 0)]}
    monkeypatch.setattr(psutil, "sensors_fans", lambda: fans)
    monkeypatch.setattr(psutil, "sensors_battery", lambda: sbattery(87, 5400, False))
    monkeypatch.setattr(
        host, "temperatures", lambda: [host_sensor("coretemp/Core 0", 61.0), host_sensor("x", 70.5)]
    )
    with observe(Source(config("fan", "battery", "temperature"), "host")) as sink:
        assert rows(sink, "fan", 1)[0] == {
            "thinkpad_fan1": {"rpm": 2900},
            "thinkpad_pump": {"rpm": 0},
        }
        assert rows(sink, "battery", 1)[0] == {
            "percent": 87,
            "plugged": False,
            "minutes_left": 90.0,
        }
        assert rows(sink, "temperature", 1)[0] == {
            "hottest_celsius": 70.5,
            "coretemp_Core_0": {"celsius": 61.0},
            "x": {"celsius": 70.5},
        }
    assert units(sink, "temperature")["coretemp_Core_0/celsius"] == "degC"


def host_sensor(name: str, celsius: float) -> Any:
    from amberbox.core.host import TemperatureSensor

    return TemperatureSensor(name, celsius, None)


def test_a_crash_in_one_reader_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(**_: object) -> None:
        raise ValueError("a line that\nis not understood")

    monkeypatch.setattr(psutil, "net_io_counters", crash)
    with observe(Source(config("network", "memory"), "host")) as sink:
        rows(sink, "memory", 3)
    assert [event[1] for event in sink.events] == [
        "network cannot be read: a line that is not understood"
    ]
    assert sink.of("network") == []


def test_another_interface_gets_columns_with_units(monkeypatch: pytest.MonkeyPatch) -> None:
    real = psutil.net_io_counters(pernic=True)["lo"]
    found = {"lo": real}
    monkeypatch.setattr(psutil, "net_io_counters", lambda **_: dict(found))
    interfaces = ["lo", "wlan*"]
    with observe(Source(config("network", interfaces=interfaces), "host")) as sink:
        rows(sink, "network", 1)
        found |= {"wlan0": real, "veth12": real}
        wait_until(lambda: b"wlan0" in sink.of("network")[-1], "it is measured")
    assert json.loads(sink.of("network")[-1]).keys() == {"lo", "wlan0"}
    assert units(sink, "network")["wlan0/tx_bytes"] == "bytes"


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("{period_s: 0}", "period_s: must be between"),
        ("{mounts: [data]}", "'data' is no absolute path"),
        ("{processes: {a b: x}}", "write a_b"),
        ("{processes: {a: ''}}", "'a' names no process"),
        ("{topics: [{topic: {name: cpus}}]}", "there is no topic 'cpus'; did you mean 'cpu'?"),
        ("{topics: [{topic: {name: gyroscope}}]}", "there are cpu, memory, disk"),
    ],
)
def test_wrong_options_are_named(block: str, words: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(block, "black_box.yaml", problems)
    assert node is not None
    build(Config, node, problems, "host")
    assert words in "\n".join(str(problem) for problem in problems)
