"""A disk that stalls or is full: nothing is lost unseen, and no publisher is slowed."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.journal import writer
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.store import journal_reader
from amberbox.core import files as core_files
from amberbox.core.clock import NS
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    events,
    last_counters,
    number,
    raw_messages,
    recording,
)
from tests.support.ros_network import RosMaster, RosPublisher, RosTopic

RATE_HZ = 1000
STALL_S = 5.0
PAYLOAD = 4096
TOPIC = "/robot/count"
ITEM = "ros_robot_count"


class Disk:
    """Replaces the writer's ``write``: works, stalls, or is full."""

    def __init__(self) -> None:
        self.works = threading.Event()
        self.works.set()
        self.stalled = threading.Event()
        self.room: int | None = None
        self._write = core_files.write_all

    def write(self, fd: int, data: bytes) -> None:
        if not self.works.is_set():
            self.stalled.set()
            self.works.wait()
        if self.room is not None and len(data) > self.room:
            self._write(fd, data[: self.room])
            raise OSError(errno.ENOSPC, "No space left on device")
        if self.room is not None:
            self.room -= len(data)
        self._write(fd, data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    made = Disk()
    monkeypatch.setattr(writer, "write_all", made.write)
    yield made
    made.works.set()


@pytest.fixture
def publisher() -> Iterator[tuple[RosMaster, RosPublisher]]:
    master = RosMaster()
    definition = f"int64 n\nuint8[{PAYLOAD}] payload\n"
    topics = {TOPIC: RosTopic("test/Count", definition, "*")}
    node = RosPublisher("/robot", topics, master)
    yield master, node
    node.kill()
    master.stop()


@contextmanager
def listening(folder: Path, master: RosMaster, queue: str) -> Iterator[Recorder]:
    folder.mkdir()
    (folder / "robot.yaml").write_text(f"id: r\nstore: {{queue: {queue}}}\n")
    (folder / "black_box.yaml").write_text(
        f"- ros:\n    ros_master_uri: {master.uri}\n    advertise: 127.0.0.1\n"
        f"    topics: [{{topic: {{name: {TOPIC}}}}}]\n"
    )
    with recording(folder) as recorder:
        yield recorder


def publish(node: RosPublisher, count: int, first: int) -> float:
    """Publish at 1 kHz on blocking sockets; return how long the slowest call took."""
    slowest_s, due = 0.0, time.monotonic()
    for n in range(first, first + count):
        began = time.monotonic()
        node.publish(TOPIC, number(n) + os.urandom(PAYLOAD))  # does not compress
        slowest_s = max(slowest_s, time.monotonic() - began)
        due += 1 / RATE_HZ
        time.sleep(max(0.0, due - time.monotonic()))
    return slowest_s


def numbers(store: Path) -> list[int]:
    messages = raw_messages(store, TOPIC)
    return [int.from_bytes(message[:8], "little") for message in messages]


@pytest.mark.parametrize("queue", ["64 MB", "1 MB"])
def test_a_stalling_disk_neither_slows_the_robot_nor_hides_a_loss(
    tmp_path: Path, disk: Disk, publisher: tuple[RosMaster, RosPublisher], queue: str
) -> None:
    master, node = publisher
    before, during, after = 300, round(STALL_S * RATE_HZ), 300
    with listening(tmp_path / "robot", master, queue) as recorder:
        node.wait_for_subscribers(TOPIC)
        slowest_s = publish(node, before, 0)
        disk.works.clear()
        assert disk.stalled.wait(PATIENCE_S)
        slowest_s = max(slowest_s, publish(node, during, before))
        disk.works.set()
        wait_until(lambda: recorder.pipeline.queue.size_bytes < 100_000, "written")
        slowest_s = max(slowest_s, publish(node, after, before + during))
        sent = before + during + after
        received = recorder.pipeline.items[ITEM].counters
        wait_until(lambda: received.received == sent, "everything has arrived")
    store = tmp_path / "robot" / "store"
    kept, counters = numbers(store), last_counters(store)[ITEM]
    lost = sorted(set(range(sent)) - set(kept))
    assert slowest_s < STALL_S / 2
    assert kept == sorted(set(kept))
    assert (counters["received"], counters["kept"]) == (sent, len(kept))
    assert counters["dropped"] == len(lost)
    gaps = [gap for gap in amberbox.open(store).gaps(ITEM) if gap.reason.startswith("dropped")]
    assert sum(gap.count or 0 for gap in gaps) == len(lost)
    assert bool(lost) == (queue == "1 MB")
    if lost:
        assert all(n in kept for n in [*range(before), *range(before + during, sent)])
        assert sum(gap.to_ns - gap.from_ns for gap in gaps) < (STALL_S + 1) * NS


def test_what_is_dropped_is_named_with_its_time(tmp_path: Path, disk: Disk) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(queue_bytes=1280))
    times = []
    for n in range(25):
        box.clock.advance(0.01)
        times.append(box.sink.now_ns())
        box.hear(COUNT, number(n))
    box.write()
    box.hear(COUNT, number(25))
    box.close()
    kept = [int.from_bytes(m, "little") for m in raw_messages(box.store, "/count")]
    assert kept == [*range(10), 25]
    (gap,) = (g for g in amberbox.open(box.store).gaps("ros_count") if g.count)
    assert (gap.count, gap.from_ns, gap.to_ns) == (15, times[10], times[24] + 1)
    assert last_counters(box.store)["ros_count"]["dropped"] == 15


@pytest.mark.parametrize("room", [0, 30, 700, 5000])
def test_a_full_disk_is_told_and_recording_resumes_when_there_is_room(
    tmp_path: Path, disk: Disk, room: int
) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(rotate_bytes=6000))
    said: list[int] = []

    def say(count: int) -> None:
        for _ in range(count):
            said.append(len(said))
            box.hear(COUNT, number(said[-1]))
            box.write()

    if room:
        say(20)
    disk.room = room
    say(60)
    assert box.pipeline.disk_error == "No space left on device"
    known = numbers_of(box.store)
    assert known == said[: len(known)]
    disk.room = None
    say(5)
    assert box.pipeline.disk_error == ""
    box.close()
    assert numbers_of(box.store) == said
    texts = [event["text"] for event in events(box.store, "disk")]
    assert texts[0::2] == ["the disk does not take data: No space left on device"] * (
        len(texts) // 2
    )
    assert texts[1::2] == ["the disk takes data again"] * (len(texts) // 2)
    assert texts
    assert [journal.items["amberbox_run"] for journal in journal_reader.journals(box.store)] == [
        1
    ] * len(list((box.store / "journal").glob("*.mcap")))
    assert last_counters(box.store)["ros_count"]["kept"] == len(said)


@pytest.mark.parametrize("fails_at", range(1, 8))
def test_a_clock_that_is_set_when_a_write_fails_ends_nothing(
    tmp_path: Path, disk: Disk, fails_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes, write = [], core_files.write_all

    def fail_once(fd: int, data: bytes) -> None:
        writes.append(data)
        if len(writes) == fails_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(fd, data)

    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(0))
    box.write()
    monkeypatch.setattr(writer, "write_all", fail_once)
    box.clock.step(-3600)
    for n in range(1, 9):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    assert numbers_of(box.store) == list(range(9))
    assert len(events(box.store, "clock_step")) == 1


def numbers_of(store: Path) -> list[int]:
    return [int.from_bytes(message, "little") for message in raw_messages(store, "/count")]


def test_the_recorder_lives_through_a_full_disk(
    tmp_path: Path, disk: Disk, publisher: tuple[RosMaster, RosPublisher]
) -> None:
    master, node = publisher
    with listening(tmp_path / "robot", master, "64 MB") as recorder:
        node.wait_for_subscribers(TOPIC)
        disk.room = 50_000
        publish(node, 400, 0)
        wait_until(lambda: recorder.pipeline.disk_error, "the disk is full")
        time_of_trouble = time.monotonic()
        wait_until(lambda: time.monotonic() > time_of_trouble + 1.2, "a sync fails, too")
        disk.room = None
        wait_until(lambda: not recorder.pipeline.disk_error, "the disk has room")
    store = tmp_path / "robot" / "store"
    assert numbers(store) == list(range(400))
    assert len(events(store, "disk")) == 2
