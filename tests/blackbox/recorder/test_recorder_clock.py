"""The box's clock in the record: a point per file and every 10 s, a new file at a large step."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.recorder.pipeline import MessageClock, PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.source import Keep, TopicOptions
from amberbox.core.types import Topic
from tests.support.manual_recorder import COUNT, ManualBox, events, number, own_records

KEEPS: tuple[Keep, ...] = ("all", "ring")


def received(store: Path) -> list[int]:
    return amberbox.open(store).query("ros_count", ["received"]).values("received")


def clock_points(store: Path) -> list[list[int]]:
    """Log times of the clock records, file by file, in seconds from the first."""
    times = [
        [
            log_ns
            for log_ns, _ in journal_reader._own_messages(journal, "amberbox/clock", journal.places)
        ]
        for journal in journal_reader.journals(store)
    ]
    return [[round((t - times[0][0]) / NS) for t in file] for file in times]


def test_each_file_says_what_the_clock_does_at_its_start_and_every_10_s(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(rotate_ns=25 * NS))
    for n in range(310):
        box.hear(COUNT, number(n))
        box.write(0.1)
        if n == 120:
            box.clock.is_synchronised = None
    box.close()
    assert clock_points(box.store) == [[0, 0, 10, 20], [25, 30]]
    assert [c["synchronised"] for c in own_records(box.store, "amberbox/clock")] == [
        True, True, True, None, None, None,
    ]  # fmt: skip
    files = journal_reader.journals(box.store)
    assert [journal_reader.run_messages(journal)["run"] for journal in files] == [1, 1]


@pytest.mark.parametrize("keep", KEEPS)
def test_small_steps_are_recorded_and_received_follows_them(tmp_path: Path, keep: Keep) -> None:
    box = ManualBox(tmp_path / "store", [TopicOptions("/count", keep=keep)])
    heard = []
    for n in range(30):
        if n == 10:
            box.clock.step(0.4)
        heard.append(box.clock.wall)
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    found = received(box.store)
    assert found[:10] == heard[:10]
    assert found[12:] == heard[12:]
    offsets = [record["offset_ns"] for record in own_records(box.store, "amberbox/clock")]
    assert offsets.count(int(0.4 * NS)) == (2 if keep == "ring" else 1)


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_a_message_stamped_just_before_a_step_does_not_spoil_what_follows(
    tmp_path: Path, step_s: float
) -> None:
    box = ManualBox(tmp_path / "store")
    stream = box.sink.topic(COUNT)
    box.hear(COUNT, number(0))
    box.write()
    stamped = box.sink.now_ns()  # a source has its stamp, but has not put the message yet
    box.clock.step(step_s)
    box.pipeline.tick()
    box.sink.message(stream, number(1), stamped)
    box.write()
    heard = []
    for n in range(2, 12):
        heard.append(box.clock.wall)
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    found = received(box.store)
    found.sort()
    late = found[1:] if step_s > 0 else found[:-1]
    assert late[-10:] == heard
    assert abs(late[0] - heard[0]) <= 0.2 * NS
    assert len(events(box.store, "clock_step")) == 1


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_a_gap_over_a_step_keeps_its_length(tmp_path: Path, step_s: float) -> None:
    box = ManualBox(tmp_path / "store", [TopicOptions("/count")])
    box.sink.expect_topics()
    box.write(2.0)
    box.clock.step(step_s)
    box.write(3.0)
    box.sink.link_up("/count", "robot")
    box.close()
    (gap,) = amberbox.open(box.store).gaps("ros_count")
    assert (gap.to_ns - gap.from_ns) / NS == pytest.approx(5.0)
    assert gap.to_ns == box.clock.wall


def test_a_gap_does_not_begin_later_than_now(tmp_path: Path) -> None:
    future = ManualBox(tmp_path / "store").clock.wall + 3600 * NS
    box = ManualBox(tmp_path / "other", [TopicOptions("/count")], start_gap_ns=future)
    box.sink.expect_topics()
    box.write(1.0)
    box.sink.link_up("/count", "robot")
    box.close()
    (gap,) = amberbox.open(box.store).gaps("ros_count")
    assert (gap.to_ns - gap.from_ns) / NS == pytest.approx(1.0)


@pytest.mark.parametrize("step_s", [-3600.0, 0.0, 3600.0])
def test_the_ring_is_trimmed_to_its_length_whatever_the_clock_does(
    tmp_path: Path, step_s: float
) -> None:
    ring = [TopicOptions("/count", keep="ring"), TopicOptions("/main")]
    main = Topic("/main", COUNT.message_encoding, COUNT.schema)
    box = ManualBox(tmp_path / "store", ring, options=PipelineOptions(ring_rotate_ns=2 * NS))
    keeper = RetentionService(open_store(box.store), RetentionOptions(ring_s=10.0, min_free=0))
    for n in range(600):
        if n == 300:
            box.clock.step(step_s)
        box.hear(COUNT, number(n))
        box.hear(main, number(n))
        box.write()
        if n % 20 == 0:
            keeper.step(threading.Event())
    box.close()
    keeper.step(threading.Event())
    kept = amberbox.open(box.store).query("ros_count").values("data")
    assert kept[-1] == 599 or step_s < 0
    assert 100 <= len(kept) <= 140
    assert sorted(kept) == list(range(600 - len(kept), 600))
    assert len(amberbox.open(box.store).query("ros_main")) == 600


@pytest.mark.parametrize("keep", KEEPS)
def test_a_step_is_noted_with_what_the_clock_was_before(tmp_path: Path, keep: Keep) -> None:
    box = ManualBox(tmp_path / "store", [TopicOptions("/count", keep=keep)])
    stepped_ns = 0
    for n in range(30):
        if n == 10:
            before_ns = box.sink.now_ns()
            box.clock.step(0.4)
            stepped_ns = round(0.4 * NS)
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    journal = next(j for j in journal_reader.journals(box.store) if j.items.get("ros_count"))
    found = journal_reader._own_messages(journal, "amberbox/clock", journal.places)
    points = [(log_ns, values["offset_ns"]) for log_ns, values in found]
    after = next(place for place, point in enumerate(points) if point[1] == stepped_ns)
    assert points[after - 1] == (before_ns, 0)
    assert points[after] == (before_ns + round(0.1 * NS), stepped_ns)


def test_each_point_says_how_long_the_computer_runs(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(rotate_ns=15 * NS))
    base_ns = box.clock.wall - box.clock.boot
    for n in range(300):
        if n == 120:
            box.clock.step(0.3)
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    count = 0
    for journal in journal_reader.journals(box.store):
        for log_ns, values in journal_reader._own_messages(
            journal, "amberbox/clock", journal.places
        ):
            assert log_ns - values["boot_ns"] == base_ns
            count += 1
    assert count >= 6


def test_a_recording_does_not_count_from_a_start(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    box.pipeline.clock = MessageClock(box.clock.wall)
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    assert {r["boot_ns"] for r in own_records(box.store, "amberbox/clock")} == {None}
