"""Failures beside the watcher, or in it: all are reported, nothing stays green."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.store.store import open_store, pending, submit
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup
from tests.monitoring.watcher.stand import (
    NUMBERS,
    PROBE,
    Stand,
    component,
    endless,
    kill,
    plan_of,
    run_until,
    values_of,
    variable,
    written,
)
from tests.support.manual_recorder import events


def test_nothing_stays_green_when_the_recorder_dies(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store", 3)
    stand.tick()
    watcher = stand.watcher()
    for _ in range(30):
        stand.tick()
        watcher.step()
    stand.box.crash()
    watcher.step()
    assert written(stand.path, live_only=True) == []
    for _ in range(50):
        stand.clock.advance(0.1)
        watcher.step()
    said = values_of(written(stand.path, live_only=True), "amberbox/status")
    everything = {(s.component, s.mode) for s in watcher._engine.statuses()}
    assert len(everything) == 8
    assert {(s["component"], s["mode"]) for s in said} == everything
    assert {s["level"] for s in said} == {"unknown"}
    assert len(said) == 3 * len(everything)
    assert said[0]["reason"] == "the recorder has written nothing for 2 s"
    assert said[-1]["reason"] == "the recorder has written nothing for 4 s"
    stand.box = stand._box()
    for _ in range(20):
        stand.tick()
        watcher.step()
    watcher.close()
    stand.box.close()
    assert len(values_of(written(stand.path, live_only=True), "amberbox/status")) == len(said)
    newest = values_of(written(stand.path), "amberbox/status")[-1]
    assert newest["level"] != "unknown" or newest["component"] == "laser"


def test_a_recorder_that_hangs_is_as_good_as_dead(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store", 3)
    stand.tick()
    watcher = stand.watcher()
    watcher.step()
    stand.clock.advance(2.5)
    watcher.step()
    assert written(stand.path, live_only=True) == []
    stand.clock.advance(1)
    watcher.step()
    assert written(stand.path, live_only=True)
    watcher.close()


def test_a_mode_that_hangs_is_unknown_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amberbox.monitoring.record_evaluation.LIMIT_S", 0.2)
    stand = Stand(tmp_path / "store", 4)
    plan = plan_of(component("mill", endless, variable("ros_main")))
    for _ in range(40):
        stand.tick()
    watcher = stand.watcher(plan)

    def modes() -> dict[str, Any]:
        found = values_of(written(stand.path), "amberbox/status")
        return {str(s["component"]): s for s in found if s["mode"]}

    run_until(watcher, lambda: {"mill", "base"} <= modes().keys())
    of = modes()
    assert of["mill"]["level"] == "unknown"
    assert "no answer within" in str(of["mill"]["reason"])
    assert of["base"]["level"] in ("ok", "error")
    assert of["base"]["measured_ns"] == of["mill"]["measured_ns"]


def test_there_is_one_watcher_of_a_store(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store")
    watcher = stand.watcher()
    with pytest.raises(UsageError, match="watch"):
        stand.watcher()
    watcher.close()
    stand.watcher().close()


def test_other_monitors_go_on_where_the_ones_before_were_left(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store", 5)
    stand.tick()
    watcher = stand.watcher()
    for _ in range(30):
        stand.tick()
        watcher.step()
    watcher.close()
    before = values_of(written(stand.path), "amberbox/status")
    watcher = stand.watcher(plan_of(config_hash="other"))
    for _ in range(30):
        stand.tick()
        watcher.step()
    watcher.close()
    after = values_of(written(stand.path), "amberbox/status")[len(before) :]
    assert {s["config_hash"] for s in after} == {"other"}
    last_ns, first_ns = int(str(before[-1]["measured_ns"])), int(str(after[0]["measured_ns"]))
    assert last_ns < first_ns <= last_ns + NS


def test_what_a_person_says_of_an_alarm_is_remembered(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store", 6)
    stand.tick()
    watcher = stand.watcher()
    for _ in range(15):
        watcher.measured(PROBE, {"subject": PROBE.subject, "ok": False})
        stand.tick()
        watcher.step()
    (alarm,) = [
        a for a in values_of(written(stand.path), "amberbox/alarm") if a["component"] == "laser"
    ]
    store = open_store(stand.path)
    submit(store, "alarm", {"action": "acknowledge", "id": alarm["id"], "who": "anna"})
    submit(store, "alarm", {"action": "acknowledge", "id": "no-such", "who": "anna"})
    stand.tick()
    watcher.step()
    assert pending(store) == []
    (change,) = values_of(written(stand.path, live_only=True), "amberbox/alarm")
    assert (change["id"], change["state"], change["who"]) == (alarm["id"], "acknowledged", "anna")
    kill(watcher)
    watcher = stand.watcher()
    watcher.measured(PROBE, {"subject": PROBE.subject, "ok": False})
    stand.tick()
    watcher.step()
    standing = {a.component: a for a in watcher._engine.states._alarms.active()}
    assert (standing["laser"].state, standing["laser"].who) == ("acknowledged", "anna")
    watcher.close()


def test_probe_rows_are_read_back_and_replayed(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store", 7)
    stand.tick()
    watcher = stand.watcher()
    for number in range(60):
        watcher.measured(PROBE, {"subject": PROBE.subject, "ok": number < 30, "error": ""})
        if number == 40:
            watcher.measured(PROBE, {"subject": PROBE.subject, "ok": None, "error": "no such"})
        stand.tick()
        watcher.step()
    watcher.close()
    stand.box.close()
    live = written(stand.path)
    levels = [s["level"] for s in values_of(live, "amberbox/status") if s["component"] == "laser"]
    assert {"ok", "error"} <= set(levels)
    assert live == stand.replayed()[: len(live)]


def test_a_watcher_of_nothing_waits(tmp_path: Path) -> None:
    """Nothing is recorded yet; then something is."""
    store = Stand(tmp_path / "store").watch().store
    Stand(tmp_path / "other")
    watcher = RecordWatcher(WatcherSetup(plan_of(), store))
    watcher.step()
    watcher.close()
    assert NUMBERS.keys() == {"main", "bulk", "ring"}


def test_a_memory_that_makes_no_sense_is_said_and_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand = Stand(tmp_path / "store", 8)
    stand.tick()
    watcher = stand.watcher()
    for _ in range(30):
        stand.tick()
        watcher.step()
    monkeypatch.setattr(watcher._engine, "snapshot", lambda: {"version": "of tomorrow"})
    watcher.close()
    before = values_of(written(stand.path), "amberbox/status")
    watcher = stand.watcher()
    for _ in range(30):
        stand.tick()
        watcher.step()
    watcher.close()
    after = values_of(written(stand.path), "amberbox/status")[len(before) :]
    assert int(str(after[0]["measured_ns"])) >= int(str(before[-1]["measured_ns"]))
    assert {s["level"] for s in after if s["component"] == "base"} & {"ok", "error"}
    (told,) = events(stand.path, "watch_anew")
    assert "of no use: KeyError" in told["text"]
