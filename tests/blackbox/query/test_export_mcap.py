"""MCAP with original messages: for mcap, for rosbags, and imported into a store again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns.json_schema import viewer_schema
from amberbox.blackbox.query import export_job
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import ExportReport, View
from amberbox.blackbox.store.journal_reader import journals
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Schema
from amberbox.testing.records import (
    POSE,
    T0_NS,
    FakeItem,
    FakeRun,
    build_segments_of,
    fill_store,
    pose,
)
from tests.blackbox.query.conftest import ROS1, Kind, item_like, record_robot
from tests.support.manual_recorder import COUNT, raw_messages

MS = 1_000_000


def run(store: Path, target: Path, **view: Any) -> ExportReport:
    return export(amberbox.open(store), View(**view), target, "mcap")


def messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Read with the reader of the MCAP project, by the index: topic, log, publish time, data."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in found]


def test_every_reader_finds_every_message(ros1_store: Path, tmp_path: Path) -> None:
    report = run(ros1_store, tmp_path / "out.mcap")
    assert report.counts == {"ros_map_name": 1, "ros_text": 30, "ros_range": 10}
    found = messages(tmp_path / "out.mcap")
    for topic in ("/map_name", "/text", "/range"):
        assert [m[3] for m in found if m[0] == topic] == raw_messages(ros1_store, topic)
    times = [log_ns for _, log_ns, _, _ in found]
    assert times == sorted(times)
    with (tmp_path / "out.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        file.seek(0)
        records = list(StreamReader(file, validate_crcs=True).records)
        file.seek(0)
        assert make_reader(file).get_header().profile == "ros1"
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 41
    assert sum(type(record).__name__ == "Message" for record in records) == 41
    schemas = {s.name: (s.encoding, s.data.decode()) for s in summary.schemas.values()}
    definition, _ = ROS1.generate_msgdef("sensor_msgs/msg/Range")
    assert schemas["sensor_msgs/Range"] == ("ros1msg", definition)
    latched = {c.topic for c in summary.channels.values() if c.metadata.get("latching") == "1"}
    assert latched == {"/map_name"}


def test_times_are_receipt_and_own_stamp(ros1_store: Path, tmp_path: Path) -> None:
    run(ros1_store, tmp_path / "out.mcap", items=["ros_range", "ros_text"])
    table = amberbox.open(ros1_store).query("ros_range", ["received"])
    found = [m for m in messages(tmp_path / "out.mcap") if m[0] == "/range"]
    assert [log_ns for _, log_ns, _, _ in found] == table.values("received")
    assert [publish_ns for _, _, publish_ns, _ in found] == table.values("timestamp")
    text = [m for m in messages(tmp_path / "out.mcap") if m[0] == "/text"]
    assert all(log_ns == publish_ns for _, log_ns, publish_ns, _ in text)


def test_a_clock_set_late_moves_what_came_before(tmp_path: Path) -> None:
    record = FakeRun(tmp_path / "store")
    record.clock(10, T0_NS)
    record.write([(20 + n, POSE, pose(n)) for n in range(3)])
    record.close()
    run(tmp_path / "store", tmp_path / "out.mcap")
    found = messages(tmp_path / "out.mcap")
    assert [log_ns for _, log_ns, _, _ in found] == [T0_NS + 20 + n for n in range(3)]


def test_rosbags_reads_ros2(ros2_store: Path, tmp_path: Path) -> None:
    report = run(ros2_store, tmp_path / "out.mcap")
    assert not report.notes
    types = get_typestore(Stores.EMPTY)
    with AnyReader([tmp_path / "out.mcap"], default_typestore=types) as reader:
        assert reader.message_count == 41
        latched = {}
        for connection in reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            profiles = connection.ext.offered_qos_profiles
            latched[connection.topic] = [profile.durability.name for profile in profiles]
        read: dict[str, list[Any]] = {}
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            read.setdefault(connection.topic, []).append(message)
    assert latched == {"/map_name": ["TRANSIENT_LOCAL"], "/text": [], "/range": []}
    assert [message.data for message in read["/text"]] == [f"message {n}" for n in range(30)]
    assert [m.range for m in read["/range"]] == [n / 4 for n in range(0, 30, 3)]


@pytest.mark.parametrize("fixture", ["ros1_store", "ros2_store"])
def test_it_comes_back_as_it_was(
    fixture: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    store = request.getfixturevalue(fixture)
    run(store, tmp_path / "out.mcap")
    before, after = amberbox.open(store), amberbox.open(tmp_path / "out.mcap")
    for item in ("ros_text", "ros_range", "ros_map_name"):
        names = ["received", *(c.name for c in before.variables(item).columns)]
        one, other = before.query(item, names), after.query(item, names)
        assert one.fields == other.fields
        assert all(one.values(name) == other.values(name) for name in one.names)


def test_json_comes_back_as_it_was(tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    run(tmp_path / "store", tmp_path / "out.mcap")
    before, after = amberbox.open(tmp_path / "store"), amberbox.open(tmp_path / "out.mcap")
    for item in ("odom", "odom__units", "battery"):
        one, other = before.query(item), after.query(item_like(after, item))
        names = [name for name in one.names if name != "parent_seq"]
        assert all(one.values(name) == other.values(name) for name in names)


def test_a_window_begins_with_what_was_latched(ros1_store: Path, tmp_path: Path) -> None:
    start, stop = (
        amberbox.open(ros1_store).query("ros_text", ["received"]).values("received")[20:22]
    )
    report = run(ros1_store, tmp_path / "out.mcap", windows=[(start, stop)])
    (name, text) = messages(tmp_path / "out.mcap")
    assert name[:2] == ("/map_name", start) and name[3] == Kind("std_msgs/msg/String").encode(
        "hall"
    )
    assert text[:2] == ("/text", start)
    assert report.counts == {"ros_text": 1}
    assert report.notes == ["ros_map_name is latched: its last message stands at the start again"]
    run(ros1_store, tmp_path / "text.mcap", windows=[(start, stop)], items=["ros_text"])
    assert len(messages(tmp_path / "text.mcap")) == 1


def test_what_was_latched_in_an_earlier_file_is_found(tmp_path: Path) -> None:
    record_robot(tmp_path / "store", seconds=3, rotate_s=1).close()
    last = amberbox.open(tmp_path / "store").last_ns()
    assert last is not None and len(journals(tmp_path / "store")) > 2
    run(tmp_path / "store", tmp_path / "out.mcap", windows=[(last - 550 * MS, None)])
    first, *rest = messages(tmp_path / "out.mcap")
    assert (first[0], first[3]) == ("/map_name", Kind("std_msgs/msg/String").encode("hall"))
    assert {topic for topic, _, _, _ in rest} == {"/text", "/range"}


def test_the_box_itself_only_when_asked(ros1_store: Path, tmp_path: Path) -> None:
    run(ros1_store, tmp_path / "out.mcap", with_box=True)
    own = {m[0] for m in messages(tmp_path / "out.mcap") if m[0].startswith("amberbox/")}
    assert {"amberbox/run", "amberbox/clock"} <= own
    run(ros1_store, tmp_path / "run.mcap", items=["amberbox_run"])
    (message,) = messages(tmp_path / "run.mcap")
    assert (message[0], json.loads(message[3])["writer"]) == ("amberbox/run", "main")


def test_items_without_originals_are_named(tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    build_segments_of(tmp_path / "store")
    first, _, _ = journals(tmp_path / "store")
    first.path.unlink()
    report = run(tmp_path / "store", tmp_path / "out.mcap")
    assert report.counts == {"battery": 20, "odom": 200}
    assert len(report.missing) == 2
    assert report.missing[1].startswith(
        "odom: original messages from 2026-09-21T14:13:20.000000000Z to "
        "2026-09-21T14:13:20.990000000Z are deleted; their columns (100 rows) are left"
    )
    whole = run(tmp_path / "store", tmp_path / "out.mcap", windows=[(T0_NS + 1000 * MS, None)])
    assert not whole.missing
    for journal in journals(tmp_path / "store"):
        if journal.finished:
            journal.path.unlink()
        else:
            journal.path.write_bytes(b"")
    with pytest.raises(AmberboxError, match="no original messages of these items") as error:
        run(tmp_path / "store", tmp_path / "out.mcap", items=["odom"])
    assert "export mcap-json, csv or parquet" in error.value.hint


def test_damage_is_named(ros1_store: Path, tmp_path: Path) -> None:
    (journal,) = journals(ros1_store)
    place = journal.places[5]
    content = bytearray(journal.path.read_bytes())
    content[place.offset + 60 : place.offset + 70] = bytes(10)
    journal.path.write_bytes(content)
    report = run(ros1_store, tmp_path / "out.mcap")
    assert 30 < report.total < 41
    assert report.missing == [f"{journal.name}: {place.count} messages or more are damaged"]


def test_writers_and_runs_come_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export_job, "SLICE_ROWS", 60)
    items = [FakeItem(name, [{"n": 1}]) for name in ("a", "b")]
    for run_number in range(2):
        for writer, item, start in (("main", items[0], 0), ("ring", items[1], 5)):
            record = FakeRun(tmp_path / "store", writer)
            at_ns = T0_NS + run_number * 3000 * MS + start * MS
            record.write([(at_ns + 10 * n * MS, item, {"n": n}) for n in range(200)])
            record.close()
    done: list[float] = []
    export(amberbox.open(tmp_path / "store"), View(), tmp_path / "out.mcap", "mcap", done.append)
    found = messages(tmp_path / "out.mcap")
    assert [m[0] for m in found] == ["/a", "/b"] * 400
    times = [m[1] for m in found]
    assert times == sorted(times) and len(found) == 800
    assert len(done) > 8 and done == sorted(done) and done[-1] == 1.0


def test_a_large_message_has_a_chunk_of_its_own(tmp_path: Path) -> None:
    kind = Kind("std_msgs/msg/String")
    box = record_robot(tmp_path / "store", seconds=1)
    box.hear(kind.topic("/text"), kind.encode("x" * 3_000_000))
    box.write()
    box.close()
    run(tmp_path / "store", tmp_path / "out.mcap")
    assert max(len(data) for *_, data in messages(tmp_path / "out.mcap")) == 3_000_004


def test_messages_are_whole(ros1_store: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="whole, not single variables"):
        run(ros1_store, tmp_path / "out.mcap", variables={"ros_range": ["range"]})
    with pytest.raises(UsageError, match="by time of receipt"):
        run(ros1_store, tmp_path / "out.mcap", by="timestamp")
    with pytest.raises(UsageError, match="no data item 'ros_rangé'"):
        run(ros1_store, tmp_path / "out.mcap", items=["ros_rangé"])


def test_a_child_table_brings_its_messages(tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    report = run(tmp_path / "store", tmp_path / "out.mcap", items=["odom__units"])
    assert report.counts == {"odom": 300}


def test_an_item_whose_messages_have_no_columns_is_exported(tmp_path: Path) -> None:
    box = record_robot(tmp_path / "store", seconds=1)
    odd = COUNT.__class__("/odd", "ros1", Schema("odd/Type", "ros1msg", b"what is this"))
    box.hear(odd, b"1234")
    box.write()
    box.close()
    assert run(tmp_path / "store", tmp_path / "out.mcap", items=["ros_odd"]).total == 1
    assert messages(tmp_path / "out.mcap")[0][3] == b"1234"


def plain_schemas(document: Any) -> Iterator[Any]:
    """Give every schema in a document."""
    yield document
    for inner in [
        *document.get("properties", {}).values(),
        *([document["items"]] if "items" in document else []),
    ]:
        yield from plain_schemas(inner)


def test_schemas_of_json_are_such_that_viewers_read_them(tmp_path: Path) -> None:
    record = FakeRun(tmp_path / "store")
    odd = {"f": 1.5, "mixed": 1, "list": [1.5, None], "empty": [], "deep": {"a": True, "b": [[1]]}}
    item = FakeItem("odd", [odd, {"mixed": "text", "units": [{"id": 1}]}])
    record.write([(T0_NS, item, odd)])
    record.close()
    run(tmp_path / "store", tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (schema,) = summary.schemas.values()
    document = json.loads(schema.data)
    assert set(document["properties"]) == {"f", "list", "deep", "units"}
    for part in plain_schemas(document):
        assert part["type"] in ("object", "array", "boolean", "integer", "number", "string")
        assert ("properties" in part) == (part["type"] == "object")
        assert ("items" in part) == (part["type"] == "array")


def test_schemas_that_viewers_cannot_read_are_left_out() -> None:
    for document in ({"type": ["object", "array"]}, {"type": "integer"}, ["x"], {}):
        assert viewer_schema(Schema("a", "jsonschema", msgspec.json.encode(document))) is None
    assert viewer_schema(Schema("a", "jsonschema", b"{")) is None
    assert viewer_schema(None) is None
    ros = Schema("a/B", "ros1msg", b"int8 x")
    assert viewer_schema(ros) is ros


def test_positions_are_kept(ros1_store: Path, tmp_path: Path) -> None:
    run(ros1_store, tmp_path / "out.mcap", items=["ros_text"])
    with (tmp_path / "out.mcap").open("rb") as file:
        numbers = [m.sequence for _, _, m in make_reader(file).iter_messages()]
    expected = amberbox.open(ros1_store).query("ros_text", ["seq"]).values("seq")
    assert numbers == expected and np.all(np.diff(numbers) > 0)
