"""A bounded disk in practice: weeks offline, a fast recorder beside the keeper, a full store."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.query import record
from amberbox.blackbox.recorder.disk_room import DiskRoom
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import maintenance as module
from amberbox.blackbox.retention import usage
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.pins import PinRequest, advance, pin
from amberbox.blackbox.retention.usage import DiskUse
from amberbox.blackbox.robot_folder.robot_yaml import Lifetime, RetentionOptions
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import store as store_store
from amberbox.blackbox.store.incident import StoredIncident, load, save
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import WriterLock, open_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Gap, Schema, Topic
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, events, number

BLOB = Topic("/blob", "ros1", Schema("test/Blob", "ros1msg", b"uint8[] data\n"))
DAY_S = 86_400.0
OPTIONS = RetentionOptions(quota=1_500_000, min_free=0, headroom=50_000)
needs_pyarrow = pytest.mark.skipif(not can_build(), reason="segments are Parquet files")


def blob(size: int, source: random.Random = random.Random(7)) -> bytes:  # noqa: B008  # one stream
    return size.to_bytes(4, "little") + source.randbytes(size)


def box_at(path: Path, rotate_bytes: int = 15_000, room: DiskRoom | None = None) -> ManualBox:
    options = PipelineOptions(rotate_bytes=rotate_bytes, rotate_ns=600 * NS)
    return ManualBox(path, options=options, room=room)


def keep(box: ManualBox, options: RetentionOptions = OPTIONS) -> None:
    keeper = RetentionService(open_store(box.store), options, clock=box.clock)
    keeper.step(threading.Event())
    keeper.close()


def rows(path: Path) -> list[int]:
    values = amberbox.open(path).query("ros_count", ["data"]).columns["data"]
    return list(np.asarray(values).tolist())


@needs_pyarrow
def test_weeks_offline_leave_the_newest_day_all_incidents_and_all_events(tmp_path: Path) -> None:
    path, clock = tmp_path / "store", ManualClock()
    box = ManualBox(path, clock=clock)
    store, keeper = open_store(path), RetentionService(open_store(path), OPTIONS, clock=clock)
    written: dict[int, int] = {}
    pinned: set[int] = set()
    for step in range(14 * 4):  # every six hours the robot is on for a while
        box.hear(COUNT, number(step))
        box.hear(BLOB, blob(16_000))
        written[step] = clock.wall_ns()
        if step % 4 == 0:
            box.pipeline.event("mark", f"day {step // 4}")
        box.write()
        if step == 10:
            found = pin(store, PinRequest(1.0, 0.0, "looked odd"), OPTIONS)
            assert isinstance(found, StoredIncident)
            pinned = {v for v, at_ns in written.items() if found.from_ns <= at_ns < found.to_ns}
        box.close()
        keeper.step(threading.Event())
        assert DiskUse(path).measure() <= 1_500_000
        clock.advance(DAY_S / 4)
        box = ManualBox(path, clock=clock)
    keeper.close()
    box.close()
    answer = set(rows(path))
    assert pinned == {10}
    assert pinned <= answer
    assert {v for v, at_ns in written.items() if written[55] - at_ns < DAY_S * NS} <= answer
    assert len(answer) < len(written), "the quota is too small for all of it"
    marks = [e["text"] for e in amberbox.open(path).events().rows() if e["kind"] == "mark"]
    assert marks == [f"day {day}" for day in range(14)]
    assert events(path, "deleted")


@pytest.mark.parametrize("stopped", [False, True], ids=["keeper runs", "keeper is stopped"])
def test_a_fast_recorder_never_takes_more_than_the_quota_and_a_segment(
    tmp_path: Path, stopped: bool
) -> None:
    rotate_bytes, quota = 1_000_000, 8_000_000
    options = RetentionOptions(quota=quota, min_free=0, keep_min_s=0.0, headroom=rotate_bytes)
    box = box_at(tmp_path / "store", rotate_bytes, DiskRoom(tmp_path / "store", 0))
    over = threading.Event()
    with keeper_process(box.store, options) as keeper:
        if stopped:
            keeper.send_signal(signal.SIGSTOP)
        writer = threading.Thread(target=record_fast, args=(box, 11_000_000, over))
        writer.start()
        most, use = 0, DiskUse(box.store)
        while not over.wait(0.01):
            most = max(most, use.measure())
        writer.join()
    box.close()
    assert quota / 2 < most <= quota + rotate_bytes
    assert events(box.store, "events_only") if stopped else mf.read(box.store).tombstones
    assert len(amberbox.open(box.store).query("ros_count")) > 0


@contextmanager
def keeper_process(path: Path, options: RetentionOptions) -> Iterator[subprocess.Popen[bytes]]:
    """Run a real keeper on a store, from its first statement of the room that is left."""
    command = [sys.executable, "-m", "amberbox.blackbox.keeper", str(path)]
    keeper = subprocess.Popen([*command, "--options", options.to_json()])
    try:
        while usage.read_statement(path / usage.ALLOWANCE_FILE) is None:
            assert keeper.poll() is None
            time.sleep(0.01)
        yield keeper
    finally:
        keeper.kill()
        keeper.wait()


def record_fast(box: ManualBox, size: int, over: threading.Event) -> None:
    """Write some MB a second, as messages that do not compress."""
    written, value = 0, 0
    while written < size and not over.is_set():
        for _ in range(3):
            box.hear(BLOB, blob(20_000))
        box.hear(COUNT, number(value))
        value, written = value + 1, written + 60_000
        box.write(0.02)
        time.sleep(0.015)
    over.set()


def full_box(path: Path, journals: int) -> ManualBox:
    box = box_at(path)
    for value in range(journals):
        box.hear(COUNT, number(value))
        box.hear(BLOB, blob(16_000))
        box.write(60.0)
    return box


@needs_pyarrow
@pytest.mark.parametrize("with_columns", [True, False])
def test_raw_and_columns_live_as_long_as_they_may(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_columns: bool
) -> None:
    if not with_columns:
        monkeypatch.setattr(module, "can_build", lambda: False)
    box = full_box(tmp_path / "store", 30)
    lifetime = Lifetime(raw_s=300.0, columns_s=900.0)
    keep(box, replace(OPTIONS, quota=50_000_000, lifetime=lifetime))
    left = open_store(box.store).journal_files("main")
    assert 5 <= len(left) <= 8
    assert (12 <= len(rows(box.store)) <= 18) is with_columns
    followed = [
        value
        for delivery in follow(box.store, ["ros_count"], live=False)
        if isinstance(delivery, Batch)
        for value in np.asarray(delivery.columns["data"]).tolist()
    ]
    assert followed == rows(box.store)
    box.close()


def test_events_outlive_their_journal_without_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "can_build", lambda: False)
    monkeypatch.setattr(record, "can_build", lambda: False)
    box = box_at(tmp_path / "store")
    for value in range(30):
        box.pipeline.event("mark", f"{value}")
        box.hear(BLOB, blob(16_000))
        box.write(60.0)
    before = [e for e in amberbox.open(box.store).events().rows() if e["kind"] == "mark"]
    keep(box, replace(OPTIONS, quota=300_000, keep_min_s=0.0))
    assert len(open_store(box.store).journal_files("main")) < 15
    after = [e for e in amberbox.open(box.store).events().rows() if e["kind"] == "mark"]
    assert [(e["timestamp"], e["text"]) for e in after] == [
        (e["timestamp"], e["text"]) for e in before
    ]
    (gap,) = [g for g in amberbox.open(box.store).gaps() if g.reason.startswith("deleted")]
    assert gap.reason == "deleted: for room"
    box.close()


def test_a_store_that_may_not_delete_says_that_it_is_full_until_a_server_has_it(
    tmp_path: Path,
) -> None:
    box = full_box(tmp_path / "store", 30)
    store = open_store(box.store)
    stops = replace(OPTIONS, quota=300_000, when_full="stop")
    keep(box, stops)
    assert "when_full" in (box.store / "full").read_text()
    assert events(box.store, "store_full")
    assert not mf.read(box.store).tombstones
    journals = [f"journal/{path.name}" for path in store.journal_files("main")[:-1]]
    lock = WriterLock(store, "keeper")
    mf.confirm(store, journals, "https://server")
    assert store_store.pending(store), "the keeper that is at work is asked"
    lock.release()
    keep(box, stops)
    assert not store_store.pending(store)
    assert mf.read(box.store).tombstones
    assert all(stone.confirmed for stone in mf.read(box.store).tombstones)
    box.close()


def test_confirmed_incidents_go_last(tmp_path: Path) -> None:
    box = full_box(tmp_path / "store", 20)
    store = open_store(box.store)
    found = pin(store, PinRequest(3600.0, 0.0, "all of it"), replace(OPTIONS, quota=None))
    assert isinstance(found, StoredIncident)
    done = advance(store, found)
    tight = replace(OPTIONS, quota=300_000, keep_min_s=0.0)
    keep(box, tight)
    assert not mf.read(box.store).tombstones
    save(store, replace(load(store, done.id), confirmed=True))
    keep(box, tight)
    assert mf.read(box.store).tombstones
    assert load(store, done.id).state == "released"
    assert events(box.store, "incident_released")
    box.close()


@needs_pyarrow
def test_follow_says_that_columns_need_pyarrow_where_the_journal_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = full_box(tmp_path / "store", 6)
    box.close()
    keep(box, replace(OPTIONS, quota=50_000_000))
    for _ in range(2):
        keep(box, replace(OPTIONS, quota=50_000_000, lifetime=Lifetime(raw_s=1e-6)))
    stones = [s for s in mf.read(box.store).tombstones if s.what == "raw"]
    assert stones
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    gaps = [d for d in follow(box.store, ["ros_count"], live=False) if isinstance(d, Gap)]
    for stone in stones:
        assert any(
            "needs pyarrow" in gap.reason and gap.from_seq == stone.first_seq for gap in gaps
        )
