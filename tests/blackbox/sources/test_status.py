"""The members of a team: what a watcher writes of one robot is data of the team's recorder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.blackbox.journal import channels
from amberbox.blackbox.robot_folder.folder import inspect_folder
from amberbox.blackbox.sources import status
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.contract import ObservedSink, assert_source_contract, observe
from amberbox.testing.records import FakeRun


def test_status_is_a_source() -> None:
    assert_source_contract(status, "status")


@pytest.fixture
def member(tmp_path: Path) -> FakeRun:
    return FakeRun(tmp_path / "ropod_001", "watch")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let silence be noticed, and the member looked for, sooner than in life."""
    monkeypatch.setattr(status, "_POLL_S", 0.01)
    monkeypatch.setattr(status, "_RETRY_S", 0.01)
    monkeypatch.setattr(status, "_SILENT_S", 0.3)


def source(member: Path, *topics: str) -> status.Source:
    config = status.Config(str(member), [TopicOptions(name=name) for name in topics])
    return status.Source(config, "ropod_001")


def say(run: FakeRun, component: str, level: str = "ok", *, ago_s: float = 0, **others: Any) -> int:
    """Write a component's status as the watcher does; return when it was measured."""
    now_ns = time.time_ns()
    measured_ns = now_ns - round(ago_s * NS)
    values: Mapping[str, Any] = {
        "robot": "ropod_001", "component": component, "mode": "", "level": level,
        "state": "nominal" if level == "ok" else "fault", "outputs": [], "blocked_by": [],
        "measured_ns": measured_ns, "since_ns": measured_ns - 7, "live_only": False,
        "reason": "" if level == "ok" else f"{component} is broken", "config_hash": "",
    }  # fmt: skip
    run.own(channels.STATUS, now_ns, {**values, **others})
    return measured_ns


def alarm(run: FakeRun, name: str, state: str) -> None:
    run.own(channels.ALARM, time.time_ns(), {"id": name, "state": state})


def heard(sink: ObservedSink, topic: str, act: Callable[[], object]) -> dict[str, Any]:
    """Repeat an act, as a watcher repeats its statuses, until a message was received; return it."""
    count = len(sink.of(topic))
    for _ in range(100):
        act()
        try:
            return dict(msgspec.json.decode(sink.wait_for(topic, count + 1, 0.1)[-1]))
        except TimeoutError:
            continue
    raise TimeoutError(topic)


def test_component_becomes_a_topic(member: FakeRun, quick: None) -> None:
    blocked: Mapping[str, Any] = {"blocked_by": ["laser", "wifi"]}
    with observe(source(member.store)) as sink:
        row = heard(sink, "navigation", lambda: say(member, "navigation", "error", **blocked))
    assert row.pop("measured_ns") - row.pop("since_ns") == 7
    assert 0 <= row.pop("age_s") < PATIENCE_S
    assert row == {
        "level": "error",
        "level_code": 4,
        "reason": "navigation is broken",
        "state": "fault",
        "blocked_by": "laser, wifi",
    }


def test_robot_is_as_bad_as_its_worst_component(member: FakeRun, quick: None) -> None:
    def round_() -> None:
        say(member, "laser")
        say(member, "docker", "unknown", state="not_monitored")
        say(member, "wifi", "warn", reason="weak")

    with observe(source(member.store)) as sink:
        heard(sink, "robot", round_)
        row = heard(sink, "robot", round_)
    assert (row["level"], row["level_code"], row["worst"]) == ("warn", 1, "wifi")
    assert row["reason"] == "weak"
    assert (row["components"], row["ok"], row["warn"], row["unknown"]) == (2, 1, 1, 0)


def test_robot_that_is_well_has_no_worst_component(member: FakeRun, quick: None) -> None:
    with observe(source(member.store)) as sink:
        row = heard(sink, "robot", lambda: say(member, "laser"))
    assert (row["level"], row["worst"], row["reason"]) == ("ok", "", "")


def test_alarms_are_counted_also_those_of_before(member: FakeRun, quick: None) -> None:
    alarm(member, "laser-1", "open")
    alarm(member, "wifi-1", "open")
    alarm(member, "wifi-1", "healed")
    alarm(member, "imu-1", "shelved")
    with observe(source(member.store)) as sink:
        assert heard(sink, "robot", lambda: say(member, "laser"))["alarms"] == 1
        alarm(member, "laser-1", "healed")
        assert heard(sink, "robot", lambda: say(member, "laser"))["alarms"] == 0


def test_only_what_is_asked_for_is_recorded(member: FakeRun, quick: None) -> None:
    with observe(source(member.store, "laser")) as sink:
        heard(sink, "laser", lambda: (say(member, "wifi"), say(member, "laser")))
        assert [topic.name for topic in sink.topics] == ["laser"]


def test_component_called_robot_makes_room(member: FakeRun, quick: None) -> None:
    with observe(source(member.store)) as sink:
        heard(sink, "robot", lambda: say(member, "robot", "error"))
        assert "state" in msgspec.json.decode(sink.wait_for("robot_component", 1)[0])


def test_what_was_said_before_is_not_how_it_is_now(member: FakeRun, quick: None) -> None:
    say(member, "laser", "error")
    with observe(source(member.store)) as sink:
        heard(sink, "wifi", lambda: say(member, "wifi"))
        assert sink.of("laser") == []


def test_what_the_watcher_catches_up_with_is_left_out(member: FakeRun, quick: None) -> None:
    dead: Mapping[str, Any] = {"ago_s": 60, "live_only": True}
    with observe(source(member.store)) as sink:
        heard(sink, "wifi", lambda: (say(member, "laser", ago_s=60), say(member, "wifi")))
        assert sink.of("laser") == []
        row = heard(sink, "laser", lambda: say(member, "laser", "unknown", **dead))
    assert row["age_s"] > 59


def test_component_that_is_watched_no_more_does_not_count(member: FakeRun, quick: None) -> None:
    with observe(source(member.store)) as sink:
        heard(sink, "laser", lambda: say(member, "laser", "error", ago_s=4))
        heard(sink, "wifi", lambda: say(member, "wifi"))  # until then it is the laser's
        row = heard(sink, "robot", lambda: say(member, "wifi"))
    assert (row["level"], row["components"]) == ("ok", 1)


def test_silent_member_is_a_lost_link_until_it_speaks_again(member: FakeRun, quick: None) -> None:
    with observe(source(member.store)) as sink:
        heard(sink, "laser", lambda: say(member, "laser"))
        downs = list(_wait_for_links(sink, "down", 2))
        assert {topic for _, topic, _, _, _ in downs} == {"laser", "robot"}
        assert "has said nothing for" in downs[0][3]
        count = len(sink.of("laser"))
        time.sleep(0.05)
        assert len(sink.of("laser")) == count
        heard(sink, "laser", lambda: say(member, "laser"))
        assert len(list(_wait_for_links(sink, "up", 4))) >= 4


def _wait_for_links(sink: ObservedSink, way: str, count: int) -> Iterator[Any]:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        found = [link for link in sink.links if link[0] == way]
        if len(found) >= count:
            return iter(found)
        time.sleep(0.01)
    raise TimeoutError(way)


def test_member_may_come_later(tmp_path: Path, quick: None) -> None:
    folder = tmp_path / "ropod_001"
    with observe(source(folder)) as sink:
        while not sink.events:
            time.sleep(0.01)
        assert sink.events[0][0] == "unreachable"
        member = FakeRun(folder, "watch")
        heard(sink, "laser", lambda: say(member, "laser"))
        assert len(sink.events) == 1


def test_new_files_and_runs_are_followed(member: FakeRun, quick: None) -> None:
    with observe(source(member.store)) as sink:
        heard(sink, "laser", lambda: say(member, "laser"))
        member.rotate()
        heard(sink, "laser", lambda: say(member, "laser"))
        member.close()
        again = FakeRun(member.store, "watch")
        heard(sink, "laser", lambda: say(again, "laser"))


def folder_with(folder: Path, block: str) -> list[str]:
    folder.mkdir(exist_ok=True)
    (folder / "robot.yaml").write_text("id: team\n")
    (folder / "black_box.yaml").write_text(f"- status: {block}\n")
    return [str(problem) for problem in inspect_folder(folder)[1]]


def test_place_is_seen_from_the_folder(tmp_path: Path) -> None:
    (note,) = folder_with(tmp_path / "team", "{name: ropod_001, where: ../ropod_001}")
    assert "there is nothing at" in note
    (tmp_path / "ropod_001").mkdir()
    assert folder_with(tmp_path / "team", "{name: ropod_001, where: ../ropod_001}") == []
    folder, _ = inspect_folder(tmp_path / "team")
    assert folder is not None
    assert Path(folder.blocks[0].config.where).samefile(tmp_path / "ropod_001")


def test_time_that_cannot_work_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (problem,) = folder_with(tmp_path, "{where: x, late_s: 0}")
    assert "late_s: must be above 0" in problem
