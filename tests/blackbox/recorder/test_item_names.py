"""Names of items and columns: unique, the same in every run, and the paper's as printed there."""

from __future__ import annotations

import csv
import io
import random
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.cli.main import main
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import COUNT, ManualBox, number

TYPES = get_typestore(Stores.ROS1_NOETIC)
ALIKE = ("/a/b_c", "/a_b/c", "/a/b/c", "/A/b_c", "/a b/c", "/a.b_c", "/a_b_c")


def ros_topic(name: str, kind: str) -> Topic:
    text, _ = TYPES.generate_msgdef(kind)
    return Topic(name, "ros1", Schema(kind.replace("/msg/", "/"), "ros1msg", text.encode()))


def names_given(box: ManualBox, topics: list[str]) -> dict[str, str]:
    """Receive a message of each topic in this order; return the names of the items."""
    for n, topic in enumerate(topics):
        box.hear(Topic(topic, COUNT.message_encoding, COUNT.schema), number(n))
    box.write()
    return {item.topic: item.name for item in box.pipeline.items.values()}


@pytest.mark.parametrize("seed", range(5))
def test_names_differ_and_stay_whoever_comes_first(tmp_path: Path, seed: int) -> None:
    rng, clock = random.Random(seed), ManualClock()
    known: dict[str, str] = {}
    for run in range(4):
        topics = rng.sample(ALIKE, len(ALIKE) if run == 3 else 4)
        box = ManualBox(tmp_path / "store", clock=clock)
        found = names_given(box, topics)
        assert all(known.get(topic, name) == name for topic, name in found.items())
        known.update(found)
        box.crash() if run % 2 else box.close()
    assert len({name.casefold() for name in known.values()}) == len(ALIKE)
    record = amberbox.open(tmp_path / "store")
    assert {item.topic: item.name for item in record.items() if item.source == "ros"} == known


def test_the_papers_pose_has_exactly_its_eight_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = "geometry_msgs/msg/Pose"
    point = TYPES.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    turned = TYPES.types["geometry_msgs/msg/Quaternion"](0.1, 0.2, 0.3, 0.4)
    message = TYPES.types[kind](point, turned)
    box = ManualBox(tmp_path / "store")
    box.hear(ros_topic("/pose", kind), bytes(TYPES.serialize_ros1(message, kind)))
    heard_ns = box.clock.wall
    box.close()
    assert main(["query", str(box.store), "ros_pose", "--format", "csv"]) == 0
    header, row = csv.reader(io.StringIO(capsys.readouterr().out))
    assert header == [
        "timestamp",
        "position_x", "position_y", "position_z",
        "orientation_x", "orientation_y", "orientation_z", "orientation_w",
    ]  # fmt: skip
    assert list(map(float, row[1:])) == [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.4]
    assert amberbox.open(box.store).query("ros_pose").values("timestamp") == [heard_ns]


def test_the_papers_listing_chooses_its_variables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = ["pose/pose/position/x", "pose/pose/position/y"]
    options = [TopicOptions("/ropod/odom", "nav_msgs/Odometry", chosen, max_frequency=5)]
    box = ManualBox(tmp_path / "store", options)
    topic = ros_topic("/ropod/odom", "nav_msgs/msg/Odometry")
    header = (7).to_bytes(4, "little") + (12).to_bytes(4, "little") + (34).to_bytes(4, "little")
    strings = bytes(8)
    numbers = bytes((7 + 36 + 6 + 36) * 8)
    for _ in range(100):
        box.hear(topic, header + strings + numbers)
        box.write(0.05)
    box.close()
    assert main(["query", str(box.store), "ros_ropod_odom", "--format", "csv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "timestamp,pose_pose_position_x,pose_pose_position_y"
    assert 25 <= len(lines) - 1 <= 36  # 5 Hz for 5 s, and the burst that is let through
    record = amberbox.open(box.store)
    assert record.query("ros_ropod_odom").values("timestamp")[0] == 12_000_000_034
    assert len(record.variables("ros_ropod_odom").columns) > 80  # the raw message is whole
