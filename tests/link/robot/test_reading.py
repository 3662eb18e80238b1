"""The link's reader of a store: unchanged rows, ends of journals, latest values."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from amberbox.blackbox.journal import channels
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.derived_journal import EncodedRecord
from amberbox.blackbox.store.store import Store, WriterLock, create_store, is_locked, open_store
from amberbox.link import record_reader
from amberbox.link.client import (
    POSITIONS_FILE,
    AcknowledgedPositions,
    load_acknowledged,
    save_acknowledged,
)
from amberbox.link.frames import JournalPosition
from amberbox.link.record_reader import LinkEvents, LiveValues, RawRowTail, ReachReader
from amberbox.testing.clock import wait_until
from amberbox.testing.records import BATTERY, POSE, T0_NS, FakeRun, pose_rows
from tests.link.robot.rig import Watcher, recorded
from tests.support.manual_recorder import events


def test_rows_come_byte_for_byte_from_any_place_on(tmp_path: Path) -> None:
    watcher = Watcher(tmp_path)
    for _ in range(5):
        watcher.write(7, 2)
    wanted = recorded(tmp_path)
    tail = RawRowTail(watcher.store, "watch", JournalPosition())
    rows = [row for _ in range(8) for row in tail.pull(10)]
    found = {
        (watcher.store.id, row.writer, row.run, row.seq): (row.channel, row.log_ns, row.data)
        for row in rows
    }
    assert found == wanted and len(rows) == 45
    middle = rows[20].place
    assert [row.place for row in RawRowTail(watcher.store, "watch", middle).pull(1000)] == [
        row.place for row in rows[20:]
    ]
    watcher.close()


def test_only_what_was_synced_is_durable_until_the_run_is_over(tmp_path: Path) -> None:
    watcher = Watcher(tmp_path)
    watcher.write(3)
    reaches = ReachReader(watcher.store)
    synced = reaches.of("watch")
    assert synced.durable == synced.end
    watcher.write(4, sync=False)
    now = reaches.of("watch")
    assert now.durable == synced.durable < now.end and not now.runs[-1].closed
    watcher.lock.release()
    over = reaches.of("watch")
    assert over.end == over.durable == now.end and over.runs[-1].closed
    again = Watcher(tmp_path)
    again.write(1)
    both = reaches.of("watch")
    assert [run.closed for run in both.runs] == [True, False]
    assert both.durable.run > over.end.run and not both.problem()
    again.close()


def test_what_can_be_read_is_within_the_end_though_the_head_does_not_tell_yet(
    tmp_path: Path,
) -> None:
    watcher = Watcher(tmp_path)
    watcher.write(3)
    before = ReachReader(watcher.store).of("watch")
    watcher.journal._write(
        [EncodedRecord(channels.EVENT, b"{}")]
    )  # it waits for its disk, or is killed
    rows = RawRowTail(watcher.store, "watch", JournalPosition()).pull(100)
    reach = ReachReader(watcher.store).of("watch")
    assert before.end <= rows[-1].place < reach.end
    assert reach.durable == before.durable and not reach.runs[-1].closed
    watcher.lock.release()
    again = WriterLock(watcher.store, "watch")  # the next one, before its first row
    assert ReachReader(watcher.store).of("watch").end == reach.end
    again.release()


def test_a_run_that_begins_while_it_is_looked_for_is_not_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Watcher(tmp_path).close()
    begun: list[Watcher] = []

    def look(store: Store, writer: str) -> bool:
        found = is_locked(store, writer)
        if not begun:
            begun.append(Watcher(tmp_path))
            begun[0].write(1)
        return found

    monkeypatch.setattr(record_reader, "is_locked", look)
    reaches = ReachReader(open_store(tmp_path))
    assert not reaches.of("watch").runs[-1].closed
    begun[0].write(5)
    end = reaches.of("watch").end
    begun[0].lock.release()
    over = reaches.of("watch")
    assert over.end == end and over.runs[-1].closed
    begun[0].journal.close()


def test_the_newest_value_of_each_watched_variable(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    run.write(pose_rows(0, 200))
    live = LiveValues(create_store(tmp_path))
    live.watch([f"{POSE.name}.pose_x", f"{BATTERY.name}.volts", "nothing.here", "no address"])
    found: dict[str, tuple[int, float | str | None]] = {}

    def has_both() -> bool:
        found.update(live.take())
        return len(found) == 2

    wait_until(has_both, "both values")
    live.close()
    run.close()
    assert found[f"{POSE.name}.pose_x"] == (T0_NS + 1990 * 1_000_000, 199.0)
    assert found[f"{BATTERY.name}.volts"][1] == 24.0 - 1.9


def test_what_is_remembered_belongs_to_its_store(tmp_path: Path) -> None:
    one, two = create_store(tmp_path / "one"), create_store(tmp_path / "two")
    what = AcknowledgedPositions("https://fleet", {"watch": JournalPosition(3, 7)}, 4, 99)
    save_acknowledged(one, what)
    assert load_acknowledged(one) == what
    (two.path / POSITIONS_FILE).write_text((one.path / POSITIONS_FILE).read_text())
    assert load_acknowledged(two) is None
    (one.path / POSITIONS_FILE).write_text("{")
    assert load_acknowledged(one) is None


def test_an_event_of_the_link_is_recorded_once(tmp_path: Path) -> None:
    store = create_store(tmp_path)
    link_events = LinkEvents(store)
    for _ in range(3):
        link_events.emit("clock_not_set", "the clock was not set")
    keeper = RetentionService(store, RetentionOptions(quota_percent=100.0, min_free=0))
    keeper.step(threading.Event())
    keeper.close()
    [told] = events(tmp_path, "clock_not_set")
    assert told["source"] == "link" and told["text"] == "the clock was not set"
    assert not list((tmp_path / "requests").glob("*.json"))
    json.dumps(told)
