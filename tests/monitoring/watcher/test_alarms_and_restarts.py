"""Alarms survive restarts, other monitors and old files; nothing old is published as current."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.journal.writer import JournalOptions
from amberbox.blackbox.store.store import REQUESTS, open_store, pending, submit
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.background_sender import SenderEvent
from amberbox.monitoring.plan import ComponentPlan, MonitoringPlan
from amberbox.monitoring.watcher import RecordWatcher
from amberbox.monitoring.watcher_journal import CHANGED, retained_findings
from tests.monitoring.watcher.stand import (
    NUMBERS,
    Stand,
    component,
    kill,
    positive,
    run_until,
    values_of,
    variable,
    written,
)
from tests.support.manual_recorder import event_texts, events


def only(*parts: ComponentPlan, config_hash: str = "hash") -> MonitoringPlan:
    return MonitoringPlan("robot", config_hash, list(parts))


def base() -> ComponentPlan:
    return component("base", positive, variable("ros_main"))


def arm() -> ComponentPlan:
    return component("arm", positive, variable("ros_bulk"))


def live(stand: Stand, watcher: RecordWatcher, ticks: int, value: float) -> None:
    for _ in range(ticks):
        for topic in NUMBERS.values():
            stand.box.hear(topic, struct.pack("<d", value))
        stand.box.write(0.1)
        watcher.step()


def begun(stand: Stand, plan: MonitoringPlan, value: float = -1.0) -> RecordWatcher:
    """Watch something that has failed."""
    stand.box.write(0.1)
    watcher = stand.watcher(plan)
    live(stand, watcher, 30, 1.0)
    live(stand, watcher, 30, value)
    return watcher


def states(stand: Stand) -> dict[str, str]:
    """Return the state of each alarm by its newest record, live only or not, by component."""
    alarms = [*values_of(written(stand.path), "amberbox/alarm")]
    alarms += values_of(written(stand.path, live_only=True), "amberbox/alarm")
    newest = {str(a["component"]): a for a in sorted(alarms, key=lambda a: str(a["changed_ns"]))}
    lasting = {
        a.component: a.state for a in retained_findings(open_store(stand.path)).alarms.values()
    }
    return {name: lasting.get(name, "healed") for name in newest}


def test_an_alarm_of_a_component_that_is_gone_heals(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store")
    begun(stand, only(base(), arm())).close()
    assert states(stand) == {"base": "open", "arm": "open"}
    watcher = stand.watcher(only(base(), config_hash="other"))
    live(stand, watcher, 20, -1.0)
    watcher.close()
    assert states(stand) == {"base": "open", "arm": "healed"}
    alarms = values_of(written(stand.path, live_only=True), "amberbox/alarm")
    (healed,) = [alarm for alarm in alarms if alarm["state"] == "healed"]
    assert (healed["component"], healed["reason"]) == ("arm", CHANGED)


def test_an_alarm_that_stands_heals_under_other_monitors(tmp_path: Path) -> None:
    """It keeps its id and its annotations, and its end is recorded."""
    stand = Stand(tmp_path / "store")
    watcher = begun(stand, only(base()))
    (opened,) = values_of(written(stand.path), "amberbox/alarm")
    submit(watcher._watch.store, "alarm", _said("acknowledge", opened["id"]))
    live(stand, watcher, 5, -1.0)
    watcher.close()
    watcher = stand.watcher(only(base(), config_hash="other"))
    live(stand, watcher, 10, -1.0)
    (alarm,) = watcher._engine.states.alarms()
    assert (alarm.id, alarm.state, alarm.who) == (opened["id"], "acknowledged", "anna")
    live(stand, watcher, 30, 1.0)
    watcher.close()
    healed = values_of(written(stand.path), "amberbox/alarm")[-1]
    assert (healed["id"], healed["state"]) == (opened["id"], "healed")


def test_what_opens_in_the_silent_repeat_is_written(tmp_path: Path) -> None:
    """New monitors detect at once a fault that began before them."""
    stand = Stand(tmp_path / "store")
    begun(stand, only(base(), arm()), 1.0).close()
    strict = component("arm", lambda c, i, n: {"good": i[0].at(n) > 2}, variable("ros_bulk"))
    watcher = stand.watcher(only(base(), strict, config_hash="other"))
    live(stand, watcher, 20, 1.0)
    watcher.close()
    assert states(stand) == {"arm": "open"}


def test_a_new_file_has_the_alarms_that_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Older ones may be deleted, the watcher ended or killed: nothing is forgotten."""
    options = partial(JournalOptions, rotate_ns=2 * NS)
    monkeypatch.setattr("amberbox.blackbox.store.derived_journal.JournalOptions", options)
    stand = Stand(tmp_path / "store")
    watcher = begun(stand, only(base()))
    store = open_store(stand.path)
    live(stand, watcher, 30, -1.0)
    *old, newest = store.journal_files("watch")
    assert len(old) > 1
    for path in old:
        path.unlink()
    (before,) = retained_findings(store).alarms.values()
    assert (before.component, before.state) == ("base", "open")
    for leave in (RecordWatcher.close, kill):
        leave(watcher)
        watcher = stand.watcher(only(base()))
        live(stand, watcher, 5, -1.0)
    watcher.close()
    newest.unlink()
    assert retained_findings(store).alarms == {before.id: before}


class Ear:
    """A subscriber of the published statuses."""

    def __init__(self) -> None:
        self.heard: list[Sequence[Status]] = []

    def is_due(self) -> bool:
        return True

    def publish(self, statuses: Sequence[Status], diagnosis: Diagnosis | None = None) -> None:
        self.heard.append(statuses)

    def changed(self) -> None:
        pass

    def events(self) -> Sequence[SenderEvent]:
        return [SenderEvent("publish_connected", "publishes at ros:// /diagnostics")]

    def close(self) -> None:
        pass


def levels(stand: Stand, watcher: RecordWatcher, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    ear = Ear()
    monkeypatch.setattr(watcher, "_publisher", ear)
    watcher.step()
    return {status.level for status in ear.heard[-1]}


def test_old_statuses_are_not_published_as_current(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand = Stand(tmp_path / "store")
    watcher = begun(stand, only(base()), 1.0)
    assert levels(stand, watcher, monkeypatch) == {"ok"}
    watcher.close()
    assert event_texts(stand.path, "publish_connected") == ["publishes at ros:// /diagnostics"]
    stand.box.crash()
    stand.clock.advance(60)
    watcher = stand.watcher(only(base()))
    assert levels(stand, watcher, monkeypatch) == {"unknown"}
    watcher.close()


def _said(action: str, alarm_id: object, until_ns: Any = None) -> Mapping[str, Any]:
    return {"action": action, "id": alarm_id, "who": "anna", "until_ns": until_ns}


def test_a_request_that_cannot_be_done_is_said(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store")
    watcher = begun(stand, only(base()), 1.0)
    store = open_store(stand.path)
    submit(store, "alarm", _said("acknowledge", "no-such"))
    submit(store, "alarm", _said("shelve", "no-such", until_ns="tomorrow"))
    submit(store, "alarm", _said("shelve", "no-such", until_ns=1 << 70))
    live(stand, watcher, 5, 1.0)
    watcher.close()
    assert pending(store) == []
    assert len(list((store.path / REQUESTS).glob("*.refused"))) == 2
    refused, *broken = sorted((e["text"] for e in events(stand.path, "alarm_refused")), key=len)
    assert "there is no alarm 'no-such'" in refused
    assert all("is no time" in text for text in broken) and len(broken) == 2


def stuck(config: Any, results: Any) -> str:
    """Never return."""
    while True:
        pass


def test_an_explanation_that_hangs_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amberbox.monitoring.record_evaluation.LIMIT_S", 0.1)
    stand = Stand(tmp_path / "store")
    for _ in range(20):
        stand.box.hear(NUMBERS["main"], struct.pack("<d", -1.0))
        stand.box.write(0.1)
    watcher = stand.watcher(only(component("base", positive, variable("ros_main"), explain=stuck)))
    run_until(watcher, lambda: values_of(written(stand.path), "amberbox/status"))
    (*_, status) = values_of(written(stand.path), "amberbox/status")
    assert status["level"] == "error"
    assert "no explanation: HangError" in str(status["reason"])
