"""Triggers: expressions, events and silences that make incidents, once each, across restarts."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import incidents
from amberbox.blackbox.retention.incidents import IncidentMaintenance, IncidentService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions, Trigger
from amberbox.blackbox.store.derived_journal import DerivedJournal, last_progress
from amberbox.blackbox.store.incident import StoredIncident, load_all
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Batch, IntArray
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, number, own_records

T0 = 1_700_000_000
HIGH = Trigger("high", when="ros_count.data > 100 for 2s", before_s=3, after_s=1, hold_off_s=0)


def box_at(store: Path, clock: ManualClock | None = None) -> ManualBox:
    options = PipelineOptions(rotate_ns=20 * NS, ring_rotate_ns=2 * NS)
    topics = [TopicOptions("/count", keep="ring")]
    return ManualBox(store, topics, clock=clock or ManualClock(), options=options)


class Kept:
    """The keeper's handling of incidents; ``killed`` starts it again as after ``kill -9``."""

    def __init__(self, box: ManualBox, *triggers: Trigger, per_hour: int = 10) -> None:
        self.box = box
        self.options = RetentionOptions(triggers=triggers, incidents_per_hour=per_hour)
        self.begin()

    def begin(self) -> None:
        self.journal = DerivedJournal(open_store(self.box.store), "keep", clock=self.box.clock)
        self.work = IncidentMaintenance(open_store(self.box.store), self.options, self.journal)

    def step(self) -> None:
        self.work.step()

    def killed(self, *triggers: Trigger) -> None:
        self.options = RetentionOptions(triggers=triggers or self.options.triggers)
        self.begin()

    def incidents(self) -> list[StoredIncident]:
        return load_all(open_store(self.box.store))

    def fired(self) -> list[tuple[str, float]]:
        """Return what fired, and when, in seconds since the start."""
        reasons = [reason for incident in self.incidents() for reason in incident.reasons]
        return sorted((r.trigger, round(r.at_ns / NS - T0, 2)) for r in reasons)

    def events(self, kind: str) -> list[str]:
        found = own_records(self.box.store, "amberbox/event")
        return [event["text"] for event in found if event["kind"] == kind]


def hear(box: ManualBox, seconds: float, value: int) -> None:
    for _ in range(round(seconds * 10)):
        box.hear(COUNT, number(value))
        box.write()


def silent(box: ManualBox, seconds: float) -> None:
    for _ in range(round(seconds * 10)):
        box.write()


def test_an_expression_fires_at_the_datas_time(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, HIGH)
    hear(box, 5, 50)
    kept.step()
    hear(box, 1.5, 150)
    kept.step()
    assert kept.incidents() == []
    hear(box, 3, 150)
    kept.step()
    (made,) = kept.incidents()
    assert kept.fired() == [("high", 7.0)]
    assert (made.from_ns - T0 * NS, made.text) == (4 * NS, HIGH.when)
    hear(box, 5, 150)
    kept.step()
    assert kept.fired() == [("high", 7.0)]
    assert kept.incidents()[0].state == "complete"
    box.close()


def test_unknown_is_not_true(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, Trigger("odd", when="not ros_other.data > 3"))
    hear(box, 5, 1)
    kept.step()
    assert kept.incidents() == []
    box.close()


@pytest.mark.parametrize("when_killed_s", [1.0, 6.5, 8.0, 11.0])
def test_a_killed_keeper_misses_nothing_and_fires_once(
    tmp_path: Path, when_killed_s: float
) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, HIGH)
    elapsed = 0.0
    for _ in range(30):
        hear(box, 0.5, 150 if 5 <= elapsed < 9 else 50)
        elapsed += 0.5
        if elapsed == when_killed_s:
            kept.step()
            kept.killed()
    kept.step()
    kept.killed()
    kept.step()
    assert kept.fired() == [("high", 7.0)]
    box.close()


def test_progress_is_noted_with_each_firing(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, HIGH)
    store = open_store(box.store)
    hear(box, 5, 150)
    kept.step()
    progress = last_progress(store, "keep", "triggers")
    assert progress is not None
    assert progress.cursor.writers["ring"].seq > 50
    assert last_progress(store, "keep", "missions") is None
    hear(box, 5, 150)
    kept.work.close()
    later = last_progress(store, "keep", "triggers")
    assert later is not None
    assert later.cursor.writers["ring"].seq > progress.cursor.writers["ring"].seq
    box.close()


def test_silence_is_noticed_and_filtered_messages_are_no_silence(tmp_path: Path) -> None:
    box = ManualBox(
        tmp_path / "store", [TopicOptions("/count", max_frequency=0.1)],
        options=PipelineOptions(rotate_ns=20 * NS),
    )  # fmt: skip
    kept = Kept(box, Trigger("quiet", silence="ros_count", silence_s=3.0, hold_off_s=0))
    silent(box, 5)
    hear(box, 10, 1)
    kept.step()
    assert kept.fired() == []
    silent(box, 5)
    kept.step()
    ((name, at_s),) = kept.fired()
    assert name == "quiet"
    assert at_s == pytest.approx(18.0, abs=0.3)
    hear(box, 1, 1)
    silent(box, 4)
    kept.step()
    assert len(kept.fired()) == 2
    box.close()


def test_events_fire_by_kind(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, Trigger("power", event="power_*", before_s=1, after_s=1))
    hear(box, 2, 1)
    box.pipeline.event("source_ended", "over")
    box.pipeline.event("power_battery", "external power lost")
    hear(box, 1, 1)
    kept.step()
    (made,) = kept.incidents()
    assert made.text == "power_battery: external power lost"
    assert made.reasons[0].at_ns == (T0 + 2) * NS
    box.close()


@pytest.mark.parametrize("step_s", [1.5e9, -3600.0, 30.0])
def test_a_set_clock_makes_no_duration_longer(tmp_path: Path, step_s: float) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, HIGH, Trigger("quiet", silence="ros_count", silence_s=4.0))
    hear(box, 5, 50)
    hear(box, 1, 150)
    kept.step()
    box.clock.step(step_s)
    hear(box, 0.5, 150)
    kept.step()
    assert kept.fired() == []
    hear(box, 2, 150)
    kept.step()
    ((name, at_s),) = kept.fired()
    assert name == "high"
    assert at_s == pytest.approx(7 + step_s, abs=0.3)
    box.close()


def test_a_new_run_is_looked_at_anew(tmp_path: Path) -> None:
    clock = ManualClock()
    box = box_at(tmp_path / "store", clock)
    quiet = Trigger("quiet", silence="ros_count", silence_s=4.0)
    kept = Kept(box, quiet, HIGH)
    hear(box, 3, 50)
    box.crash()
    clock.advance(100)
    again = box_at(box.store, clock)
    hear(again, 3, 50)
    kept.step()
    assert kept.fired() == []
    hear(again, 3, 150)
    kept.step()
    assert kept.fired() == [("high", 108.0)]
    again.close()


def test_the_rate_is_limited_and_told_once(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, Trigger("flap", event="flap", before_s=0, after_s=0, hold_off_s=5), per_hour=6)
    for _ in range(10):
        box.pipeline.event("flap", "again")
        box.write(4.0)
        box.pipeline.event("flap", "too soon")
        box.write(2.0)
        kept.step()
    assert len(kept.fired()) == 3
    assert len(kept.events("incident_refused")) == 1
    kept.work.close()
    kept.journal.close()
    told = kept.events("incident_refused")
    assert len(told) == 2
    assert "16 times more" in told[1]
    box.close()


def test_what_keeps_a_trigger_from_working_is_told_and_others_go_on(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(
        box,
        Trigger("torn", when="ros_count.data >"),
        Trigger("text", when="ros_count.data == 'x'"),
        Trigger("never", when="ros_cuont.data > 3"),
        Trigger("alarm", when="amberbox_alarm.state == 'open'"),
        Trigger("strange", when="ros_count.dtaa > 3"),
        HIGH,
    )
    for _ in range(70):
        box.hear(COUNT, number(50))
        box.write(1.0)
    hear(box, 3, 150)
    kept.step()
    kept.step()
    kept.journal.close()
    assert [name for name, _ in kept.fired()] == ["high"]
    failed = sorted(kept.events("trigger_failed"))
    assert [text.split(":")[0] for text in failed] == [
        "the trigger strange", "the trigger text", "the trigger torn is off",
    ]  # fmt: skip
    assert "'ros_count.dtaa' has not come" in failed[0]
    assert "did you mean 'data'?" in failed[0]
    (waits,) = kept.events("trigger_waits")
    assert "ros_cuont" in waits
    assert "did you mean 'ros_count'" in waits
    box.close()


def test_a_trigger_that_raises_is_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: incidents.SilenceWatcher, batch: Batch, times_ns: IntArray) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(incidents.SilenceWatcher, "add", fail)
    box = box_at(tmp_path / "store")
    kept = Kept(box, Trigger("quiet", silence="ros_count", silence_s=1.0), HIGH)
    hear(box, 5, 150)
    kept.step()
    kept.step()
    assert [name for name, _ in kept.fired()] == ["high"]
    assert kept.events("trigger_failed") == [
        "the trigger quiet is off: ZeroDivisionError: a defect"
    ]
    box.close()


def test_without_triggers_nothing_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the record was read")

    monkeypatch.setattr("amberbox.blackbox.retention.live_reader.WriterTail.step", refuse)
    box = box_at(tmp_path / "store")
    kept = Kept(box)
    hear(box, 1, 1)
    kept.step()
    kept.work.close()
    assert not (box.store / "keep").exists()
    box.close()


def test_a_firing_that_a_disk_refused_is_not_forgotten_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, HIGH)
    hear(box, 2, 1)
    kept.step()
    hear(box, 5, 200)
    with monkeypatch.context() as patched:
        patched.setattr(IncidentService, "fire", _full)
        kept.step()
        kept.work.close()
    kept.killed()
    kept.step()
    assert kept.fired() == [("high", 4.0)]
    box.close()


def _full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_window_that_is_gone_stops_no_trigger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = box_at(tmp_path / "store")
    kept = Kept(box, HIGH)
    hear(box, 5, 200)

    def gone(*_: object) -> None:
        raise UsageError("nothing has been recorded")

    with monkeypatch.context() as patched:
        patched.setattr(IncidentService, "fire", gone)
        kept.step()
    kept.step()
    assert kept.fired() == []
    assert "nothing has been recorded" in kept.events("incident_refused")[0]
    box.close()
