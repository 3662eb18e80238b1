"""Asking a store while it is recorded: the same answers as later, and each file read once."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.journal import chunk as chunks
from amberbox.blackbox.journal import index as journal_index
from amberbox.blackbox.journal import scan
from amberbox.blackbox.query import overview
from amberbox.blackbox.query.overview import ItemInfo
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.journal_reader import journal_file, journals, sound_chunks
from amberbox.blackbox.store.segment_builder import build_segments
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.records import POSE, build_segments_of, pose
from tests.fuzzing import examples, fuzz
from tests.support.manual_recorder import COUNT, ManualBox, number

POSES = replace(POSE.mcap_topic(), name="/odom")
MAP = replace(COUNT, name="/map", latched=True)
BULK = replace(COUNT, name="/bulk")
OPTIONS = (TopicOptions("/odom", stamp="stamp"), TopicOptions("/bulk", keep="bulk"))


def encoded(value: int) -> bytes:
    return msgspec.json.encode(pose(value))


def record_some(box: ManualBox, writes: int, chance: random.Random) -> None:
    """Receive messages of randomly chosen topics at each write."""
    for value in range(writes):
        if chance.random() < 0.9:
            box.hear(POSES, *(encoded(value + n) for n in range(chance.randint(1, 3))))
        if chance.random() < 0.3:
            box.hear(COUNT, number(value))
        if chance.random() < 0.2:
            box.hear(BULK, number(value))
        if chance.random() < 0.1:
            box.hear(MAP, number(value))
        box.write(chance.choice([0.1, 0.1, 0.5]))


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ManualBox]:
    """A box that is recording: a finished file, and 300 writes in the one that grows.

    No journal counts as small, so that what holds for long ones is seen.
    """
    monkeypatch.setattr(overview, "_SMALL_BYTES", 0)
    box = ManualBox(tmp_path / "store", OPTIONS)
    record_some(box, 30, random.Random(1))
    box.pipeline.rotate()
    record_some(box, 300, random.Random(2))
    yield box
    box.close()


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts the chunks that are unpacked from now on."""
    count: Counter[str] = Counter()
    unpack = chunks._unpack

    def counted(*arguments: object) -> bytes | None:
        count["chunks"] += 1
        return unpack(*arguments)  # type: ignore[arg-type]  # passed on as they came

    monkeypatch.setattr(chunks, "_unpack", counted)
    return count


def counted_by_rows(record: Record, item: str) -> tuple[int, int, int]:
    """Return rows, first and last time of receipt of an item by reading them all."""
    received = record.query(item, ["received"]).values("received")
    return len(received), min(received), max(received)


def told(items: list[ItemInfo]) -> dict[str, tuple[int, int, int]]:
    return {i.name: (i.rows, i.first_ns, i.last_ns) for i in items if not i.estimated}


def test_a_list_of_items_unpacks_few_chunks(live: ManualBox, unpacked: Counter[str]) -> None:
    record = amberbox.open(live.store)
    items = record.items()
    assert {"ros_odom", "ros_odom__units", "ros_count", "ros_bulk"} <= {i.name for i in items}
    assert 0 < unpacked["chunks"] < 150  # each item once would be thousands
    assert told(items).keys() == {i.name for i in items if "__" not in i.name}
    for info in items:
        if not info.estimated:
            assert told([info])[info.name] == counted_by_rows(record, info.name)


def test_what_was_read_of_a_growing_journal_is_kept(
    live: ManualBox, unpacked: Counter[str]
) -> None:
    path = live.pipeline.journal_paths[0]
    before = journal_file(path)
    live.hear(COUNT, number(7))
    live.write()
    unpacked.clear()
    after = journal_file(path)
    assert after.items["ros_count"] == before.items["ros_count"] + 1
    assert after.end_seq > before.end_seq
    assert unpacked["chunks"] <= 2
    assert journal_file(path) is after


@pytest.mark.parametrize("ends", ["rotated", "closed", "killed"])
def test_a_journal_that_is_given_up_is_looked_into_anew(tmp_path: Path, ends: str) -> None:
    """Also where its head still names it, and where not a byte is added."""
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write()
    box.pipeline._journals.publish_heads(box.sink.now_ns())
    (path,) = box.pipeline.journal_paths
    before = journal_file(path)
    assert (before.finished, before.walked) == (False, False)
    if ends == "rotated":
        box.pipeline._journals.rotate()
    else:
        (box.close if ends == "closed" else box.crash)()
    after = journal_file(path)
    assert (after.finished, after.walked) == (ends != "killed", ends == "killed")
    assert after.items["ros_count"] == before.items["ros_count"]
    if ends == "rotated":
        box.close()


def test_a_query_reads_only_chunks_of_its_item(live: ManualBox, unpacked: Counter[str]) -> None:
    record = amberbox.open(live.store)
    held = sum(
        any(j.streams[n].item == "ros_count" for n in place.channels or ())
        for j in journals(live.store)
        for place in j.places
    )
    unpacked.clear()
    assert len(record.query("ros_count")) > 50
    assert held < 120
    assert unpacked["chunks"] <= held + 10  # and what says how variables are chosen


def test_sql_reads_the_tables_that_it_names(live: ManualBox, unpacked: Counter[str]) -> None:
    record = amberbox.open(live.store)
    rows = len(record.query("ros_count"))
    unpacked.clear()
    assert record.sql("select count(*) from ros_count").values("count_star()") == [rows]
    assert unpacked["chunks"] < 200


@pytest.mark.parametrize(
    "statement",
    [
        "select count(*) n from query_table('ros_' || 'odom')",
        "select count(x) n from (select columns('pose_x') x from ros_odom)",
        "from (select count(*) n from ros_odom)",
        "select count(*) n from (from ros_odom)",
        "select count(o) n from ros_odom o",
        "with a as (from ROS_ODOM) select count(pose_y) n from a",
        'select count(*) n from (select distinct seq from "ros_odom")',
    ],
)
def test_sql_finds_what_is_not_named(live: ManualBox, statement: str) -> None:
    record = amberbox.open(live.store)
    assert record.sql(statement).values("n") == [len(record.query("ros_odom", ["seq"]))]


@pytest.mark.parametrize("what", ["describe ros_odom", "summarize ros_odom", "from ros_odom"])
def test_sql_shows_all_columns(live: ManualBox, what: str) -> None:
    record = amberbox.open(live.store)
    table = record.sql(what)
    shown = table.names if what == "from ros_odom" else table.values("column_name")
    assert {"timestamp", "pose_x", "ranges", "mode", "received", "seq"} <= set(shown)
    assert len(table) == len(record.query("ros_odom")) if what == "from ros_odom" else len(shown)


@fuzz
@settings(max_examples=examples(6))
@given(seed=st.integers(0, 2**32), writes=st.integers(1, 60))
def test_answers_stay_the_same(
    tmp_path_factory: pytest.TempPathFactory, seed: int, writes: int
) -> None:
    """A growing journal, the same one finished, and its segments give the same answers."""
    chance = random.Random(seed)
    store = tmp_path_factory.mktemp("asked") / "store"
    options = PipelineOptions(rotate_ns=chance.choice([2, 20, 600]) * NS)
    earlier = ManualBox(store, OPTIONS, options=options)
    record_some(earlier, chance.randint(0, 20), chance)
    (earlier.crash if chance.random() < 0.5 else earlier.close)()
    earlier.clock.advance(5)
    box = ManualBox(store, OPTIONS, clock=earlier.clock, options=options)
    record_some(box, writes, chance)
    record = amberbox.open(store)
    stages = [record.items()]
    for info in stages[0]:
        if not info.estimated:
            assert told([info])[info.name] == counted_by_rows(record, info.name), info
    rows = {i.name: record.query(i.name, ["seq", "received"]).to_arrow() for i in stages[0]}
    box.crash()
    stages.append(record.items())
    for condensed in range(len(journals(store)) + 1):
        for journal in journals(store)[:condensed]:
            build_segments(store, journal)
        stages.append(record.items())
    assert all(record.query(name, ["seq", "received"]).to_arrow() == t for name, t in rows.items())
    exact = told(stages[-1])
    assert set(exact) >= set(told(stages[0]))
    for items in stages:
        assert told(items).items() <= exact.items()
        sizes = {i.name: (i.bytes, i.rate_hz, i.type, i.topic) for i in items if not i.estimated}
        last = {i.name: (i.bytes, i.rate_hz, i.type, i.topic) for i in stages[-1]}
        assert sizes.items() <= last.items()
        for info in items:  # stamps are as far from receipt as those of some message
            if info.name == "ros_odom":
                table = record.query("ros_odom", ["received"])
                pairs = zip(table.values("received"), table.values("timestamp"), strict=True)
                ages = [(at - stamp) / NS for at, stamp in pairs]
                assert info.stamp_offset_s is not None
                assert min(ages) <= info.stamp_offset_s <= max(ages)


def test_child_tables_of_a_long_live_journal_are_estimated(live: ManualBox) -> None:
    record = amberbox.open(live.store)
    child = next(i for i in record.items() if i.name == "ros_odom__units")
    rows = len(record.query("ros_odom__units"))
    assert child.estimated
    assert child.to_json()["estimated"] is True
    assert rows / 2 <= child.rows <= rows * 2
    live.pipeline.rotate()
    live.hear(COUNT, number(1))
    live.write()
    build_segments_of(live.store)
    child = next(i for i in record.items() if i.name == "ros_odom__units")
    assert (child.rows, child.estimated) == (rows, False)


@fuzz
@settings(max_examples=examples(15))
@given(seed=st.integers(0, 2**32))
def test_damage_of_a_live_journal_costs_what_it_touches(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Whatever bytes change, no row is invented, and a full scan finds as many rows as the
    index.
    """
    chance = random.Random(seed)
    box = ManualBox(tmp_path_factory.mktemp("damaged") / "store", OPTIONS)
    record_some(box, 30, chance)
    path = box.pipeline.journal_paths[0]
    record = amberbox.open(box.store)
    before = record.query("ros_odom", ["seq", "pose_x"])
    known = dict(zip(before.values("seq"), before.values("pose_x"), strict=True))
    with path.open("r+b") as file:
        for _ in range(chance.randint(1, 3)):
            file.seek(chance.randrange(20, path.stat().st_size))
            file.write(bytes([chance.randrange(256)]))
    table = record.query("ros_odom", ["seq", "pose_x"])
    after = dict(zip(table.values("seq"), table.values("pose_x"), strict=True))
    assert after.items() <= known.items()
    info = next(i for i in record.items() if i.name == "ros_odom")
    assert len(after) <= info.rows <= len(known)
    box.crash()
    walked = journal_reader.describe(scan.scan(path), "journal/walked")
    assert sum(len(chunk) for chunk in sound_chunks(walked)) == walked.rows
    assert walked.items["ros_odom"] == len(after)


def test_a_chunk_that_is_just_being_written_is_not_counted(live: ManualBox, tmp_path: Path) -> None:
    path = live.pipeline.journal_paths[0]
    whole = journal_index.GrowingIndex(path).read()
    last, before = whole.places[-1], whole.places[-2]
    cut = tmp_path / "cut.mcap"
    for size in range(last.offset, path.stat().st_size, 97):
        cut.write_bytes(path.read_bytes()[:size])
        index = journal_index.GrowingIndex(cut)
        try:
            found = index.read()
        except journal_index.UnindexedError:  # then it is walked
            continue
        assert found.places[-1] in (before, last)
        if size < last.offset + 40:
            assert found.places[-1] == before


def test_items_whose_type_changes_are_counted_together(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    definition = Schema("std_msgs/UInt64", "ros1msg", b"uint64 data\n")
    other = Topic("/count", "ros1", definition)
    for value in range(40):
        box.hear(COUNT if value % 2 else other, number(value))
        box.write()
    record = amberbox.open(box.store)
    info = next(i for i in record.items() if i.name == "ros_count")
    assert (info.rows, info.bytes) == (40, 320)
    assert told([info])[info.name] == counted_by_rows(record, "ros_count")
    box.close()


@fuzz
@settings(max_examples=examples(5))
@given(seed=st.integers(0, 2**32))
def test_an_index_is_believed_or_refused(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Changed heads of chunks and of their indices end in nothing but a refusal."""
    chance = random.Random(seed)
    box = ManualBox(tmp_path_factory.mktemp("index") / "store", OPTIONS)
    record_some(box, 10, chance)
    path = box.pipeline.journal_paths[0]
    places, whole = journal_index.GrowingIndex(path).read().places, path.read_bytes()
    for _ in range(50):
        data = bytearray(whole)
        data[chance.choice(places).offset + chance.randrange(60)] = chance.randrange(256)
        path.write_bytes(data[: chance.choice([len(data), chance.randrange(9, len(data))])])
        with suppress(journal_index.UnindexedError):
            found = journal_index.GrowingIndex(path).read()
            assert len(found.places) <= len(places)
    box.crash()
