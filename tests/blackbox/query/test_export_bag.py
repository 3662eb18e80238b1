"""ROS 1 bags: for rosbags, and back into a store; definitions and sums as ROS has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns.ros1_text import md5sum
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import ExportOptions, ExportReport, View
from amberbox.blackbox.query.export_messages import MessageStream
from amberbox.blackbox.store.batches import ItemStream
from amberbox.blackbox.store.catalogue import StoreCatalogue
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic
from amberbox.testing.records import fill_store
from tests.blackbox.query.conftest import ROS1, Kind, record_robot
from tests.support.manual_recorder import raw_messages


def run(store: Path, target: Path, **view: Any) -> ExportReport:
    return export(amberbox.open(store), View(**view), target, "bag")


def test_rosbags_reads_every_message(ros1_store: Path, tmp_path: Path) -> None:
    report = run(ros1_store, tmp_path / "out.bag")
    assert not report.missing
    assert report.counts == {"ros_map_name": 1, "ros_text": 30, "ros_range": 10}
    with Reader(tmp_path / "out.bag") as reader:
        found = [(c.topic, at_ns, bytes(data)) for c, at_ns, data in reader.messages()]
        connections = {c.topic: c for c in reader.connections}
    for topic in connections:
        assert [m[2] for m in found if m[0] == topic] == raw_messages(ros1_store, topic)
    received = amberbox.open(ros1_store).query("ros_text", ["received"]).values("received")
    assert [at_ns for topic, at_ns, _ in found if topic == "/text"] == received
    definition, md5 = ROS1.generate_msgdef("sensor_msgs/msg/Range")
    assert connections["/range"].digest == md5
    assert connections["/range"].msgdef.data == definition
    marks = {topic: connection.ext for topic, connection in connections.items()}
    assert marks["/map_name"] == ConnectionExtRosbag1("/amberbox", 1)
    assert marks["/text"] == ConnectionExtRosbag1("/amberbox", 0)


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_it_comes_back_as_it_was(
    ros1_store: Path, tmp_path: Path, compression: Literal["none", "bz2", "lz4"]
) -> None:
    view, target = View(), tmp_path / "out.bag"
    options = ExportOptions(compression=compression)
    export(amberbox.open(ros1_store), view, target, "bag", options=options)
    before, after = amberbox.open(ros1_store), amberbox.open(target)
    for item in ("ros_text", "ros_range", "ros_map_name"):
        names = ["received", *(c.name for c in before.variables(item).columns)]
        one, other = before.query(item, names), after.query(item, names)
        assert one.fields == other.fields
        assert all(one.values(name) == other.values(name) for name in one.names)


def test_ros2_becomes_ros1(ros2_store: Path, tmp_path: Path) -> None:
    report = run(ros2_store, tmp_path / "out.bag")
    assert not report.missing and not report.notes
    with AnyReader([tmp_path / "out.bag"]) as reader:
        digests = {c.topic: c.digest for c in reader.connections}
        read: dict[str, list[Any]] = {}
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            read.setdefault(connection.topic, []).append(message)
    assert digests["/range"] == ROS1.generate_msgdef("sensor_msgs/msg/Range")[1]
    assert [message.data for message in read["/text"]] == [f"message {n}" for n in range(30)]
    assert [m.range for m in read["/range"]] == [n / 4 for n in range(0, 30, 3)]
    assert read["/range"][0].header.seq == 0
    before = amberbox.open(ros2_store).query("ros_range")
    assert amberbox.open(tmp_path / "out.bag").query("ros_range").values("timestamp") == (
        before.values("timestamp")
    )


def test_what_cannot_be_in_a_bag_is_named(ros1_store: Path, tmp_path: Path) -> None:
    box = record_robot(ros1_store, cdr=True, seconds=1)
    wide = Schema("odd/msg/Wide", "ros2msg", b"wstring text")
    box.hear(Topic("/wide", "cdr", wide), b"\0\1\0\0" + bytes(8))
    box.write()
    box.close()
    fill_store(tmp_path / "json")
    report = run(ros1_store, tmp_path / "out.bag")
    (missing,) = report.missing
    assert missing.startswith("ros_wide cannot be in a ROS 1 bag: odd/msg/Wide has no form")
    assert "ros_wide" not in report.counts
    with pytest.raises(AmberboxError, match="none of these items can be") as error:
        run(tmp_path / "json", tmp_path / "json.bag")
    assert "its messages are json, not of ROS" in error.value.hint
    assert not list(tmp_path.glob("*.part")) and not (tmp_path / "json.bag").exists()


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_latched_messages_outlive_the_file_they_came_in(tmp_path: Path, form: str) -> None:
    record_robot(tmp_path / "store", seconds=3, rotate_s=1).close()
    first, *_ = sorted((tmp_path / "store" / "journal").glob("*.mcap"))
    first.unlink()
    record = amberbox.open(tmp_path / "store")
    times = record.query("ros_text", ["received"]).values("received")
    for window, count in ((None, None), 1), ((times[5], None), 0):
        target = tmp_path / f"{count}.{form}"
        report = export(record, View(windows=[window]), target, form)
        assert report.counts.get("ros_map_name", 0) == count
        found = amberbox.open(target).query("ros_map_name")
        assert found.values("data") == ["hall"]


def test_a_topic_that_begins_during_the_export_is_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = record_robot(tmp_path / "store", seconds=1)
    late = Kind("std_msgs/msg/String")

    def streams_and_one_more(self: MessageStream, catalogue: StoreCatalogue) -> list[ItemStream]:
        found = listed(self, catalogue)
        box.hear(late.topic("/late"), late.encode("late"))
        box.write()
        return found

    listed = MessageStream.streams
    monkeypatch.setattr(MessageStream, "streams", streams_and_one_more)
    report = run(tmp_path / "store", tmp_path / "out.bag")
    box.close()
    assert report.counts["ros_late"] == 1


def test_both_versions_of_a_topic_are_one_connection(ros1_store: Path, tmp_path: Path) -> None:
    record_robot(ros1_store, cdr=True, seconds=1).close()
    run(ros1_store, tmp_path / "out.bag", items=["ros_text"])
    with Reader(tmp_path / "out.bag") as reader:
        assert [c.topic for c in reader.connections] == ["/text"]
        assert reader.message_count == 40


def test_a_type_that_ros1_has_otherwise_is_named(tmp_path: Path) -> None:
    box = record_robot(tmp_path / "store", seconds=0)
    kind = Kind("diagnostic_msgs/msg/KeyValue", cdr=True)
    box.hear(kind.topic("/same"), kind.encode("a", "b"))
    other = Schema("diagnostic_msgs/msg/KeyValue", "ros2msg", b"string key\nstring value\nint8 x\n")
    box.hear(Topic("/other", "cdr", other), b"\0\1\0\0" + b"\2\0\0\0a\0\0\0\2\0\0\0b\0\7")
    box.write()
    box.close()
    report = run(tmp_path / "store", tmp_path / "out.bag", items=["ros_same", "ros_other"])
    assert report.notes == [
        "ros_other: diagnostic_msgs/msg/KeyValue differs from that of ROS 1, whose nodes refuse it"
    ]
    assert report.total == 2


def test_messages_that_do_not_convert_are_counted_out(tmp_path: Path) -> None:
    box = record_robot(tmp_path / "store", cdr=True, seconds=1)
    kind = Kind("std_msgs/msg/String", cdr=True)
    box.hear(kind.topic("/text"), b"\0\1\0\0\xff\0\0\0")
    box.write()
    box.close()
    report = run(tmp_path / "store", tmp_path / "out.bag", items=["ros_text"])
    assert report.counts == {"ros_text": 10}
    assert report.missing[0].startswith("ros_text: messages that do not convert to ROS 1")


def test_a_written_chunk_is_forgotten(tmp_path: Path) -> None:
    """rosbags keeps time and place of every message until the end; we keep their number."""
    from amberbox.blackbox.query.export import bag_writer

    kind = Kind("std_msgs/msg/String")
    with bag_writer(tmp_path / "out.bag", "none") as writer:
        writer.chunk_threshold = 1000
        connection = writer.add_connection("/text", kind.name, typestore=ROS1)
        for number in range(200):
            writer.write(connection, number, kind.encode("x" * 50))
        kept = [at for chunk in writer.chunks[:-1] for at in chunk.connections.values()]
    assert len(kept) > 10 and all(isinstance(at, range) for at in kept)
    with Reader(tmp_path / "out.bag") as reader:
        assert reader.message_count == 200
        assert [at_ns for _, at_ns, _ in reader.messages()] == list(range(200))


@pytest.mark.parametrize(
    "name",
    [
        *("std_msgs/msg/String", "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"),
        *("sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/Imu"),
        *("diagnostic_msgs/msg/DiagnosticArray", "visualization_msgs/msg/MarkerArray"),
    ],
)
def test_md5_sums_are_those_of_ros(name: str) -> None:
    """rosbags has the sums of ROS; types with constants are among them."""
    types = get_typestore(Stores.ROS1_NOETIC)
    text, md5 = types.generate_msgdef(name)
    schema = Schema(name.replace("/msg/", "/"), "ros1msg", text.encode())
    assert md5sum(schema) == md5


LOG = """##
## Severity level constants
##
byte DEBUG=1 #debug level
byte INFO=2  #general level
byte WARN=4  #warning level
byte ERROR=8 #error level
byte FATAL=16 #fatal/critical level
##
## Fields
##
Header header
byte level
string name # name of the node
string msg # message
string file # file the message came from
string function # function the message came from
uint32 line # line the message came from
string[] topics # topic names that the node publishes

{line}
MSG: std_msgs/Header
# Standard metadata
uint32 seq
time stamp
string frame_id
""".replace("{line}", "=" * 80)


@pytest.mark.parametrize("header", ["std_msgs/Header", "roslib/Header"])
def test_md5_of_a_definition_as_it_is_written(header: str) -> None:
    """The sum of rosgraph_msgs/Log as ``rosmsg md5`` prints it: comments do not count."""
    text = LOG.replace("std_msgs/Header", header)
    schema = Schema("rosgraph_msgs/Log", "ros1msg", text.encode())
    assert md5sum(schema) == "acffd30cd6b6de30f120938c17c593fb"


def test_md5_of_constant_text_counts_to_the_end_of_the_line() -> None:
    first = Schema("a/B", "ros1msg", b"string X=  some # text \nint8 y")
    second = Schema("a/B", "ros1msg", b"string X=some # text \nint8   y  # comment")
    third = Schema("a/B", "ros1msg", b"string X=some\nint8 y")
    assert md5sum(first) == md5sum(second) != md5sum(third)
    with pytest.raises(AmberboxError, match="a/C is missing"):
        md5sum(Schema("a/B", "ros1msg", b"C[] c"))


def test_numbers_are_kept(tmp_path: Path) -> None:
    box = record_robot(tmp_path / "store", cdr=True, seconds=0)
    kind = Kind("std_msgs/msg/Float32MultiArray", cdr=True)
    layout = kind.types.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    values = np.array([1.5, np.nan, np.inf], np.float32)
    box.hear(kind.topic("/list"), kind.encode(layout, values))
    box.write()
    box.close()
    run(tmp_path / "store", tmp_path / "out.bag", items=["ros_list"])
    with AnyReader([tmp_path / "out.bag"]) as reader:
        ((connection, _, data),) = reader.messages()
        message: Any = reader.deserialize(data, connection.msgtype)
        np.testing.assert_array_equal(message.data, values)
