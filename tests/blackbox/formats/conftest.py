"""Recordings written with rosbags for the tests of readers."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import RecordingReader

Messages = list[tuple[str, int, bytes]]
TYPES = {"/odom": "geometry_msgs/msg/Pose", "/text": "std_msgs/msg/String"}
START_NS = 1_600_000_000_000_000_000


def read_all(path: Path) -> tuple[Messages, RecordingReader]:
    """Read a recording; return its messages by name of the topic, and its reader."""
    with open_recording(path) as recording:
        topics = recording.topics
        found = [(topics[m.topic_index].name, m.log_time_ns, m.data) for m in recording.messages()]
    return found, recording


def make_messages(count: int, seed: int = 1) -> Messages:
    """Mix a topic of fixed and one of varying length, in order of time, some at the same time."""
    rng = random.Random(seed)  # a repeatable sequence, no secret
    store = get_typestore(Stores.ROS2_HUMBLE)
    pose, point, quaternion, text = (
        store.types[f"{name}"]
        for name in (
            "geometry_msgs/msg/Pose",
            "geometry_msgs/msg/Point",
            "geometry_msgs/msg/Quaternion",
            "std_msgs/msg/String",
        )
    )
    messages, now_ns = [], START_NS
    for number in range(count):
        now_ns += rng.choice([0, 1, 999, 10_000_000])
        if rng.random() < 0.5:
            value = pose(point(rng.random(), number, 0.0), quaternion(0.0, 0.0, 0.0, 1.0))
            messages.append(("/odom", now_ns, (value, TYPES["/odom"])))
        else:
            value = text("x" * rng.randrange(0, 300) + str(number))
            messages.append(("/text", now_ns, (value, TYPES["/text"])))
    return [(topic, t, bytes(store.serialize_cdr(*content))) for topic, t, content in messages]


def write_ros1(path: Path, messages: Messages, compression: str = "", chunk: int = 4096) -> None:
    """Write a ROS 1 bag with small chunks; the bytes are written unchanged."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk
    with writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, name in TYPES.items()
        }
        for topic, time_ns, data in messages:
            writer.write(connections[topic], time_ns, data)


def write_ros2(
    path: Path,
    messages: Messages,
    storage: str,
    compression: str = "",
) -> None:
    """Write the folder of a ROS 2 bag."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, name in TYPES.items()
        }
        for topic, time_ns, data in messages:
            writer.write(connections[topic], time_ns, data)


@pytest.fixture(scope="session")
def all_messages() -> Messages:
    return make_messages(2000)


@pytest.fixture
def messages(all_messages: Messages) -> Messages:
    return list(all_messages)


@pytest.fixture
def ros1_bag() -> Callable[..., None]:
    return write_ros1


@pytest.fixture
def ros2_bag() -> Callable[..., None]:
    return write_ros2
