"""Cursors: whatever happens to the files, no row is skipped and none is repeated."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.supervisor import BlockSink
from amberbox.blackbox.store.store import create_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS, RunClock
from amberbox.core.types import Batch, Cursor, Gap, Schema, Topic, Watermark
from amberbox.testing.clock import ManualClock

TOPICS = [
    Topic(f"/{name}", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
    for name in ("a", "b")
]
ITEMS = ("ros_a", "ros_b")
Row = tuple[str, int]


class Box:
    """A recorder without threads: every call writes one interval's messages."""

    def __init__(self, store: Path, clock: ManualClock, rotate_bytes: int = 3000) -> None:
        self.clock = clock
        options = PipelineOptions(rotate_bytes=rotate_bytes)
        self.pipeline = Pipeline(create_store(store), RunClock(clock), options)
        self.sink = BlockSink(self.pipeline, "ros", (), lossless=False)
        self.streams = [self.sink.topic(topic) for topic in TOPICS]

    def write(self, rows: list[Row]) -> None:
        for item, number in rows:
            self.clock.advance(0.001)
            data = number.to_bytes(8, "little")
            self.sink.message(self.streams[ITEMS.index(item)], data, self.sink.now_ns())
        self.clock.advance(0.1)
        self.pipeline.tick()

    def crash(self) -> None:
        """Leave the files as ``kill -9`` does."""
        for lock in self.pipeline._locks:
            lock.release()


def rows_of(batch: Batch) -> list[Row]:
    return [(batch.item, n) for n in np.asarray(batch.columns["data"]).tolist()]


def numbered(rng: random.Random, start: int) -> list[Row]:
    return [(rng.choice(ITEMS), start + k) for k in range(rng.randint(1, 12))]


def history(store: Path, seed: int) -> list[Row]:
    """Write several runs, some of which crash; return all rows in the order of writing."""
    rng, clock = random.Random(seed), ManualClock()
    said: list[Row] = []
    for _ in range(rng.randint(1, 3)):
        box = Box(store, clock)
        for _ in range(rng.randint(1, 12)):
            rows = numbered(rng, len(said))
            box.write(rows)
            said += rows
        box.crash() if rng.random() < 0.5 else box.pipeline.close()
        clock.advance(5)
    return said


def per_item(rows: list[Row]) -> dict[str, list[int]]:
    return {item: [n for name, n in rows if name == item] for item in ITEMS}


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32))
def test_a_follower_that_is_killed_goes_on_where_it_was(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    store = tmp_path_factory.mktemp("follow") / "store"
    said = history(store, seed)
    rng, cursor, got = random.Random(seed), Cursor(), list[Row]()
    while True:
        patience = rng.randint(1, 6)
        deliveries = follow(store, ITEMS, cursor if got else None, live=False)
        done = True
        for delivery in deliveries:
            if isinstance(delivery, Batch):
                got += rows_of(delivery)
            cursor = Cursor.from_json(delivery.cursor.to_json())
            patience -= 1
            if patience == 0:
                done = False
                break
        if done:
            break
    assert per_item(got) == per_item(said)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32))
def test_damage_is_a_gap_and_everything_else_is_delivered_once(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    store = tmp_path_factory.mktemp("follow") / "store"
    said = history(store, seed)
    rng = random.Random(seed)
    path = rng.choice(sorted((store / "journal").glob("*.mcap")))
    data = bytearray(path.read_bytes())
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(len(data))
        data[place : place + 400] = rng.randbytes(len(data[place : place + 400]))
    path.write_bytes(data)
    got: list[Row] = []
    missing = 0
    for delivery in follow(store, ITEMS, live=False):
        if isinstance(delivery, Batch):
            got += rows_of(delivery)
        elif isinstance(delivery, Gap):
            missing += 1
    original = iter(said)
    assert all(row in original for row in sorted(got, key=lambda row: row[1]))
    for item, numbers in per_item(got).items():
        assert numbers == sorted(set(numbers)), f"{item} is repeated or out of order"
    assert missing or len(got) == len(said), "rows are missing and nothing says so"


def test_watermarks_never_pass_a_row_that_comes_later(tmp_path: Path) -> None:
    history(tmp_path / "store", seed=3)
    passed = 0
    for delivery in follow(tmp_path / "store", live=False):
        if isinstance(delivery, Watermark):
            passed = max(passed, delivery.received_ns)
        elif isinstance(delivery, Batch):
            assert int(delivery.received_ns.min()) >= passed


def test_a_live_follower_hears_what_is_written_and_what_is_not(tmp_path: Path) -> None:
    clock = ManualClock()
    box = Box(tmp_path / "store", clock)
    stop = threading.Event()
    deliveries = follow(tmp_path / "store", ITEMS, stop=stop, poll_s=0.001)
    box.write([("ros_a", 1), ("ros_b", 2)])
    assert rows_of(next_batch(deliveries)) == [("ros_a", 1)]
    assert rows_of(next_batch(deliveries)) == [("ros_b", 2)]
    clock.advance(0.5)
    box.pipeline.tick()
    quiet = next(d for d in deliveries if isinstance(d, Watermark) and d.received_ns >= clock.wall)
    assert quiet.cursor.writers["main"].run == 1
    box.write([("ros_a", 3)])
    assert rows_of(next_batch(deliveries)) == [("ros_a", 3)]
    box.pipeline.close()
    again = Box(tmp_path / "store", clock)
    again.write([("ros_b", 4)])
    batch = next_batch(deliveries)
    assert (batch.run, rows_of(batch)) == (2, [("ros_b", 4)])
    stop.set()


def next_batch(deliveries: Iterator[object]) -> Batch:
    return next(d for d in deliveries if isinstance(d, Batch))


def test_looking_back_repeats_the_window_before_the_cursor(tmp_path: Path) -> None:
    clock = ManualClock()
    box = Box(tmp_path / "store", clock, rotate_bytes=10**6)
    for number in range(50):
        box.write([("ros_a", number)])
    reader = follow(tmp_path / "store", ["ros_a"], live=False)
    cursor = next(d.cursor for d in reader if isinstance(d, Batch) and rows_of(d)[-1][1] == 30)
    back = [d for d in follow(tmp_path / "store", ["ros_a"], cursor, lookback_s=1.0, live=False)
            if isinstance(d, Batch)]  # fmt: skip
    numbers = [n for batch in back for _, n in rows_of(batch)]
    assert numbers == list(range(numbers[0], 50))
    assert 20 <= numbers[0] <= 22
    mark = cursor.writers["main"]
    old = [b for b in back if mark.has_read(b.run, int(b.seq[0]), b.item)]
    assert [n for b in old for _, n in rows_of(b)][-1] == 30
    assert all(b.cursor.writers["main"].seq >= mark.seq for b in back)


def test_a_cursor_of_another_store_starts_anew_and_says_so(tmp_path: Path) -> None:
    Box(tmp_path / "store", ManualClock()).write([("ros_a", 1)])
    foreign = Cursor("another", {})
    deliveries = list(follow(tmp_path / "store", ["ros_a"], foreign, live=False))
    assert isinstance(deliveries[0], Gap)
    assert "another store" in deliveries[0].reason
    assert any(isinstance(d, Batch) for d in deliveries)


def test_a_clock_step_begins_a_new_file_and_received_stays_right(tmp_path: Path) -> None:
    clock = ManualClock()
    box = Box(tmp_path / "store", clock, rotate_bytes=10**6)
    box.write([("ros_a", 1)])
    clock.step(-3600)
    box.write([("ros_a", 2)])
    wall_before = clock.wall
    box.write([("ros_a", 3)])
    clock.step(0.4)
    box.write([("ros_a", 4)])
    box.write([("ros_a", 5)])
    box.pipeline.close()
    received = {
        number: int(received_ns)
        for d in follow(tmp_path / "store", ["ros_a"], live=False)
        if isinstance(d, Batch)
        for (_, number), received_ns in zip(rows_of(d), d.received_ns, strict=True)
    }
    assert len(list((tmp_path / "store" / "journal").glob("*.mcap"))) == 2
    assert 0 <= received[3] - wall_before <= 0.2 * NS
    assert 0.4 * NS <= received[5] - received[3] <= 0.9 * NS
