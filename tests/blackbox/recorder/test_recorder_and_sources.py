"""The recorder around its sources: how they fail, how they end, and what a stop costs."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.journal import writer
from amberbox.blackbox.recorder import queue as recorder_stream
from amberbox.blackbox.recorder import recorder, supervisor
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.recorder.queue import DataItem, MessageQueue, TopicStream
from amberbox.blackbox.recorder.recorder import Recorder, RetentionProcess, previous_end_ns
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.sources import recording as recording_source
from amberbox.blackbox.sources import ros as ros_source
from amberbox.blackbox.store import item_names
from amberbox.blackbox.store.store import open_store
from amberbox.core import files as core_files
from amberbox.core.source import ChangeOptions, Sink, TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    events,
    last_counters,
    number,
    own_records,
    raw_messages,
)

ROS = "- ros: {ros_master_uri: 'http://127.0.0.1:1', topics: [{name: /count}]}\n"
FILE = "- recording: {path: absent.bag}\n"
Run = Callable[[Any, Sink, threading.Event], None]


@contextmanager
def running(
    folder: Path, black_box: str, robot_yaml: str = "id: r\n"
) -> Iterator[tuple[Recorder, threading.Thread]]:
    folder.mkdir()
    (folder / "robot.yaml").write_text(robot_yaml)
    (folder / "black_box.yaml").write_text(black_box)
    recorder = Recorder(load_folder(folder), retention=False)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    try:
        yield recorder, thread
    finally:
        recorder.stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.mark.parametrize("lossless", [False, True])
def test_what_is_configured_is_known_from_the_first_file_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lossless: bool
) -> None:
    """The answer to a question without variables is the same before and after a rotation."""
    topic = Topic("/pose", "ros1", Schema("a/Pose", "ros1msg", b"float64 x\nfloat64 y\n"))
    began = threading.Event()

    def run(self: object, sink: Sink, stop: threading.Event) -> None:
        began.wait()
        sink.message(sink.topic(topic), bytes(16), sink.now_ns())
        stop.wait()

    monkeypatch.setattr(ros_source.Source, "run", run)
    monkeypatch.setattr(ros_source.Source, "lossless", lossless)
    options = "{name: /pose, variable_names: [y], max_frequency: 5}"
    blocks = ROS.replace("{name: /count}", options)
    with running(tmp_path / "robot", blocks) as (recorder, _):
        store = recorder.store.path
        wait_until(lambda: own_records(store, "amberbox/run"), "the first file began")
        began.set()
        wait_until(lambda: raw_messages(store, "/pose"), "a message is recorded")
        before = amberbox.open(store).query("ros_pose").names
    (record,) = own_records(store, "amberbox/run")
    assert json.loads(record["items"])["ros_pose"]["max_frequency"] == 5
    assert before == amberbox.open(store).query("ros_pose").names == ["timestamp", "y"]


def test_topics_that_a_pattern_finds_get_its_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    schema = Schema("a/Pose", "ros1msg", b"float64 x\nfloat64 y\n")

    def run(self: object, sink: Sink, stop: threading.Event) -> None:
        for name in ("/cam/a", "/cam/b", "/odom"):
            sink.link_up(name, "peer")
            sink.message(sink.topic(Topic(name, "ros1", schema)), bytes(16), sink.now_ns())
        stop.wait()

    monkeypatch.setattr(ros_source.Source, "run", run)
    topics = "{name: /cam/b, keep: bulk}, {name: /cam/*, keep: ring, max_frequency: 5}"
    blocks = ROS.replace("{name: /count}", topics).replace("topics:", "all_topics: true, topics:")
    with running(tmp_path / "robot", blocks) as (recorder, _):
        wait_until(lambda: raw_messages(recorder.store.path, "/odom"), "messages are recorded")
        items = recorder.pipeline.items
    kept = {name: (item.options.keep, item.options.max_frequency) for name, item in items.items()}
    assert kept == {
        "ros_cam_a": ("ring", 5), "ros_cam_b": ("bulk", None), "ros_odom": ("all", None),
    }  # fmt: skip
    assert recorder.store.journal_files("ring") and recorder.store.journal_files("bulk")


def test_events_do_not_put_off_the_next_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard_at: list[float] = []

    def run(self: object, sink: Sink, stop: threading.Event) -> None:
        for n in range(30):
            sink.event("noise", f"event {n}")
            stop.wait(0.005)
        sink.message(sink.topic(COUNT), number(1), sink.now_ns())
        heard_at.append(time.monotonic())
        stop.wait()

    monkeypatch.setattr(ros_source.Source, "run", run)
    with running(tmp_path / "robot", ROS, "id: r\nstore: {write_s: 1}\n") as (recorder, _):
        wait_until(
            lambda: heard_at and recorder.pipeline.items["ros_count"].counters.kept, "a write"
        )
        assert time.monotonic() - heard_at[0] < 10, "each event has put it off by a second"


def test_the_gap_of_a_source_that_fails_lasts_until_it_hears_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[int] = []

    def run(self: object, sink: Sink, stop: threading.Event) -> None:
        runs.append(sink.now_ns())
        sink.link_up("/count", "robot")
        sink.message(sink.topic(COUNT), number(len(runs)), sink.now_ns())
        if len(runs) == 1:
            raise OSError("no such device")
        stop.wait()

    monkeypatch.setattr(ros_source.Source, "run", run)
    with running(tmp_path / "robot", ROS) as (recorder, _):
        wait_until(lambda: len(runs) == 2, "a second run")
        wait_until(lambda: recorder.pipeline.items["ros_count"].counters.kept == 2, "both")
    gaps = amberbox.open(tmp_path / "robot").gaps("ros_count")
    (gap,) = (gap for gap in gaps if gap.reason == "ros failed")
    assert gap.from_ns >= runs[0]
    assert 0.9e9 < gap.to_ns - gap.from_ns < 3e9


def test_a_file_that_fails_halfway_is_not_played_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = []

    def run(self: object, sink: Sink, stop: threading.Event) -> None:
        runs.append(1)
        sink.message(sink.topic(COUNT), number(1), sink.now_ns())
        raise OSError("Input/output error")

    monkeypatch.setattr(recording_source.Source, "run", run)
    with running(tmp_path / "robot", FILE) as (_, thread):
        thread.join(PATIENCE_S)  # all sources have ended
        assert not thread.is_alive()
    store = tmp_path / "robot" / "store"
    (event,) = events(store, "source_failed")
    assert "failed and has ended: Input/output error" in event["text"]
    assert amberbox.open(store).query("recording_count").values("data") == [1]
    assert len(runs) == 1


def stream() -> TopicStream:
    return TopicStream(DataItem("count", "ros", "/count", TopicOptions("/count")), COUNT)


def test_a_file_waits_while_the_disk_has_what_was_taken() -> None:
    queue, count = MessageQueue(limit_bytes=300), stream()
    queue.put_waiting(count, bytes(1000), 1)
    assert len(queue.take()) == 1
    queue.wait_no_more()
    queue.put_waiting(count, bytes(10), 2)
    assert queue.take() == []
    queue.release()
    queue.put_waiting(count, bytes(1000), 3)
    assert len(queue.take()) == 1
    assert count.counters.received == 2


def test_a_stop_sends_those_away_who_wait_for_room() -> None:
    queue, count = MessageQueue(limit_bytes=300), stream()
    queue.put_waiting(count, bytes(200), 1)
    waiting = threading.Thread(target=queue.put_waiting, args=(count, bytes(200), 2))
    waiting.start()
    assert queue.wake.wait(PATIENCE_S)
    queue.wait_no_more()
    waiting.join(PATIENCE_S)
    assert not waiting.is_alive()
    assert (len(queue.take()), count.counters.received) == (1, 1)


def test_the_last_run_is_known_behind_an_empty_file(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    (box.store / "journal" / "000002-00000000-0000.mcap").touch()
    assert previous_end_ns(open_store(box.store)) == box.clock.wall


def test_a_full_disk_does_not_stop_a_source_from_listening(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, text: str) -> None:
        raise OSError(28, "No space left on device")

    box = ManualBox(tmp_path / "store")
    monkeypatch.setattr(supervisor, "replace_file", refuse)
    monkeypatch.setattr(item_names, "replace_file", refuse)
    box.sink.save_state({"port": 1})
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    (event,) = events(box.store, "disk")
    assert event["text"] == "the state of ros is not kept: No space left on device"
    assert amberbox.open(box.store).query("ros_count").values("data") == [1]


def test_a_keeper_that_cannot_run_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = ManualBox(tmp_path / "store")
    monkeypatch.setattr(sys, "executable", "/absent/python")
    monkeypatch.setattr(recorder, "_PAUSE_S", 0.0)
    keeper = RetentionProcess(box.pipeline, RetentionOptions())
    keeper.keep_running()
    keeper.keep_running()
    box.close()
    (event,) = events(box.store, "keeper")
    assert event["text"].startswith("the keeper cannot be started: No such file")


def test_names_that_fit_no_variable_are_told(tmp_path: Path) -> None:
    change = ChangeOptions(variables=("data", "dota"), bands={"speed": 0.1})
    options = [TopicOptions("/count", variable_names=["data", "date"], change=change)]
    box = ManualBox(tmp_path / "store", options)
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    (event,) = events(box.store, "unused_names")
    assert event["text"] == "ros_count has no date or dota or speed, as configured"


def test_json_names_are_told_until_they_come(tmp_path: Path) -> None:
    topic = Topic("/pose", "json")
    box = ManualBox(tmp_path / "store", [TopicOptions("/pose", variable_names=["x", "y"])])
    for message in (b'{"x": 1}', b'{"x": 2}', b'{"x": 1, "y": 2}'):
        box.hear(topic, message)
        box.write()
    box.close()
    (event,) = events(box.store, "unused_names")
    assert event["details"]["names"] == ["y"]


def test_accounts_of_a_long_trouble_do_not_pile_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_full = [False]
    write_all = core_files.write_all

    def write(fd: int, data: bytes) -> None:
        if is_full[0]:
            raise OSError(28, "No space left on device")
        write_all(fd, data)

    monkeypatch.setattr(writer, "write_all", write)
    box = ManualBox(tmp_path / "store", options=PipelineOptions(queue_bytes=1000))
    for n in range(200):
        is_full[0] = 20 <= n < 190
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    assert len(own_records(box.store, "amberbox/counters")) < 45
    gaps = [gap for gap in amberbox.open(box.store).gaps("ros_count") if gap.count]
    counters = last_counters(box.store)["ros_count"]
    assert sum(gap.count or 0 for gap in gaps) == counters["dropped"] > 100
    assert counters["kept"] + counters["dropped"] == counters["received"] == 200
    assert len(gaps) <= 2


def test_one_key_more_per_message_is_one_event_and_a_bounded_schema(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    for n in range(300):
        box.hear(Topic("/tasks", "json"), b'{"n": %d, "task_%d": 1}' % (n, n))
        box.write()
    box.close()
    (event,) = own_records(box.store, "amberbox/event")
    assert event["kind"] == "schema_widened"
    assert event["text"].startswith("ros_tasks has new variables: task_1 (")
    record = amberbox.open(box.store)
    assert len(record.variables("ros_tasks").columns) == recorder_stream.OPEN_VERSIONS + 1
    assert record.query("ros_tasks").values("n") == list(range(300))
    assert record.query("ros_tasks").values("task_5")[5] == 1
    assert record.gaps("ros_tasks") == []


def test_a_later_change_of_a_schema_is_an_event_of_its_own(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    for message in (b'{"a": 1}', b'{"a": 1, "b": 1}', b'{"c": 1}'):
        box.hear(Topic("/tasks", "json"), message)
        box.write()
    box.clock.advance(recorder_stream.QUIET_NS / 1e9 + 1)
    box.hear(Topic("/tasks", "json"), b'{"d": 1}')
    box.close()
    texts = [event["text"] for event in events(box.store, "schema_widened")]
    assert [text.partition(" (")[0] for text in texts] == [
        "ros_tasks has new variables: b",
        "ros_tasks has new variables: d",
    ]


@pytest.mark.parametrize("stamp", ["5", "0.25", '"12"', '"12:30"'])
def test_what_is_no_time_is_no_stamp_which_is_said_once(tmp_path: Path, stamp: str) -> None:
    box = ManualBox(tmp_path / "store")
    for n in range(3):
        box.hear(Topic("/odom", "json"), b'{"timestamp": %s, "x": %d}' % (stamp.encode(), n))
        box.write()
    box.close()
    (event,) = events(box.store, "no_stamp")
    value = stamp.strip('"')
    assert event["text"].startswith(f"ros_odom: timestamp is {value}, which is no time")
    table = amberbox.open(box.store).query("ros_odom", ["received", "x"])
    assert table.values("timestamp") == table.values("received")


def test_keys_that_are_data_do_not_widen_a_schema_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_stream, "MOST_VERSIONS", 5)
    box = ManualBox(tmp_path / "store")
    for n in range(20):
        box.hear(Topic("/tasks", "json"), b'{"task_%d": 1}' % n)
        box.write()
    box.close()
    (event,) = events(box.store, "schema_unstable")
    assert event["text"].startswith("ros_tasks had 5 schemas")
    assert len(raw_messages(box.store, "/tasks")) == 20
    (item,) = (i for i in amberbox.open(box.store).items() if i.name == "ros_tasks")
    assert len(amberbox.open(box.store).variables("ros_tasks").columns) == 5
    assert item.rows >= 5
