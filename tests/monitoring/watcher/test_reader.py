"""The reader: all items in parallel, bounded memory, complete up to its stated time."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.store import tail
from amberbox.blackbox.store.store import open_store
from amberbox.core.types import Batch
from amberbox.monitoring.record_reader import RecordBlock, RecordedItemsReader
from tests.monitoring.watcher.stand import Stand

ITEMS = ("ros_main", "ros_bulk", "ros_ring")
LATE = ("ros_late", "ros_late_bulk")


def lived(stand: Stand, ticks: int) -> Stand:
    for _ in range(ticks):
        stand.tick()
    return stand


def times_of(batches: list[Batch], item: str) -> list[int]:
    return [t for batch in batches if batch.item == item for t in batch.log_time_ns.tolist()]


def blocks_of(store: Path) -> list[RecordBlock]:
    return list(RecordedItemsReader(open_store(store), (*ITEMS, *LATE)).step())


def test_a_record_streams_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No writer is read far ahead of the others, and nothing is held back for long."""
    monkeypatch.setattr(tail, "BATCH_ROWS", 50)
    stand = lived(Stand(tmp_path / "store", 2), 400)
    stand.box.close()
    blocks = blocks_of(stand.path)
    assert len(blocks) > 10
    for block in blocks:
        rows = [time_ns for item in ITEMS for time_ns in times_of(block.batches, item)]
        assert len(rows) < 400
        assert all(time_ns > block.until_ns - 15e9 for time_ns in rows)
        assert all(time_ns < block.until_ns + 15e9 for time_ns in rows)


@pytest.mark.parametrize("late_s", [0, 2])
def test_everything_up_to_a_block_has_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late_s: float
) -> None:
    monkeypatch.setattr(tail, "BATCH_ROWS", 30)
    stand = lived(Stand(tmp_path / "store", 3, late_s=late_s), 200)
    stand.box.close()
    blocks = blocks_of(stand.path)
    given: list[Batch] = []
    rows = [batch for block in blocks for batch in block.batches]
    everything = {item: times_of(rows, item) for item in (*ITEMS, *LATE)}
    for block in blocks:
        given += block.batches
        for item, times in everything.items():
            come = times_of(given, item)
            assert come == sorted(come)
            assert [t for t in come if t <= block.until_ns] == [
                t for t in times if t <= block.until_ns
            ]
    assert [b.until_ns for b in blocks] == sorted({b.until_ns for b in blocks})
    assert len(everything["ros_bulk"]) > 100
    assert {item: everything[item] for item in LATE} == stand.late
    assert (len(stand.late["ros_late"]) > 100) == bool(late_s)


def test_batch_boundaries_do_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand = Stand(tmp_path / "store", 4)
    for _ in range(4):
        lived(stand, 40)
        stand.restart(clean=stand.random.random() < 0.5)
        stand.clock.step(stand.random.uniform(-3, 3))
    stand.box.close()
    replays = []
    for rows in (1, 7, 60, 4096):
        monkeypatch.setattr(tail, "BATCH_ROWS", rows)
        replays.append(stand.replayed())
    assert len(replays[0]) > 100
    assert all(other == replays[0] for other in replays[1:])


def test_epochs_follow_each_other(tmp_path: Path) -> None:
    """Each run and each step of the clock begins one; times within one never decrease."""
    stand = Stand(tmp_path / "store", 5)
    lived(stand, 20)
    stand.clock.step(-100)
    lived(stand, 20)
    stand.restart()
    lived(stand, 20)
    stand.box.close()
    blocks = blocks_of(stand.path)
    epochs = list(dict.fromkeys(block.epoch for block in blocks))
    assert len({epoch.run for epoch in epochs}) == 2
    assert len(epochs) == 3
    assert epochs[0].base_ns - epochs[1].base_ns == 100_000_000_000
    assert [block.is_last for block in blocks].count(True) == 2
