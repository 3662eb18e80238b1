"""The power source: its reports to the recorder, their times, and its messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.sources.power import (
    Config,
    PowerLimits,
    PowerStateFilter,
    Source,
    Supply,
    SupplyWatch,
)
from amberbox.core.source import Power
from amberbox.testing.contract import ObservedSink, observe
from tests.support.manual_recorder import ManualBox, events, raw_messages


class Hat:
    """A UPS HAT made of two files."""

    def __init__(self, place: Path, name: str = "hat") -> None:
        self.state_file, self.percent_file = place / f"{name}.state", place / f"{name}.percent"
        self.supply = Supply(
            kind="file", name=name, path=str(self.state_file), percent_path=str(self.percent_file)
        )
        self.says("mains")

    def says(self, state: str, percent: float = 100) -> None:
        self.state_file.write_text(state)
        self.percent_file.write_text(str(percent))

    def vanish(self) -> None:
        self.state_file.unlink()


@pytest.fixture
def hat(tmp_path: Path) -> Hat:
    return Hat(tmp_path)


def watch(*hats: Hat, for_s: float = 1.0, low_after_s: float | None = None) -> Any:
    sink = ObservedSink()
    limits = PowerLimits(for_s, low_after_s)
    return SupplyWatch([hat.supply for hat in hats], limits, 1.0, sink), sink


def recorded(sink: ObservedSink, topic: str = "supply") -> list[dict[str, Any]]:
    return [json.loads(message) for message in sink.of(topic)]


def test_power_is_lost_comes_back_and_gets_low(hat: Hat) -> None:
    box, sink = watch(hat)
    box.poll(0)
    hat.says("battery", 87)
    box.poll(0.5)
    box.poll(1.0)
    assert sink.powers == [("mains", "on external power: 100 %")]
    box.poll(1.5)
    hat.says("battery", 9)
    box.poll(2.0)
    box.poll(3.0)
    hat.says("mains", 9)
    box.poll(3.5)
    box.poll(4.5)
    assert sink.powers[1:] == [
        ("battery", "external power is lost: 87 %"),
        ("low", "the battery is low: 9 %"),
        ("mains", "on external power: 9 %"),
    ]


def test_a_short_dip_is_recorded_and_nothing_else(hat: Hat) -> None:
    box, sink = watch(hat)
    box.poll(0)
    hat.says("battery")
    box.poll(0.5)
    hat.says("mains")
    box.poll(1.0)
    hat.says("battery")
    box.poll(1.6)
    assert [state for state, _ in sink.powers] == ["mains"]


def test_messages_come_regularly_and_at_once_on_a_change(hat: Hat) -> None:
    box, sink = watch(hat, for_s=0)
    for poll in range(5):
        box.poll(poll / 2)
    assert len(recorded(sink)) == 3
    hat.says("battery", 60)
    box.poll(2.1)
    assert recorded(sink)[-2:] == [
        {"state": "mains", "online": True, "on_battery": False, "percentage": 100.0},
        {"state": "battery", "online": False, "on_battery": True, "percentage": 60.0},
    ]


def test_a_start_on_battery_is_told_at_once(hat: Hat) -> None:
    hat.says("battery", 50)
    box, sink = watch(hat)
    box.poll(0)
    assert [state for state, _ in sink.powers] == ["battery"]


def test_a_run_that_begins_low_records_until_it_gets_low_again(hat: Hat) -> None:
    hat.says("battery", 3)
    box, sink = watch(hat, for_s=0, low_after_s=60)
    for now_s in range(0, 200, 10):
        box.poll(now_s)
    assert sink.powers == [("battery", "external power is lost: 3 %")]
    hat.says("mains", 15)
    box.poll(200)
    hat.says("battery", 9)
    box.poll(201)
    assert [state for state, _ in sink.powers[1:]] == ["mains", "low"]


def test_a_long_time_on_battery_is_low_also_when_nothing_can_be_read(hat: Hat) -> None:
    box, sink = watch(hat, for_s=0, low_after_s=60)
    hat.says("battery")
    box.poll(0)
    hat.vanish()
    box.poll(59)
    assert [state for state, _ in sink.powers] == ["battery"]
    box.poll(60)
    assert [state for state, _ in sink.powers] == ["battery", "low"]


def test_the_time_on_battery_begins_anew_after_external_power() -> None:
    judge = PowerStateFilter(PowerLimits(0, 60))
    told: list[tuple[float, Power | None]] = []
    steps: list[tuple[float, Power]] = [
        (0, "battery"), (50, "mains"), (51, "battery"), (110, "battery"), (111, "battery")
    ]  # fmt: skip
    for now_s, state in steps:
        if judge.update(state, now_s):
            told.append((now_s, judge.state))
    assert told == [(0, "battery"), (50, "mains"), (51, "battery"), (111, "low")]


def test_a_missing_supply_is_an_event_and_is_tried_again_with_back_off(hat: Hat) -> None:
    hat.vanish()
    box, sink = watch(hat)
    tried = []
    for tenth in range(400):
        before = len(sink.events)
        hat.state_file.write_text(str(tenth))  # another trouble each time it is tried
        box.poll(tenth / 10)
        tried += [tenth / 10] if len(sink.events) > before else []
    assert tried == [0.0, 1.0, 3.0, 7.0, 15.0, 25.0, 35.0]
    assert {kind for kind, *_ in sink.events} == {"power_unreadable"}
    assert sink.messages == [] and sink.links == [] and sink.powers == []
    hat.says("mains")
    box.poll(45)
    assert sink.events[-1][:2] == ("power_readable", "hat can be read again")
    assert sink.links[-1][:3] == ("up", "supply", "hat")
    box.poll(46)
    assert len(sink.messages) == 2


def test_the_same_trouble_is_told_once_and_opens_a_gap(hat: Hat) -> None:
    box, sink = watch(hat)
    box.poll(0)
    hat.vanish()
    for now_s in range(1, 60):
        box.poll(now_s)
    assert [kind for kind, *_ in sink.events] == ["power_unreadable"]
    (_, _, _, reason, _) = sink.links[1]
    assert "No such file" in reason
    assert len(sink.messages) == 1


def test_several_supplies_the_worst_counts_and_each_has_an_item(tmp_path: Path, hat: Hat) -> None:
    ups = Hat(tmp_path, "ups")
    box, sink = watch(hat, ups, for_s=0)
    box.poll(0)
    ups.says("battery", 40)
    box.poll(1)
    assert sink.powers[-1] == ("battery", "external power is lost (ups): 40 %")
    assert [m["state"] for m in recorded(sink)] == ["mains", "battery"]
    assert [m["state"] for m in recorded(sink, "supply/hat")] == ["mains", "mains"]
    assert [m["state"] for m in recorded(sink, "supply/ups")] == ["mains", "battery"]
    ups.vanish()  # what it said last stays valid
    box.poll(2)
    assert recorded(sink)[-1]["state"] == "battery"
    assert len(recorded(sink, "supply/ups")) == 2
    box.close()
    assert sink.open_links() == set()


def test_it_runs_as_a_source_and_stops(hat: Hat) -> None:
    with observe(Source(Config((hat.supply,), poll_s=0.05, record_s=0.05), "power")) as sink:
        sink.wait_for("supply", 3)
    assert sink.powers == [("mains", "on external power: 100 %")]


def test_a_recorder_hears_it_and_triggers_can_read_it(tmp_path: Path, hat: Hat) -> None:
    hat.says("battery", 40)
    box = ManualBox(tmp_path / "store", source="power")
    SupplyWatch([hat.supply], PowerLimits(), 1.0, box.sink).poll(0)
    box.write()
    assert box.pipeline.power == "battery"
    (event,) = events(tmp_path / "store", "power_battery")
    assert event["text"] == "external power is lost: 40 %"
    box.close()
    (message,) = raw_messages(tmp_path / "store", "supply")
    assert json.loads(message)["percentage"] == 40
    assert list(box.pipeline.items) == ["power_supply"]


def test_a_block_of_black_box_yaml(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text(
        """
- power:
    supplies:
      - {kind: file, name: hat, path: hat.state, mains: [1, OL], battery: [0], low: [LB]}
    low_after_s: 5 min
"""
    )
    config = load_folder(tmp_path).blocks[0].config
    assert config.low_after_s == 300
    (supply,) = config.supplies
    assert supply.path == str(tmp_path / "hat.state")
    (tmp_path / "hat.state").write_text("ol\n")
    assert supply.reader().read().state == "mains"


def test_a_block_without_keys_uses_what_the_kernel_knows(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text("- power:\n")
    (supply,) = load_folder(tmp_path).blocks[0].config.supplies
    assert supply.kind == "sysfs"
