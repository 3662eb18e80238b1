"""A bag that we wrote, for ROS's own ``rosbag info`` and ``rosbag play``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import Compression, ExportOptions, View
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import ManualBox
from tests.support.ros_nodes import PYTHON, Ros, end

LISTENER = Path(__file__).with_name("listener.py")
TYPES = get_typestore(Stores.ROS1_NOETIC)
STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"


def topic(name: str, kind: str, latched: bool = False) -> Topic:
    text, _ = TYPES.generate_msgdef(kind)
    return Topic(
        name, "ros1", Schema(kind.replace("/msg/", "/"), "ros1msg", text.encode()), latched
    )


def encode(kind: str, *values: Any) -> bytes:
    return bytes(TYPES.serialize_ros1(TYPES.types[kind](*values), kind))


def exported(
    folder: Path, compression: Compression = "none"
) -> tuple[Path, dict[str, list[bytes]]]:
    """Record a latched name, 20 texts, 20 speeds within a second; return bag and messages."""
    box, sent = ManualBox(folder / "store"), {"/name": [encode(STRING, "hall")]}
    vector = TYPES.types["geometry_msgs/msg/Vector3"]
    box.hear(topic("/name", STRING, latched=True), *sent["/name"])
    for number in range(20):
        text = encode(STRING, f"text {number}")
        speed = encode(TWIST, vector(number / 2, 0.0, 0.0), vector(0.0, 0.0, 1.0))
        box.hear(topic("/text", STRING), text)
        box.hear(topic("/speed", TWIST), speed)
        sent.setdefault("/text", []).append(text)
        sent.setdefault("/speed", []).append(speed)
        box.write(0.05)
    box.close()
    options = ExportOptions(compression=compression)
    export(amberbox.open(box.store), View(), folder / "out.bag", "bag", options=options)
    return folder / "out.bag", sent


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_rosbag_info_reads_it(ros: Ros, tmp_path: Path, compression: Compression) -> None:
    bag, _ = exported(tmp_path, compression)
    printed = ros.processes.output(["/usr/bin/rosbag", "info", "--yaml", str(bag)], ros.port)
    facts = yaml.safe_load(printed)
    assert (facts["messages"], facts["indexed"], facts["version"]) == (41, True, 2.0)
    assert facts["compression"] == compression
    topics = {found["topic"]: (found["type"], found["messages"]) for found in facts["topics"]}
    assert topics == {
        "/name": ("std_msgs/String", 1),
        "/speed": ("geometry_msgs/Twist", 20),
        "/text": ("std_msgs/String", 20),
    }
    sums = {found["type"]: found["md5"] for found in facts["types"]}
    assert sums["geometry_msgs/Twist"] == TYPES.generate_msgdef(TWIST)[1]


def test_rosbag_play_publishes_every_message(ros: Ros, tmp_path: Path) -> None:
    bag, sent = exported(tmp_path)
    ros.master()
    heard = tmp_path / "heard.jsonl"
    ros.processes.start([PYTHON, str(LISTENER), str(heard), *sent], ros.port)
    play = ["/usr/bin/rosbag", "play", "--wait-for-subscribers", "-d", "0.5", "-k", "-r", "2"]
    player = ros.processes.start([*play, str(bag)], ros.port)
    try:
        wait_until(lambda: heard.exists() and count(heard) >= 41, "41 messages are heard")
    finally:
        end(player)  # it ends its own child, which kill -9 would leave behind
    lines = [json.loads(line) for line in heard.read_text().splitlines()]
    for name, messages in sent.items():
        assert [bytes.fromhex(line["data"]) for line in lines if line["topic"] == name] == messages
    assert {line["topic"] for line in lines if line["latching"] == "1"} == {"/name"}
    kinds = {line["topic"]: (line["type"], line["md5"]) for line in lines}
    assert kinds["/speed"] == ("geometry_msgs/Twist", TYPES.generate_msgdef(TWIST)[1])


def count(path: Path) -> int:
    return path.read_text().count("\n")
