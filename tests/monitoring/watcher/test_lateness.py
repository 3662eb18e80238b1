"""A watcher that is late, stopped or starved: it reports this, and no fault of the robot."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path
from types import FrameType

import pytest

from amberbox.blackbox.store.store import WriterLock, create_store
from amberbox.core.clock import NS
from amberbox.monitoring.current_state import (
    STARTING_NS,
    STATE_FILE,
    CurrentStateReader,
    EvaluationLateness,
    WatcherHeartbeat,
    read_heartbeat,
    write_heartbeat,
)
from amberbox.monitoring.record_evaluation import HangError, HangGuard, RecordEvaluation
from amberbox.testing.clock import ManualClock
from tests.monitoring.watcher.stand import Stand, values_of, written


def test_states_of_monitoring(tmp_path: Path) -> None:
    store, clock = create_store(tmp_path / "store"), ManualClock()
    assert read_heartbeat(store, clock) == WatcherHeartbeat("absent")
    lock = WriterLock(store, "watch")
    assert read_heartbeat(store, clock) == WatcherHeartbeat("running")  # it says nothing yet
    write_heartbeat(store, clock, 0.1)
    assert read_heartbeat(store, clock) == WatcherHeartbeat("running", 0.1)
    write_heartbeat(store, clock, 12.5)
    assert read_heartbeat(store, clock) == WatcherHeartbeat("overloaded", 12.5)
    clock.advance(25.0)
    clock.step(-3600.0)
    assert read_heartbeat(store, clock) == WatcherHeartbeat("silent", 25.0)
    lock.release()
    assert read_heartbeat(store, clock) == WatcherHeartbeat("absent")


@pytest.mark.parametrize(
    "change", [{"pid": 1 << 30}, {"boot_id": "another"}, {"delay_s": None}, {"boot_ns": "x"}]
)
def test_sign_of_life_of_a_watcher_before_says_nothing(
    tmp_path: Path, change: dict[str, object]
) -> None:
    store, clock = create_store(tmp_path / "store"), ManualClock()
    lock = WriterLock(store, "watch")
    write_heartbeat(store, clock, 40.0)
    values = json.loads((store.path / STATE_FILE).read_text())
    assert values["pid"] == os.getpid()
    (store.path / STATE_FILE).write_text(json.dumps(values | change))
    assert read_heartbeat(store, clock) == WatcherHeartbeat("running")
    lock.release()


def test_sign_of_life_does_not_wait_for_the_evaluation(tmp_path: Path) -> None:
    """The thread writes while nothing is evaluated; a poll that takes long makes it late."""
    store, clock = create_store(tmp_path / "store"), ManualClock()
    lock = WriterLock(store, "watch")
    lateness = EvaluationLateness(store, clock)
    lateness.began()
    assert lateness.ended() is None
    lateness.began()
    clock.advance(20.0)
    lateness.start()
    written_to = threading.Event()
    while not (store.path / STATE_FILE).exists():
        written_to.wait(0.01)
    assert read_heartbeat(store, clock) == WatcherHeartbeat("overloaded", 20.0)
    board = CurrentStateReader(store).read(clock.wall_ns())
    assert board.monitoring is not None and board.monitoring.state == "running"  # another boot
    assert lateness.ended() == 20.0
    lateness.close()
    lock.release()


def test_watcher_that_begins_may_catch_up(tmp_path: Path) -> None:
    clock = ManualClock()
    lateness = EvaluationLateness(create_store(tmp_path / "store"), clock)
    lateness.began()
    clock.advance(STARTING_NS / NS - 1)
    assert lateness.delay_s() == 0.0
    clock.advance(2)
    assert lateness.delay_s() == STARTING_NS / NS + 1


def test_slow_evaluation_is_overload_and_not_a_silent_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand = Stand(tmp_path / "store", 3)
    stand.tick()
    watcher = stand.watcher()
    for _ in range(5):
        stand.tick()
        watcher.step()
    take = RecordEvaluation.take

    def slowly(self: RecordEvaluation, block: object) -> object:
        yield from take(self, block)  # type: ignore[arg-type]  # the function that it stands for
        for _ in range(200):
            stand.tick()

    with monkeypatch.context() as patched:
        patched.setattr(RecordEvaluation, "take", slowly)
        stand.tick()
        watcher.step()
    for _ in range(3):
        watcher.step()
        stand.tick()
    stand.box.close()
    watcher.step()
    watcher.close()
    events = values_of(written(stand.path, live_only=True), "amberbox/event")
    assert [event["kind"] for event in events] == ["monitoring_overloaded", "monitoring_recovered"]
    assert values_of(written(stand.path, live_only=True), "amberbox/status") == []
    assert written(stand.path) == stand.replayed()


def test_one_look_that_finds_nothing_is_no_silence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process was stopped for 25 s, and the head is being written at its first poll."""
    stand = Stand(tmp_path / "store", 3)
    stand.tick()
    watcher = stand.watcher()
    watcher.step()
    for _ in range(250):
        stand.tick()
    with monkeypatch.context() as patched:
        patched.setattr("amberbox.monitoring.record_reader.read_head", lambda folder: None)
        watcher.step()
    watcher.step()
    watcher.close()
    assert values_of(written(stand.path, live_only=True), "amberbox/status") == []


def test_waiting_for_a_processor_is_no_hang() -> None:
    frame = _frame()
    now, waited = [0.0], [0.0]
    guard = HangGuard(frozenset([_frame.__code__]), lambda: now[0], lambda: waited[0])
    for _ in range(50):
        now[0] += 0.4
        waited[0] += 0.39
        guard.check(0, frame)
    with pytest.raises(HangError):
        for _ in range(10):
            now[0] += 0.4
            guard.check(0, frame)


def _frame() -> FrameType:
    import sys

    return sys._getframe()
