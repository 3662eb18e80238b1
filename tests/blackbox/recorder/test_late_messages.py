"""Messages that a source passes on late: with their own times, and before the watermark."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import time
from itertools import pairwise
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.recorder import source_process
from amberbox.blackbox.recorder.pipeline import LAG_NS, PipelineOptions
from amberbox.blackbox.retention.live_reader import LiveReader
from amberbox.blackbox.store import journal_reader, tail
from amberbox.blackbox.store.store import open_store
from amberbox.blackbox.store.tail import Delivery, follow
from amberbox.core.clock import NS, StampConverter
from amberbox.core.source import TopicOptions
from amberbox.core.types import Batch, Schema, Topic, Watermark
from amberbox.testing.clock import ManualClock, wait_until
from tests.support.manual_recorder import COUNT, ManualBox, events, number, own_records, recording
from tests.support.planted_source import plant
from tests.support.processes import free_port

LATE = Topic("/late", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))


def hand_over(box: ManualBox, *times_ns: int) -> None:
    """Pass on messages with the times at which they were received."""
    stream = box.sink.topic(LATE)
    for received_ns in times_ns:
        box.sink.message(stream, number(received_ns), received_ns)


def received(store: Path, item: str) -> list[int]:
    """Return the times of receipt as recorded, in the order of the record."""
    batches = journal_reader.batches(store, [item])
    return [time_ns for batch in batches for time_ns in batch.log_time_ns.tolist()]


def watermark(box: ManualBox) -> int:
    head = read_head(open_store(box.store).folder("main"))
    assert head is not None
    return head.watermark_ns


def held_up(box: ManualBox, seconds: int) -> list[int]:
    """Let the late source be held up while another one goes on; return its times of receipt."""
    box.sink.complete(box.sink.now_ns())
    times = []
    for _ in range(10 * seconds):
        times.append(box.sink.now_ns())
        box.hear(COUNT, number(1))
        box.write()
    return times


def test_messages_of_a_source_that_was_held_up_have_their_own_times(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", late_s=5.0)
    began_ns = box.sink.now_ns()
    times = held_up(box, 4)
    assert len(received(box.store, "ros_count")) == 40  # nothing was put off
    assert watermark(box) == began_ns
    hand_over(box, *times)
    box.sink.complete(box.sink.now_ns())
    box.write()
    assert watermark(box) == box.clock.wall - NS // 10
    box.close()
    assert received(box.store, "ros_late") == received(box.store, "ros_count") == times
    assert amberbox.open(box.store).query("ros_late", ["received"]).values("received") == times
    stated = [r["complete_ns"] for r in own_records(box.store, "amberbox/counters") if len(r) > 1]
    assert set(stated) == {began_ns, times[-1] + NS // 10}
    assert not events(box.store, "late")


def test_a_source_that_is_held_up_for_too_long_holds_back_no_more(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", late_s=1.0)
    times = held_up(box, 3)
    floor_ns = watermark(box)
    assert floor_ns == box.clock.wall - NS
    hand_over(box, *times)
    box.sink.complete(box.sink.now_ns())
    box.write()
    box.close()
    assert received(box.store, "ros_late") == [max(t, floor_ns) for t in times]
    (event,) = events(box.store, "late")
    assert event["details"]["count"] == sum(t < floor_ns - NS // 10 for t in times) > 10
    assert "ros_late came too late" in event["text"]


def test_a_source_that_does_not_run_holds_nothing_back(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", late_s=5.0)
    box.write()
    assert watermark(box) == box.clock.wall
    box.sink.complete(box.sink.now_ns())
    box.sink.end_run()
    box.write()
    assert watermark(box) == box.clock.wall


def test_triggers_wait_for_what_is_late(tmp_path: Path) -> None:
    """The reader of conditions of incidents and missions is complete as late as the monitors'."""
    box = ManualBox(tmp_path / "store", late_s=5.0)
    began_ns = box.sink.now_ns()
    times = held_up(box, 3)
    reader = LiveReader(open_store(box.store), ["ros_count", "ros_late"], None, 0.0)
    (part,) = reader.step()
    assert part.until_ns <= began_ns
    assert sum(len(batch) for batch, _ in part.batches) == 30
    hand_over(box, *times)
    box.sink.complete(box.sink.now_ns())
    box.write()
    (part,) = reader.step()
    late = [time_ns for batch, ns in part.batches if batch.item == "ros_late" for time_ns in ns]
    assert late == times
    assert part.until_ns == watermark(box) > times[-1]
    box.close()


def test_a_new_file_waits_for_what_is_late(tmp_path: Path) -> None:
    """The files of a writer follow each other in time, and none begins amid a hold-up."""
    options = PipelineOptions(rotate_ns=NS)
    box = ManualBox(tmp_path / "store", late_s=5.0, options=options)
    times = held_up(box, 4)
    hand_over(box, *times)
    for _ in range(3):
        box.sink.complete(box.sink.now_ns())
        box.write()
        box.hear(COUNT, number(2))
    box.close()
    assert received(box.store, "ros_late") == times
    files = journal_reader.files_of(open_store(box.store), "main")
    assert len(files) > 1
    assert all(one.end_ns <= after.start_ns for one, after in pairwise(files))


def test_a_step_of_the_clock_ends_the_wait(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", late_s=5.0)
    held_up(box, 2)
    box.clock.step(3600)
    box.write()  # a new epoch
    step_ns = box.sink.now_ns()
    box.sink.complete(step_ns)
    box.hear(COUNT, number(3))
    box.write()
    assert watermark(box) == step_ns
    box.close()
    assert len(received(box.store, "ros_count")) == 21


def late_history(store: Path, seed: int) -> list[tuple[str, int]]:
    """Write runs in which a source is held up now and then; return item and time of each row."""
    rng, clock, rows = random.Random(seed), ManualClock(), list[tuple[str, int]]()
    for _ in range(rng.randint(1, 3)):
        options = PipelineOptions(rotate_ns=rng.choice([NS, 600 * NS]))
        topics = [TopicOptions("/late", keep=rng.choice(["all", "bulk"]))]
        box = ManualBox(store, topics, clock=clock, options=options, late_s=2.0)
        box.sink.complete(box.sink.now_ns())
        waiting: list[int] = []
        for _ in range(rng.randint(5, 60)):
            waiting.append(box.sink.now_ns())
            clock.advance(0.001)
            rows.append(("ros_count", box.sink.now_ns()))
            box.hear(COUNT, number(1))
            if rng.random() < 0.2 or waiting[0] < box.sink.now_ns() - 1.8 * NS:
                hand_over(box, *waiting)
                rows += [("ros_late", time_ns) for time_ns in waiting]
                waiting.clear()
                box.sink.complete(box.sink.now_ns())
            box.write(rng.choice([0.03, 0.1]))
        box.crash() if rng.random() < 0.5 else box.close()
        clock.advance(5)
    return rows


def in_small_batches(store: Path, items: list[str]) -> list[Delivery]:
    """Read a record so that a watermark follows every few rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tail, "BATCH_ROWS", 7)
        return list(follow(store, items, live=False))


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32))
def test_no_row_comes_behind_a_watermark(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Also in a replay, where only the journal states how late rows may be."""
    store = tmp_path_factory.mktemp("late") / "store"
    rows = late_history(store, seed)
    passed: dict[str, int] = {}
    found: list[tuple[int, str, int]] = []
    for delivery in in_small_batches(store, ["ros_count", "ros_late"]):
        if isinstance(delivery, Watermark):
            assert passed.get(delivery.writer, 0) <= delivery.received_ns
            passed[delivery.writer] = delivery.received_ns
        elif isinstance(delivery, Batch):
            assert int(delivery.received_ns.min()) >= passed.get(delivery.writer, 0)
            times = delivery.received_ns.tolist()
            found += [(delivery.run, delivery.item, time_ns) for time_ns in times]
    for item in ("ros_count", "ros_late"):
        expected = np.array([time_ns for name, time_ns in rows if name == item])
        run_by_run = sorted(found, key=itemgetter(0))
        moved = np.array([time_ns for _, name, time_ns in run_by_run if name == item]) - expected
        # at the start of a file they are moved to it, if it is that close
        assert np.all((moved >= 0) & (moved <= LAG_NS))
        assert len(moved) < 100 or (moved == 0).mean() > 0.8


def test_stamps_of_another_clock_become_log_time() -> None:
    ahead_ns = 500 * NS  # log time is not wall time
    converter = StampConverter(lambda: time.time_ns() + ahead_ns)
    before_ns = time.time_ns()
    stamp_ns = time.time_ns() - 3 * NS
    converted_ns = converter.log_ns(stamp_ns)
    late_ns = time.time_ns() - before_ns
    assert abs(converted_ns - (stamp_ns + ahead_ns)) <= late_ns
    assert converter.log_ns(stamp_ns - NS) == converted_ns
    assert converter.log_ns(time.time_ns() + 10 * NS) <= time.time_ns() + ahead_ns


@pytest.mark.parametrize("process", [True, False])
def test_datagrams_of_a_frozen_process_have_the_times_of_the_kernel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, process: bool
) -> None:
    """The process of a source stands still for 4 s; without one, the source is only busy."""
    plant(tmp_path / "site", monkeypatch, stamped="tests.support.stamped_source")
    monkeypatch.setattr(source_process, "SILENT_S", 60.0)
    port, folder = free_port(), tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r\n")
    block = f"- stamped: {{port: {port}, process: {str(process).lower()}}}\n"
    (folder / "black_box.yaml").write_text(block)
    state = folder / "store" / "state" / "stamped.json"
    with recording(folder) as recorder, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bus:
        bus.connect(("127.0.0.1", port))
        wait_until(state.exists, "the source listens")
        sent: list[tuple[int, int]] = []

        def send(count: int) -> None:
            for _ in range(count):
                before_ns = time.time_ns()
                bus.send(number(len(sent)))
                sent.append((before_ns, time.time_ns()))
                time.sleep(0.025)

        def all_came() -> bool:
            item = recorder.pipeline.items.get("stamped_datagram")
            return item is not None and item.counters.kept == len(sent)

        send(20)
        wait_until(all_came, "the first ones")
        if process:
            os.kill(json.loads(state.read_text())["pid"], signal.SIGSTOP)
            send(160)
            os.kill(json.loads(state.read_text())["pid"], signal.SIGCONT)
        send(20)
        wait_until(all_came, "all of them")
    table = amberbox.open(folder).query("stamped_datagram", ["received", "data"])
    assert table.values("data") == list(range(len(sent)))
    off_ns = [
        max(before_ns - at_ns, at_ns - after_ns, 0)
        for (before_ns, after_ns), at_ns in zip(sent, table.values("received"), strict=True)
    ]
    assert np.percentile(off_ns, 90) < NS // 100
    assert max(off_ns) < NS // 2
    assert not events(folder / "store", "late")
