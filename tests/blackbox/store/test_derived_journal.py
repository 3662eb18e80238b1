"""A journal of conclusions: rows of items beside records, without waiting for the disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.journal.writer import SyncMark
from amberbox.blackbox.signing.signatures import finished_files
from amberbox.blackbox.store.derived_journal import (
    SYNC_S,
    DerivedJournal,
    EncodedRecord,
    ItemMessage,
    ReaderProgress,
    SyncThread,
    event,
    last_progress,
)
from amberbox.blackbox.store.journal_reader import journals, run_messages
from amberbox.blackbox.store.store import WriterLock, create_store
from amberbox.blackbox.store.tail import WriterTail, follow
from amberbox.core.clock import NS, RunClock
from amberbox.core.types import Batch, Cursor, WriterCursor
from amberbox.testing.clock import ManualClock, wait_until


def rows_of(store: Path, item: str) -> list[dict[str, Any]]:
    """Return the rows of an item, as followers see them."""
    return [
        {"at": int(batch.log_time_ns[row]), **{n: c[row] for n, c in batch.columns.items()}}
        for batch in follow(store, [item], live=False, writers=("watch",))
        if isinstance(batch, Batch)
        for row in range(len(batch))
    ]


def test_rows_of_items_stand_beside_records(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    clock = ManualClock()
    journal = DerivedJournal(store, "watch", clock=clock)
    event = b'{"kind":"k","text":"t","source":"","details":"{}"}'
    journal.append(
        [
            EncodedRecord("amberbox/event", event),
            ItemMessage("probe/a", "probe_a", "probe", {"ok": True}),
        ]
    )
    clock.advance(1)
    row = ItemMessage("probe/a", "probe_a", "probe", {"ok": None, "error": "gone"})
    journal.append([row], [ReaderProgress(Cursor(store.id), "me", "1")], urgent=True)
    journal.close()
    rows = rows_of(store.path, "probe_a")
    assert [bool(rows[0]["ok"]), rows[1]["error"]] == [True, "gone"]
    assert rows[1]["at"] - rows[0]["at"] == NS
    assert [event["kind"] for event in rows_of(store.path, "amberbox_event")] == ["k"]
    assert last_progress(store, "watch", "me") == ReaderProgress(Cursor(store.id), "me", "1")


def test_a_run_begins_on_another_axis(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    clock = ManualClock()
    journal = DerivedJournal(store, "watch", clock=clock)
    row = ItemMessage("probe/a", "probe_a", "probe", {"ok": True})
    journal.append([row])
    other = ManualClock(wall=5 * NS)
    journal.begin_run(RunClock(other), "main 7/1")
    journal.append([row])
    journal.close()
    first, second = journals(store.path)
    assert (run_messages(first)["input"], run_messages(second)["input"]) == ("", "main 7/1")
    assert [row["at"] for row in rows_of(store.path, "probe_a")] == [clock.wall, 5 * NS]


class Disk:
    """A disk that counts its flushes."""

    def __init__(self) -> None:
        self.flushed = 0
        self.refuses = False

    def mark(self) -> SyncMark:
        return SyncMark([], [], 0, self._done)

    def _done(self, _: int) -> None:
        if self.refuses:
            raise OSError("worn out")
        self.flushed += 1


def test_the_disk_is_asked_once_a_second_or_at_once() -> None:
    now_s, disk = 100.0, Disk()
    sync = SyncThread(lambda: now_s)
    for seconds, urgent, flushed in (
        (0.0, False, 1), (0.5, False, 1), (0.1, True, 2), (0.5, False, 2), (SYNC_S, False, 3),
    ):  # fmt: skip
        now_s += seconds
        sync.flush_if_due(disk.mark, urgent=urgent)
        sync.finish()
        assert disk.flushed == flushed


def test_what_the_disk_refuses_is_said_at_the_next_write() -> None:
    disk = Disk()
    sync = SyncThread()
    disk.refuses = True
    sync.flush_if_due(disk.mark, urgent=True)
    sync.finish()
    with pytest.raises(OSError, match="worn out"):
        sync.flush_if_due(disk.mark, urgent=True)


def test_a_journal_that_is_idle_is_durable_published_and_sealed(tmp_path: Path) -> None:
    """Its writer appends nothing more, but lives on."""
    store, clock = create_store(tmp_path / "store"), ManualClock()
    lock = WriterLock(store, "act")
    journal = DerivedJournal(store, "act", clock=clock)

    def is_durable() -> bool:
        journal.keep_up()
        head = read_head(store.folder("act"))
        return head is not None and head.durable_seq == head.next_seq

    journal.keep_up()  # nothing was written yet
    record = EncodedRecord("amberbox/command", b"{}")
    for _ in range(3):  # the later ones come while the first is being flushed
        journal.append([record], urgent=True)
    wait_until(is_durable)
    assert not list(finished_files(store, {}))
    clock.advance(599)
    journal.keep_up()
    assert not list(finished_files(store, {}))
    clock.advance(1)
    journal.keep_up()
    [path] = finished_files(store, {})
    before = path.stat().st_size
    journal.append([record])
    assert path.stat().st_size == before and list(finished_files(store, {})) == [path]
    assert len(store.journal_files("act")) == 2
    journal.close()
    lock.release()


@pytest.mark.parametrize(("writer", "lock"), [("keep", "keeper"), ("watch", "watch")])
def test_a_follower_gets_what_is_written_after_it_has_read(
    tmp_path: Path, writer: str, lock: str
) -> None:
    store = create_store(tmp_path / "store")
    held, journal = WriterLock(store, lock), DerivedJournal(store, writer)
    tail = WriterTail(store, writer, None, WriterCursor(0, 0))
    for kind in ("first", "second", "third"):
        journal.write([event(kind, "text")])
        found = [one for one in tail.step() if isinstance(one, Batch)]
        columns = [batch.columns["kind"] for batch in found if "kind" in batch.columns]
        assert [kind for column in columns for kind in plain(column)] == [kind]
    journal.close()
    held.release()
