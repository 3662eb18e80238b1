"""Events only: messages refused while the disk is full are counted; then recording resumes."""

from __future__ import annotations

import errno
import os
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.journal import writer
from amberbox.blackbox.recorder import disk_room as module
from amberbox.blackbox.recorder.disk_room import DiskRoom
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.recorder.supervisor import BlockSink
from amberbox.blackbox.store.tail import follow
from amberbox.core import files as core_files
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Gap, Topic
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    event_texts,
    last_counters,
    number,
    own_records,
    raw_messages,
)

RESERVE = 100_000
MAP = Topic("/map", COUNT.message_encoding, COUNT.schema, latched=True)
NOISE = Topic("/noise", "raw")


class Disk:
    """A disk of a given size as the writer and the reserve see it; others may take its room."""

    def __init__(self, patch: pytest.MonkeyPatch, folder: Path) -> None:
        self.size = 10_000_000
        self.others = 0
        self.broken = 0
        self._folder = folder
        self._write = core_files.write_all
        patch.setattr(writer, "write_all", self.write)
        patch.setattr(writer, "_expect_room", lambda fd, size: None)
        patch.setattr(module, "free_bytes", lambda folder: self.free)

    @property
    def free(self) -> int:
        used = sum(p.stat().st_size for p in self._folder.rglob("*") if p.is_file())
        return max(0, self.size - self.others - used)

    def fill(self) -> None:
        self.others += self.free

    def write(self, fd: int, data: bytes) -> None:
        if self.broken:
            raise OSError(self.broken, os.strerror(self.broken))
        if self.free < len(data):
            self._write(fd, data[: self.free])  # as much as fits, then it says so
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._write(fd, data)


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    yield Disk(monkeypatch, tmp_path / "store")


def box_on(store: Path, *topics: TopicOptions, queue: int = 10**7) -> ManualBox:
    options = PipelineOptions(queue_bytes=queue)
    store.mkdir(exist_ok=True)
    room = DiskRoom(store, RESERVE)
    room.begin()
    return ManualBox(store, topics, options=options, room=room)


def said(store: Path) -> list[int]:
    return [int.from_bytes(m[:8], "little") for m in raw_messages(store, "/count")]


def test_what_is_turned_away_is_named_with_its_time(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    times = []
    for n in range(60):
        if n == 20:
            disk.fill()
        if n == 50:
            disk.others = 0
        times.append(box.sink.now_ns())
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    kept = said(box.store)
    lost = sorted(set(range(60)) - set(kept))
    assert kept == [n for n in range(60) if n not in lost]
    assert 25 <= len(lost) <= 30
    assert set(lost) <= set(range(20, 51))
    gaps = [g for g in amberbox.open(box.store).gaps("ros_count") if g.reason.startswith("dropped")]
    assert {gap.reason for gap in gaps} == {"dropped: disk full"}
    assert sum(gap.count or 0 for gap in gaps) == len(lost)
    assert all(any(g.from_ns <= times[n] < g.to_ns for g in gaps) for n in lost)
    assert not any(g.from_ns <= times[n] < g.to_ns for g in gaps for n in kept)
    counters = last_counters(box.store)["ros_count"]
    assert (counters["kept"], counters["dropped"]) == (len(kept), len(lost))
    assert event_texts(box.store, "events_only") == [
        "disk full: only events are recorded until there is room"
    ]
    assert event_texts(box.store, "recording_resumed") == [
        f"there is room: recording goes on; {len(lost)} messages of 1 items were dropped"
    ]


def test_nothing_that_waited_is_lost_when_the_reserve_is_given_up(
    tmp_path: Path, disk: Disk
) -> None:
    box = box_on(tmp_path / "store")
    box.hear(COUNT, number(0))
    box.write()
    disk.fill()
    box.hear(COUNT, *(number(n) for n in range(1, 100)))
    box.pipeline.event("collision", "bumper hit")
    box.write()
    assert said(box.store) == list(range(100))
    assert event_texts(box.store, "collision") == ["bumper hit"]
    assert (box.store / "reserve").stat().st_size == 0
    assert box.pipeline.disk_error == ""
    box.close()
    assert event_texts(box.store, "disk") == []


def test_events_find_room_though_much_data_waited(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    box.write()
    disk.fill()
    for _ in range(100):
        box.hear(NOISE, os.urandom(10_000))
    box.write()
    for n in range(20):
        box.pipeline.event("collision", f"bumper hit {n}")
        box.write(1.0)
    assert len(event_texts(box.store, "collision")) == 20
    kept = len(raw_messages(box.store, "/noise"))
    assert kept == RESERVE // 8 // 10_000
    box.close()
    counters = last_counters(box.store)["ros_noise"]
    assert (counters["kept"], counters["dropped"]) == (kept, 100 - kept)


def test_accounts_become_rare_so_that_the_room_lasts(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    box.write()
    disk.fill()
    for n in range(720):
        box.hear(COUNT, number(n))
        box.write(5.0)
    records = own_records(box.store, "amberbox/gap")
    assert 55 <= len([r for r in records if r["count"]]) <= 75
    assert box.pipeline.disk_error == ""
    assert (box.store / "reserve").stat().st_size == 0
    box.close()
    kept, dropped = (last_counters(box.store)["ros_count"][key] for key in ("kept", "dropped"))
    assert kept + dropped == 720
    assert sum(gap.count or 0 for gap in amberbox.open(box.store).gaps("ros_count")) == dropped


def test_a_crash_while_events_only_leaves_the_gap_open(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    box.write()
    disk.fill()
    for n in range(100):
        box.hear(COUNT, number(n))
        box.write()
    box.pipeline.event("collision", "bumper hit")
    box.write()
    end_ns = box.clock.wall
    box.crash()
    gaps = [g for g in amberbox.open(box.store).gaps("ros_count") if g.reason.startswith("dropped")]
    assert max(gap.to_ns for gap in gaps) >= end_ns - NS // 5


def test_the_last_latched_message_comes_when_there_is_room(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    box.hear(MAP, number(1))
    box.write()
    disk.fill()
    for n in (2, 3, 4):
        box.hear(COUNT, number(n))
        box.write()
        box.hear(MAP, number(n))
    box.write()
    disk.others = 0
    for _ in range(3):
        box.write()
    box.close()
    maps = [int.from_bytes(m, "little") for m in raw_messages(box.store, "/map")]
    assert (maps[0], maps[-1]) == (1, 4)
    counters = last_counters(box.store)["ros_map"]
    assert (counters["kept"], counters["dropped"]) == (len(maps), 4 - len(maps))


def test_a_store_that_the_keeper_calls_full(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store", TopicOptions("/count"))
    for n in range(30):
        if n == 10:
            (box.store / "full").write_text("keep_min\n")
        if n == 20:
            (box.store / "full").unlink()
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    assert said(box.store) == [*range(10), *range(20, 30)]
    (gap,) = (g for g in amberbox.open(box.store).gaps("ros_count") if g.count)
    assert (gap.reason, gap.count) == ("dropped: store is full (keep_min)", 10)
    assert (box.store / "reserve").stat().st_size == RESERVE


@pytest.mark.parametrize("error", [errno.EIO, errno.EROFS])
def test_a_broken_disk_is_not_a_full_one(tmp_path: Path, disk: Disk, error: int) -> None:
    box = box_on(tmp_path / "store")
    for n in range(30):
        disk.broken = error if 10 <= n < 20 else 0
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    assert said(box.store) == list(range(30))
    assert event_texts(box.store, "events_only") == []
    assert (box.store / "reserve").stat().st_size == RESERVE


def test_when_even_the_reserve_is_used_up_events_wait(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    box.write()
    disk.fill()
    for n in range(20):
        box.hear(COUNT, number(n))
        box.pipeline.event("collision", f"bumper hit {n}")
        box.write()
        disk.fill()  # somebody else takes what the reserve gave free
    assert box.pipeline.disk_error == "No space left on device"
    disk.others = 0
    for _ in range(3):
        box.write()
    assert event_texts(box.store, "collision") == [f"bumper hit {n}" for n in range(20)]
    box.close()
    counters = last_counters(box.store)["ros_count"]
    assert counters["kept"] + counters["dropped"] == 20
    assert counters["kept"] == len(said(box.store))


def test_a_file_waits_for_room_and_loses_nothing(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store", queue=3000)
    file = BlockSink(box.pipeline, "file", (), lossless=True)
    stream = file.topic(COUNT)
    for n in range(5):
        file.message(stream, number(n), box.sink.now_ns())
    box.write()
    disk.fill()
    for n in range(5, 25):
        if box.pipeline.queue.size_bytes < 2500:
            file.message(stream, number(n), box.sink.now_ns())
            last = n
        box.write()
    assert box.pipeline.queue.size_bytes > 1000
    disk.others = 0
    for _ in range(3):
        box.write()
    assert box.pipeline.queue.size_bytes == 0
    box.close()
    assert said(box.store) == list(range(last + 1))
    assert last_counters(box.store)["file_count"]["dropped"] == 0


def test_the_clock_may_be_set_while_messages_are_turned_away(tmp_path: Path, disk: Disk) -> None:
    box = box_on(tmp_path / "store")
    box.write()
    disk.fill()
    for n in range(50):
        if n == 25:
            box.clock.step(3600)
        box.hear(COUNT, number(n))
        box.write()
    end_ns = box.clock.wall
    box.close()
    gaps = [g for g in amberbox.open(box.store).gaps("ros_count") if g.reason.startswith("dropped")]
    dropped = last_counters(box.store)["ros_count"]["dropped"]
    assert sum(gap.count or 0 for gap in gaps) == dropped > 45
    assert end_ns - NS < max(gap.to_ns for gap in gaps) <= end_ns


def test_a_ring_elsewhere_goes_on_and_its_own_full_disk_holds_nobody_up(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = box_on(tmp_path / "store", TopicOptions("/count"), TopicOptions("/map", keep="ring"))
    ring = Topic("/map", COUNT.message_encoding, COUNT.schema)
    memory = tmp_path / "memory" / "ring"
    memory.mkdir(parents=True)
    (box.store / "ring").symlink_to(memory)
    box.pipeline.keep_elsewhere({"ring"})
    ring_is_full, write = [False], core_files.write_all

    def write_to(fd: int, data: bytes) -> None:
        in_ring = "memory" in str(Path(f"/proc/self/fd/{fd}").readlink())
        if in_ring and ring_is_full[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(fd, data) if not in_ring else os.write(fd, data)

    monkeypatch.setattr(writer, "write_all", write_to)
    for n in range(30):
        if n == 10:
            disk.fill()
        if n == 20:
            disk.others = 0
        ring_is_full[0] = 22 <= n < 25
        box.hear(COUNT, number(n))
        box.hear(ring, number(n))
        box.write()
    assert box.pipeline.disk_error == ""
    box.close()
    in_ring = [int.from_bytes(m, "little") for m in raw_messages(box.store, "/map")]
    assert in_ring == [*range(22), *range(25, 30)]
    assert set(range(20)) - set(said(box.store)) <= set(range(10, 20))
    assert set(range(21, 30)) <= set(said(box.store))
    gaps = [g for g in amberbox.open(box.store).gaps("ros_map") if g.count]
    assert sum(gap.count or 0 for gap in gaps) == 3
    assert {gap.reason for gap in gaps} == {"dropped: no room for the ring"}


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32))
def test_accounts_are_exact_whatever_the_disk_does(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng, store = random.Random(seed), tmp_path_factory.mktemp("full") / "store"
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch, store)
        box = box_on(store, queue=rng.choice([2000, 10**6]))
        sent = 0
        for _ in range(rng.randint(5, 80)):
            chance = rng.random()
            if chance < 0.15:
                disk.fill()
            elif chance < 0.3:
                disk.others = 0
            for _ in range(rng.randint(0, 30)):
                box.hear(COUNT, number(sent))
                sent += 1
            box.pipeline.event("tick", str(sent))
            box.write(rng.choice([0.1, 2.0]))
        disk.others = 0
        box.write()
        box.close()
    kept = said(store)
    assert kept == sorted(set(kept))
    counters = last_counters(store).get("ros_count", {"received": 0, "kept": 0, "dropped": 0})
    assert counters["received"] == sent
    assert (counters["kept"], counters["dropped"]) == (len(kept), sent - len(kept))
    gaps = amberbox.open(store).gaps("ros_count") if sent else []
    assert sum(gap.count or 0 for gap in gaps) == sent - len(kept)
    ticks = event_texts(store, "tick")
    assert ticks == sorted(ticks, key=int)
    holes = [d for d in follow(store, live=False) if isinstance(d, Gap) and d.from_seq is not None]
    assert holes == []
    shutil.rmtree(store)
