"""Imported recordings against rosbags and mcap: every message, every column, every value."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns import diagnostic_values
from amberbox.blackbox.columns.ros_messages import RosUnroller
from amberbox.blackbox.query.importing import import_recordings
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.store.store import open_store
from amberbox.core.names import identifier, item_name
from amberbox.core.types import ItemSchema, Schema
from tests.blackbox.columns.test_unroll_recordings import MESSAGES, TYPES, check_column, getter

HUMBLE = get_typestore(Stores.ROS2_HUMBLE)
WHOLE = [
    "plotjuggler_tilt_laser.bag",
    "plotjuggler_fake_joint_state.bag",
    "plotjuggler_rosbag2_test",
    "imu_ardrone.bag",
    "rosbagjs_example.bag",
    "rosbagjs_example-bz2.bag",
    "rosbagjs_example-lz4.bag",
]


def topics(path: Path) -> Iterator[tuple[str, ItemSchema, list[Any]]]:
    """Read a recording with rosbags: topic, the columns it must give, its messages in order."""
    with AnyReader([path], default_typestore=HUMBLE) as reader:
        for topic in sorted({connection.topic for connection in reader.connections}):
            connections = [c for c in reader.connections if c.topic == topic]
            kind, text = connections[0].msgtype, connections[0].msgdef.data
            if not text:
                text, _ = HUMBLE.generate_msgdef(kind, ros_version=2)
            encoding = "ros2msg" if reader.is2 else "ros1msg"
            schema = RosUnroller(Schema(kind, encoding, text.encode()), reader.is2).schema
            raw = [data for _, _, data in reader.messages(connections)]
            yield topic, schema, [reader.deserialize(data, kind) for data in raw]


def check_table(
    record: Record, item: str, schema: ItemSchema, messages: Sequence[Any], seqs: Sequence[int]
) -> int:
    """Compare a table with rosbags' objects, child tables too; return how many values."""
    own = ["seq"] if "__" not in item else ["parent_seq", "index"]
    table = record.query(item, [*(column.name for column in schema.columns), *own])
    assert table.values(own[0]) == list(seqs)
    assert table.names[1:] == [*(column.name for column in schema.columns), *own]
    for column in schema.columns:
        check_column(table[column.name], column.type, list(map(getter(column.path), messages)))
    compared = len(messages) * len(schema.columns)
    for path, child in schema.children.items():
        if path == diagnostic_values.PATH:  # no part of the message
            continue
        lists = list(map(getter(path), messages))
        if any(map(len, lists)):
            below = [part for items in lists for part in items]
            parents = np.repeat(seqs, [len(items) for items in lists]).tolist()
            name = f"{item}__{identifier(path)}"
            compared += check_table(record, name, child, below, parents)
    return compared


def check_import(path: Path, store: Path) -> int:
    """Import a recording and compare all of it; return how many values were compared."""
    (report,) = import_recordings([path], store)
    assert not report.damage
    record, compared, counts = amberbox.open(store), 0, {}
    for topic, schema, messages in topics(path):
        if messages:
            item = item_name("ros", topic)
            counts[item] = len(messages)
            seqs = record.query(item, ["seq"]).values("seq")
            compared += check_table(record, item, schema, messages, seqs)
    assert {item: count for item, count in report.items.items() if count} == counts
    assert report.messages == sum(counts.values())
    check_journals(store, counts)
    assert import_recordings([path], store)[0].known
    assert sum(i.rows for i in record.items() if i.name in counts) == report.messages
    return compared


def check_journals(store: Path, counts: dict[str, int]) -> None:
    """Count the finished journals with mcap's seeking reader."""
    found: Counter[str] = Counter()
    for path in open_store(store).journal_files("main"):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None and summary.statistics is not None
            read = Counter(channel.id for _, channel, _ in reader.iter_messages())
            assert read == summary.statistics.channel_message_counts
            for number, count in read.items():
                marks = summary.channels[number].metadata
                found[marks["item"]] += 0 if "repeated" in marks else count
    assert {item: found[item] for item in counts} == counts


@pytest.mark.needs_data
@pytest.mark.parametrize("name", WHOLE)
def test_recordings_are_imported_whole(shared_data: Path, tmp_path: Path, name: str) -> None:
    assert check_import(shared_data / "recordings" / name, tmp_path / "store") > 10_000


def write_ros1(path: Path) -> Path:
    with Writer(path) as bag:
        for name, make in MESSAGES.items():
            topic = f"/{name.rpartition('/')[2].lower()}"
            connection = bag.add_connection(topic, name, typestore=TYPES)
            for turn in range(30):
                bag.write(connection, 10**18 + turn, TYPES.serialize_ros1(make(turn), name))
    return path


def write_ros2(path: Path, plugin: StoragePlugin) -> Path:
    pose, point = HUMBLE.types["geometry_msgs/msg/Pose"], HUMBLE.types["geometry_msgs/msg/Point"]
    turned = HUMBLE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.5, 0.5)
    kind = "geometry_msgs/msg/Pose"
    with Ros2Writer(path, version=9, storage_plugin=plugin) as bag:
        connection = bag.add_connection("/pose", kind, typestore=HUMBLE)
        for turn in range(500):
            message = pose(point(float(turn), np.nan, np.inf), turned)
            bag.write(connection, 10**18 + turn, HUMBLE.serialize_cdr(message, kind))
    return path


def test_a_generated_ros_1_bag_is_imported_whole(tmp_path: Path) -> None:
    assert check_import(write_ros1(tmp_path / "robot.bag"), tmp_path / "store") > 5000


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_generated_ros_2_bag_is_imported_whole(tmp_path: Path, plugin: StoragePlugin) -> None:
    assert check_import(write_ros2(tmp_path / "robot", plugin), tmp_path / "store") == 3500


def check_with_rosbags(path: Path, store: Path) -> None:
    """Read the journal of a ROS 2 import with rosbags: the same messages, byte for byte."""
    import_recordings([path], store)
    (journal,) = open_store(store).journal_files("main")
    with AnyReader([path], default_typestore=HUMBLE) as reader:
        expected = {c.topic: [d for _, _, d in reader.messages([c])] for c in reader.connections}
    with AnyReader([journal]) as reader:
        found = {
            c.topic: [bytes(data) for _, _, data in reader.messages([c])]
            for c in reader.connections
            if not c.topic.startswith("amberbox/")
        }
        for connection in reader.connections:
            if connection.topic in expected:
                reader.deserialize(found[connection.topic][0], connection.msgtype)
    assert found == {topic: list(map(bytes, all_)) for topic, all_ in expected.items() if all_}


def test_rosbags_reads_the_journal_of_a_ros_2_bag(tmp_path: Path) -> None:
    check_with_rosbags(write_ros2(tmp_path / "robot", StoragePlugin.MCAP), tmp_path / "store")


@pytest.mark.needs_data
def test_rosbags_reads_the_journal_of_a_real_ros_2_bag(shared_data: Path, tmp_path: Path) -> None:
    check_with_rosbags(shared_data / "recordings/plotjuggler_rosbag2_test", tmp_path / "store")
