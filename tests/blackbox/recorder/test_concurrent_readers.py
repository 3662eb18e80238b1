"""Readers beside the recorder: locks, deleted files, rows lost in a power cut."""

from __future__ import annotations

import fcntl
import threading
from pathlib import Path

import numpy as np
import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store.store import Store, WriterLock, create_store
from amberbox.blackbox.store.tail import WriterTail, follow
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Cursor, Gap, WriterCursor
from tests.support.manual_recorder import COUNT, ManualBox, number


def counted(deliveries: list[Batch | Gap]) -> list[int]:
    found = [d for d in deliveries if isinstance(d, Batch)]
    return [int(n) for batch in found for n in np.asarray(batch.columns["data"])]


def test_a_reader_that_looks_at_a_lock_does_not_keep_the_recorder_out(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    (store.path / "lock.main").touch()
    with (store.path / "lock.main").open() as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        timer = threading.Timer(0.05, fcntl.flock, (reader, fcntl.LOCK_UN))
        timer.start()
        WriterLock(store, "main").release()
        timer.join()


def test_a_file_that_is_deleted_while_it_is_followed_is_a_gap(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(rotate_ns=NS))
    for n in range(40):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    files = sorted((box.store / "journal").glob("*.mcap"))
    found: list[Batch | Gap] = []
    for delivery in follow(box.store, {"ros_count"}, live=False):
        if isinstance(delivery, Batch | Gap):
            found.append(delivery)
        files[1].unlink(missing_ok=True)
    lost = [d for d in found if isinstance(d, Gap)]
    seen = counted(found)
    assert seen == sorted(set(seen))
    assert [gap.reason for gap in lost] == ["deleted or lost with its file"]
    assert seen[0] == 0
    assert seen[-1] == 39
    assert len(seen) < 40


def test_a_box_that_starts_while_a_follower_looks_is_followed_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(0))
    box.write()
    box.close()
    tail = WriterTail(create_store(box.store), "main", {"ros_count"}, WriterCursor())
    again: list[ManualBox] = []
    listed = Store.journal_files

    def starts_meanwhile(store: Store, writer: str) -> list[Path]:
        monkeypatch.undo()
        again.append(ManualBox(box.store))
        again[0].hear(COUNT, number(1))
        again[0].write()
        return listed(store, writer)

    monkeypatch.setattr(Store, "journal_files", starts_meanwhile)
    seen = [d for d in tail.step() if isinstance(d, Batch | Gap)]
    again[0].hear(COUNT, number(2))
    again[0].write()
    seen += [d for d in tail.step() if isinstance(d, Batch | Gap)]
    again[0].close()
    assert counted(seen) == [0, 1, 2]


def test_rows_that_a_power_cut_takes_after_delivery_are_named(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    for n in range(5):
        box.hear(COUNT, number(n))
        box.write()
    (path,) = (box.store / "journal").glob("*.mcap")
    whole = path.read_bytes()
    for n in range(5, 10):
        box.hear(COUNT, number(n))
        box.write()
    cursor = Cursor()
    for delivery in follow(box.store, {"ros_count"}, live=False):
        cursor = delivery.cursor
    ahead = cursor.writers["main"].seq
    box.crash()
    path.write_bytes(whole)
    again = ManualBox(box.store)
    again.hear(COUNT, number(10))
    again.write()
    again.close()
    found = [
        d
        for d in follow(box.store, {"ros_count"}, cursor, live=False)
        if isinstance(d, Batch | Gap)
    ]
    assert counted(found) == [10]
    (gap,) = (d for d in found if isinstance(d, Gap))
    assert (gap.run, gap.to_seq, gap.reason) == (1, ahead, "delivered, then lost in a power cut")
    assert gap.count == 5 + 5  # each write had its counters, too
