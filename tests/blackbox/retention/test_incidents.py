"""Incidents: pinned windows, joined and limited, seen through by the keeper, released."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.query.record import windows_of
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import pins
from amberbox.blackbox.retention.incidents import IncidentMaintenance
from amberbox.blackbox.retention.pins import (
    PinRefusal,
    PinRequest,
    advance,
    held_bytes,
    held_files,
    look_back,
    pin,
    pinned_journals,
    release,
)
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.signatures import Signer
from amberbox.blackbox.store import incident as incident_file
from amberbox.blackbox.store import store as store_store
from amberbox.blackbox.store.derived_journal import DerivedJournal
from amberbox.blackbox.store.incident import StoredIncident, load, load_all
from amberbox.blackbox.store.journal_reader import Extent, extent, journal_file
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, number, own_records

T0 = 1_700_000_000
OTHER = Topic("/other", COUNT.message_encoding, COUNT.schema)
OPTIONS = RetentionOptions()


def box_at(store: Path, clock: ManualClock | None = None) -> ManualBox:
    options = PipelineOptions(rotate_ns=10 * NS, ring_rotate_ns=2 * NS, boot_id="00000000-b")
    topics = [TopicOptions("/count", keep="ring")]
    return ManualBox(store, topics, clock=clock or ManualClock(), options=options)


def pass_time(box: ManualBox, seconds: float, first: int = 0) -> None:
    for n in range(first, first + round(seconds * 10)):
        box.hear(COUNT, number(n))
        box.hear(OTHER, number(n))
        box.write()


def pinned(store: Store, wish: PinRequest, options: RetentionOptions = OPTIONS) -> StoredIncident:
    made = pin(store, wish, options)
    assert isinstance(made, StoredIncident)
    return made


def ring_of(store: Store, incident: StoredIncident) -> set[str]:
    return {path.name[-9:-5] for path in (store.path / "incidents" / incident.id).glob("ring/*")}


def forget_ring(store: Store) -> None:
    for path in (store.path / "ring").glob("*.mcap"):
        path.unlink()


def seconds(incident: StoredIncident) -> tuple[float, float]:
    return round(incident.from_ns / NS - T0, 1), round(incident.to_ns / NS - T0, 1)


def test_a_window_is_pinned_and_completed(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 20)
    made = pinned(store, PinRequest(5, 3, "bump", "me"))
    assert (made.state, seconds(made)) == ("open", (15, 23))
    assert ring_of(store, made) == {"0007", "0008", "0009", "0010"}
    pass_time(box, 2)
    assert advance(store, made).state == "open"
    pass_time(box, 8)
    done = advance(store, made)
    assert (done.state, seconds(done)) == ("complete", (15, 23))
    assert ring_of(store, made) == {"0007", "0008", "0009", "0010", "0011", "0012"}
    assert load_all(store) == [done]
    box.close()


def test_what_the_window_holds_is_found_after_the_ring_moved_on(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 20)
    made = pinned(store, PinRequest(5, 2))
    pass_time(box, 20, 200)
    done = advance(store, made)
    box.close()
    forget_ring(store)
    record = amberbox.open(box.store)
    (span,) = windows_of(record.path, done)
    rows = record.query("ros_count", ["data"], *span).values("data")
    assert rows == list(range(150, 221))
    assert record.query("ros_other", ["data"], *span).values("data") == rows
    release(store, done)
    assert "ros_count" not in {item.name for item in record.items()}
    assert load(store, done.id).state == "released"
    assert not load(store, done.id).holds(1, 0, 1 << 62)


def test_rows_of_a_released_incident_are_a_gap(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 4)
    made = pinned(store, PinRequest(5, 0))
    pass_time(box, 8, 40)
    gone = sorted((store.path / "ring").glob("*.mcap"))[:2]
    count = sum(journal_file(path).rows for path in gone)
    for path in gone:
        path.unlink()
    box.close()
    record = amberbox.open(box.store)
    assert record.gaps() == []
    release(store, made)
    (gap,) = record.gaps()
    assert (gap.writer, gap.count) == ("ring", count)
    assert "deleted" in gap.reason


def test_without_a_recorder_what_is_there_is_complete(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    pass_time(box, 10)
    box.crash()
    made = pinned(open_store(box.store), PinRequest(5, 20))
    assert (made.state, seconds(made)) == ("complete", (5, 10))


def test_an_open_incident_is_complete_when_recording_has_stopped(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 10)
    made = pinned(store, PinRequest(5, 20))
    pass_time(box, 3)
    box.close()
    done = advance(store, made)
    assert (done.state, seconds(done)) == ("complete", (5, 13))


def test_an_empty_record_has_nothing_to_pin(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    with pytest.raises(UsageError, match="nothing has been recorded"):
        pin(open_store(box.store), PinRequest(5, 5), OPTIONS)
    box.close()


@pytest.mark.parametrize("step_s", [1.8e9 - T0, -3600.0, -2e8, 5.0])
def test_durations_are_right_across_steps_of_the_clock(tmp_path: Path, step_s: float) -> None:
    clock = ManualClock()
    box = box_at(tmp_path / "store", clock)
    store = open_store(box.store)
    pass_time(box, 30)
    clock.step(step_s)
    pass_time(box, 4, 300)
    made = pinned(store, PinRequest(10, 2))
    timeline = look_back(store, 30 * NS)
    assert timeline is not None
    assert timeline.age_ns(made.since) == 0
    spans = [(span.to_ns - span.from_ns) / NS for span in made.spans]
    assert sum(spans) == pytest.approx(10, abs=2.5)
    pass_time(box, 4, 340)
    done = advance(store, made)
    assert done.state == "complete"
    box.close()
    held = {path.name for path in (store.path / "incidents" / made.id / "ring").glob("*")}
    forget_ring(store)
    rows = amberbox.open(box.store).query("ros_count", ["data"]).values("data")
    assert set(range(241, 360)) <= set(rows), held
    assert min(rows) >= 200


def test_a_window_reaches_over_a_restart(tmp_path: Path) -> None:
    clock = ManualClock()
    box = box_at(tmp_path / "store", clock)
    pass_time(box, 10)
    box.crash()
    clock.advance(4)
    again = box_at(box.store, clock)
    pass_time(again, 5, 100)
    made = pinned(open_store(box.store), PinRequest(12, 1))
    assert [span.run for span in made.spans] == [1, 2]
    assert made.spans[0].from_ns / NS - T0 == pytest.approx(7, abs=0.2)
    again.close()


def test_overlapping_windows_are_one_incident(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 20)
    first = pinned(store, PinRequest(5, 5, "one", "a"))
    pass_time(box, 3)
    both = pinned(store, PinRequest(15, 5, "two", "b"))
    assert both.id == first.id
    assert [reason.text for reason in both.reasons] == ["one", "two"]
    assert (both.who, seconds(both)) == ("a, b", (8, 28))
    assert len(load_all(store)) == 1
    pass_time(box, 6)
    assert advance(store, both).state == "complete"
    apart = pinned(store, PinRequest(1, 1, "three"))
    assert apart.id != first.id
    box.close()


def test_the_same_trigger_goes_on_in_its_incident(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 20)
    first = pinned(store, PinRequest(2, 1, trigger="low"))
    pass_time(box, 5)
    advance(store, first)
    assert pinned(store, PinRequest(6, 1, trigger="low")).id == first.id
    assert load(store, first.id).state == "open"
    box.close()


def test_a_firing_counts_once(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 5)
    ids = {pinned(store, PinRequest(2, 1, trigger="low", key="low@1:5")).id for _ in range(3)}
    assert len(ids) == 1
    assert len(load_all(store)[0].reasons) == 1
    box.close()


def test_incidents_hold_no_more_than_their_share(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 15)
    first = pinned(store, PinRequest(2, 1))
    held = held_bytes(store, [first])
    pass_time(box, 30)
    advance(store, first)
    options = RetentionOptions(quota=3 * held, incident_share=0.5)
    refused = pin(store, PinRequest(20, 1), options)
    assert isinstance(refused, PinRefusal)
    assert "allowed" in refused.reason
    assert len(load_all(store)) == 1
    box.close()


def test_links_count_once_and_the_journals_are_named(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 15)
    first = pinned(store, PinRequest(2, 0))
    second = pinned(store, PinRequest(2, 0))
    assert first.id != second.id
    assert held_bytes(store, [first, second]) == held_bytes(store, [first])
    names = {name.split("-")[0] + name[-10:-5] for name in pinned_journals(store)}
    assert names == {"journal/000001-0001", "ring/000001-0006", "ring/000001-0007"}
    box.close()


def test_a_ring_elsewhere_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 5)
    made = pinned(store, PinRequest(2, 1))
    pass_time(box, 5, 50)
    advance(store, made)
    box.close()
    forget_ring(store)
    rows = amberbox.open(box.store).query("ros_count", ["data"]).values("data")
    assert set(range(30, 60)) <= set(rows)
    assert not list(store.path.glob("incidents/*/ring/*.part"))


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 5)
    left = store.path / "incidents" / ".2018-12-10-101512-abcd" / "ring"
    left.mkdir(parents=True)
    made = pinned(store, PinRequest(2, 0))
    assert [path.name for path in (store.path / "incidents").iterdir()] == [made.id]
    box.close()


def keeping(
    box: ManualBox, options: RetentionOptions = OPTIONS
) -> tuple[IncidentMaintenance, DerivedJournal]:
    store = open_store(box.store)
    journal = DerivedJournal(store, "keep", clock=box.clock)
    return IncidentMaintenance(store, options, journal), journal


def test_the_keeper_tells_of_each_state_once(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 10)
    made = pinned(store, PinRequest(5, 2, "bump", "me"))
    keeper, journal = keeping(box)
    for _ in range(3):
        keeper.step()
        pass_time(box, 2)
    again, second = keeping(box)
    again.step()
    release(store, made)
    again.step()
    journal.close()
    second.close()
    records = own_records(box.store, "amberbox/incident")
    assert [record["state"] for record in records] == ["open", "complete", "released"]
    assert {record["reason"] for record in records} == {"bump"}
    manifest = (store.path / "manifest").read_text()
    assert manifest.count('"kind":"incident"') == 3
    box.close()


def test_a_request_becomes_an_incident_at_its_time(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 10)
    values = {"before_s": 3, "after_s": 1, "reason": "power", "trigger": "power", "who": "box"}
    store_store.submit(store, "incident", values)
    store_store.submit(store, "incident", {"before_s": "long", "reason": "nonsense"})
    store_store.submit(store, "mission", {})
    keeper, journal = keeping(box)
    keeper.step()
    journal.close()
    (made,) = load_all(store)
    assert (made.text, made.who, made.trigger) == ("power", "box", "power")
    assert made.to_ns - made.from_ns == pytest.approx(4 * NS, abs=0.1 * NS)
    assert [request.kind for request in store_store.pending(store)] == ["mission"]
    refused = own_records(box.store, "amberbox/event")[-1]
    assert refused["kind"] == "incident_refused"
    box.close()


def test_a_file_that_cannot_be_read_is_told_of_and_stops_nothing(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 5)
    made = pinned(store, PinRequest(2, 0))
    other = store.path / "incidents" / "other"
    other.mkdir()
    (other / incident_file.FILE).write_text("{")
    keeper, journal = keeping(box)
    keeper.step()
    keeper.step()
    journal.close()
    assert [incident.id for incident in load_all(store)] == [made.id]
    kinds = [record["kind"] for record in own_records(box.store, "amberbox/event")]
    assert kinds.count("incident_unreadable") == 1
    box.close()


def test_a_damaged_file_holds_what_the_manifest_says_of_it(tmp_path: Path) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 5)
    made = pinned(store, PinRequest(2, 3, "bump", "me", key="k"))
    keeper, journal = keeping(box)
    keeper.step()
    (store.path / "incidents" / made.id / incident_file.FILE).write_text("{")
    (known,) = load_all(store)
    assert known.state == "open" and known.reasons == made.reasons
    assert (known.spans, known.since, known.after_ns) == (made.spans, made.since, made.after_ns)
    pass_time(box, 5, 50)
    keeper.step()
    journal.close()
    assert [incident.state for incident in load_all(store)] == ["complete"]
    assert not incident_file.damaged_files(store)
    box.close()


@pytest.mark.parametrize("before", [float("inf"), float("nan"), -1.0])
def test_a_request_for_no_window_is_refused_and_stops_nothing(
    tmp_path: Path, before: float
) -> None:
    box = box_at(tmp_path / "store")
    store = open_store(box.store)
    pass_time(box, 2)
    store_store.submit(store, "incident", {"before_s": before, "reason": "odd"})
    keeper, journal = keeping(box)
    keeper.step()
    journal.close()
    kinds = [record["kind"] for record in own_records(box.store, "amberbox/event")]
    assert kinds.count("incident_refused") == 1
    assert store_store.pending(store) == [] and load_all(store) == []
    with pytest.raises(UsageError, match="shorter than nothing"):
        amberbox.mark(store.path, before_s=before)
    box.close()


def test_few_of_many_journals_are_opened_to_pin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = box_at(tmp_path / "store")
    pass_time(box, 60)
    box.close()
    store = open_store(box.store)
    Signer(store).close()
    looked: list[Path] = []

    def look(path: Path) -> Extent | None:
        looked.append(path)
        return extent(path)

    monkeypatch.setattr(pins, "extent", look)
    made = pinned(store, PinRequest(5, 0))
    held = {path for path in held_files(store, [made]) if path.parent.name == "journal"}
    journals = {path for path in looked if path.parent.name == "journal"}
    assert held and held <= journals and len(journals) <= len(held) + 1 < 5
