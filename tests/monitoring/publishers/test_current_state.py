"""The present state of a robot, from real journals; nothing stays green without a watcher."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.store.store import Store, WriterLock, create_store
from amberbox.core.clock import NS
from amberbox.core.types import Status
from amberbox.monitoring.current_state import (
    CurrentState,
    CurrentStateReader,
    WatcherHeartbeat,
    duration_text,
)
from amberbox.monitoring.findings import AlarmChange, Finding, record_of
from amberbox.testing.records import T0_NS, FakeRun
from tests.monitoring.publishers.laser import COMPONENT, OF_DEVICE, OF_HEARTBEAT

ALARM = AlarmChange(
    *("ropod_001", "laser-1", "laser", "urgent", "open", "error", "gone"),
    *(T0_NS, T0_NS, 1, "", None, "abc"),
)


def say(run: FakeRun, at_ns: int, *findings: Finding) -> None:
    """Write findings as the watcher does; statuses are measured when they are written."""
    for finding in findings:
        now = replace(finding, measured_ns=at_ns) if isinstance(finding, Status) else finding
        channel, values = record_of(now)
        run.own(channel, at_ns, values)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return create_store(tmp_path / "store")


@pytest.fixture
def watcher(store: Store) -> FakeRun:
    return FakeRun(store.path, "watch")


def read(store: Store, after_s: float) -> CurrentState:
    return CurrentStateReader(store).read(T0_NS + round(after_s * NS))


def test_newest_of_each_status_counts(store: Store, watcher: FakeRun) -> None:
    for second in range(5):
        say(watcher, T0_NS + second * NS, COMPONENT, OF_DEVICE, OF_HEARTBEAT)
    say(watcher, T0_NS + 4 * NS + NS // 4, replace(OF_DEVICE, level="error"))
    board = read(store, 4.5)
    assert [(s.component, s.mode, s.level) for s in board.statuses] == [
        ("laser", "", "ok"), ("laser", "laser_device", "error"), ("laser", "laser_heartbeat", "ok"),
    ]  # fmt: skip
    assert board.robot == "ropod_001"
    assert board.measured_ns == T0_NS + 4 * NS + NS // 4
    assert board.silence == ""
    assert list(board.components) == ["laser"]
    assert [mode.mode for mode in board.modes_of("laser")] == ["laser_device", "laser_heartbeat"]


def test_what_is_watched_no_more_is_left_out(store: Store, watcher: FakeRun) -> None:
    gone = replace(COMPONENT, component="gone")
    say(watcher, T0_NS, COMPONENT, gone)
    for second in range(1, 4):
        say(watcher, T0_NS + second * NS, COMPONENT)
    assert list(read(store, 3).components) == ["laser"]


@settings(max_examples=25)
@given(after_s=st.floats(3.01, 1e6))
def test_nothing_stays_green_when_the_watcher_is_silent(
    tmp_path_factory: pytest.TempPathFactory, after_s: float
) -> None:
    store = create_store(tmp_path_factory.mktemp("silent") / "store")
    say(FakeRun(store.path, "watch"), T0_NS, COMPONENT, OF_DEVICE, OF_HEARTBEAT)
    board = read(store, after_s)
    assert {status.level for status in board.statuses} == {"unknown"}
    assert {value for status in board.statuses for value in status.outputs.values()} == {None}
    assert {status.reason for status in board.statuses} == {board.silence}
    assert board.silence.startswith("the watcher has said nothing for ")


def test_silence_says_for_how_long_and_whether_the_watcher_runs(
    store: Store, watcher: FakeRun
) -> None:
    say(watcher, T0_NS, COMPONENT)
    assert read(store, 2.9).silence == ""
    assert read(store, 12).silence == "the watcher has said nothing for 12 s"
    lock = WriterLock(store, "watch")
    assert read(store, 12).silence == "the watcher has said nothing for 12 s, though it runs"
    lock.release()


def test_board_without_any_status(store: Store) -> None:
    assert read(store, 0) == CurrentState(
        (), [], 0, "the watcher has said nothing yet", WatcherHeartbeat("absent")
    )


def test_watcher_that_catches_up_is_not_believed(store: Store, watcher: FakeRun) -> None:
    channel, values = record_of(replace(COMPONENT, measured_ns=T0_NS - 40 * NS))
    watcher.own(channel, T0_NS, values)
    board = read(store, 0)
    assert board.silence == "the watcher is 40 s behind"
    assert board.components["laser"].level == "unknown"


def test_what_is_only_seen_live_is_of_now(store: Store, watcher: FakeRun) -> None:
    dead = replace(COMPONENT, measured_ns=T0_NS - 40 * NS, level="unknown", live_only=True)
    channel, values = record_of(replace(dead, reason="the recorder is dead"))
    watcher.own(channel, T0_NS, values)
    assert read(store, 0).components["laser"].reason == "the recorder is dead"


def test_board_of_a_watcher_that_goes_on_after_it_was_held_up(
    store: Store, watcher: FakeRun
) -> None:
    """The watcher wrote that nothing is known, evaluated the backlog, and continued."""
    for number, status in enumerate((OF_DEVICE, COMPONENT)):
        silent = replace(status, level="unknown", measured_ns=T0_NS + 30 * NS, live_only=True)
        channel, values = record_of(silent)
        watcher.own(channel, T0_NS + 30 * NS + number, values)
    past = replace(COMPONENT, measured_ns=T0_NS + 5 * NS, level="error")
    watcher.own(channel, T0_NS + 31 * NS, record_of(past)[1])
    board = read(store, 31)
    assert board.silence == "the watcher is 26 s behind"
    assert [status.mode for status in board.statuses] == [OF_DEVICE.mode, ""]
    assert board.measured_ns == past.measured_ns
    other = replace(OF_DEVICE, measured_ns=T0_NS + 5 * NS)
    watcher.own(channel, T0_NS + 31 * NS, record_of(other)[1])
    assert {status.measured_ns for status in read(store, 31).statuses} == {past.measured_ns}


def test_status_from_the_future_is_not_believed(store: Store, watcher: FakeRun) -> None:
    say(watcher, T0_NS, COMPONENT)
    board = read(store, -3600)
    assert "from the future" in board.silence
    assert board.components["laser"].level == "unknown"


def test_alarms_stand_until_they_are_healed(store: Store, watcher: FakeRun) -> None:
    reader = CurrentStateReader(store)
    other = replace(ALARM, id="wifi-1", component="wifi")
    say(watcher, T0_NS, ALARM, other)
    for second in range(100):
        say(watcher, T0_NS + second * NS, COMPONENT)
    assert reader.read(T0_NS).alarms == [ALARM, other]
    shelved = replace(ALARM, state="shelved", who="ada", until_ns=T0_NS + NS)
    say(watcher, T0_NS + 100 * NS, shelved, replace(other, state="healed"))
    assert reader.read(T0_NS).alarms == [shelved]
    assert CurrentStateReader(store).read(T0_NS).alarms == [shelved]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (12, "12 s"), (119, "119 s"), (120, "2 min"), (7200, "2 h"), (1e6, "11 days")],
)
def test_durations_as_people_say_them(seconds: float, text: str) -> None:
    assert duration_text(round(seconds * NS)) == text
