"""From a robot of ROS 2 into a record, and out again: columns, MCAP, what a stall costs."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import foxglove
import pytest
import yaml
from foxglove import Context
from foxglove import messages as fox
from foxglove.channels import FrameTransformChannel
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.formats._ros2_types import is_latched
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import View
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.cli.main import main
from amberbox.testing.clock import wait_until
from tests.peers.ros2.robot import odometry
from tests.support.manual_recorder import (
    event_texts,
    last_counters,
    raw_messages,
    recording,
)
from tests.support.processes import running
from tests.support.ros2_robots import OVER_DDS, Ros2Robot, Way, digests, recorded, robot_of

WAYS: tuple[Way, ...] = ("bridge", "zenoh")
ODOMETRY, NUMBER = "nav_msgs/msg/Odometry", "std_msgs/msg/Int64"
WHEEL = "my_robot/msg/Wheel"
WHEEL_TEXT = "std_msgs/Header header\nfloat64 speed\nuint8 STUCK=2\nuint8 state\n"


@pytest.fixture(params=WAYS)
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ros2Robot]:
    with robot_of(request.param, tmp_path) as made:
        yield made


def folder_of(place: Path, block: dict[str, Any], *, store: str = "") -> Path:
    folder = place / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text(f"id: r\n{store}")
    (folder / "black_box.yaml").write_text(yaml.safe_dump([{"ros2": block}]))
    return folder


def heard(store: Path, item: str) -> int:
    """Return how many messages of an item were received, or counted as lost before the box."""
    counters = last_counters(store).get(item, {}) if (store / "run").exists() else {}
    return counters.get("received", 0) + counters.get("lost", 0)


def test_values_are_those_sent_and_leave_as_they_came(robot: Ros2Robot, tmp_path: Path) -> None:
    robot.offer("/odom", ODOMETRY)
    robot.offer("/map", NUMBER, latched=True)
    robot.publish("/map", 1)
    folder = folder_of(tmp_path, robot.block(topics=[{"topic": {"name": "/**"}}]))
    with recording(folder) as recorder:
        robot.publish_heard("/odom", 200, rate_hz=400)
        items = recorder.pipeline.items
        wait_until(lambda: "ros2_odom" in items and items["ros2_odom"].counters.kept == 200)
        if robot.way == "zenoh":  # a bridge delivers nothing from before
            wait_until(lambda: "ros2_map" in items and items["ros2_map"].counters.kept == 1)
    record, count = amberbox.open(folder), range(1, 201)
    table = record.query("ros2_odom", ["pose_pose_position_x", "child_frame_id", "timestamp"])
    assert table.values("pose_pose_position_x") == [number / 4 for number in count]
    assert set(table.values("child_frame_id")) == {"base"}
    assert table.values("timestamp") == [(1_700_000_000 + n) * 10**9 + 250 for n in count]
    target = tmp_path / "out.mcap"
    report = export(record, View(), target, "mcap")
    assert not report.missing
    with target.open("rb") as file:
        found = [(c.topic, m.data, c.metadata) for _, c, m in make_reader(file).iter_messages()]
    assert [data for topic, data, _ in found if topic == "/odom"] == [odometry(n) for n in count]
    qos = [marks["offered_qos_profiles"] for topic, _, marks in found if topic == "/map"]
    assert [is_latched(profiles) for profiles in qos] == ([] if robot.way == "bridge" else [True])
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([target], default_typestore=store) as reader:
        read: list[Any] = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic == "/odom"
        ]
    assert [message.pose.pose.position.x for message in read] == [n / 4 for n in count]


@pytest.mark.parametrize("way", ["zenoh", *OVER_DDS])
def test_a_latched_message_is_recorded_once(
    way: Way, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """It is delivered again to each new subscriber: after a restart of the recorder, too."""
    if way == "fastdds":
        request.getfixturevalue("fast_dds")
    with robot_of(way, tmp_path) as robot:
        robot.offer("/map", NUMBER, latched=True)
        robot.publish("/map", 1)
        folder = folder_of(tmp_path, robot.block(all_topics=True))
        store = folder / "store"
        for run in range(3):
            with recording(folder):
                wait_until(partial(is_heard_for, store, run))
        robot.publish("/map", 1)
        with recording(folder):
            wait_until(lambda: len(raw_messages(store, "/map")) == 2)
    assert digests(raw_messages(store, "/map")) == robot.sent("/map")


def is_heard_for(store: Path, run: int) -> bool:
    """Return whether the message was recorded in run 0, and left out in the later ones."""
    if not run:
        return heard(store, "ros2_map") == 1
    return len(event_texts(store, "ros2_latched_repeat")) == run


def test_own_types_and_types_of_another_version(robot: Ros2Robot, tmp_path: Path) -> None:
    """Definitions come from the wire or from a folder; one with another hash is not used."""
    place = tmp_path / "robot" / "types" / "my_robot" / "msg"
    old = "std_msgs/Header header\nfloat32 speed\n"
    robot.offer("/wheel", WHEEL, definition=_with_header(WHEEL_TEXT))
    robot.offer("/old_wheel", "my_robot/msg/Old", definition=_with_header(old))
    folder = folder_of(tmp_path, robot.block(all_topics=True, definitions=["types"]))
    place.mkdir(parents=True)
    (place / "Wheel.msg").write_text(WHEEL_TEXT)
    (place / "Old.msg").write_text(WHEEL_TEXT)
    bytes_sent = bytes.fromhex("00010000" + "01000000" * 2 + "0200000061000000") + bytes(9)
    with recording(folder) as recorder:
        robot.order("wait", topics=["/wheel", "/old_wheel"])
        for name in ("/wheel", "/old_wheel"):
            robot.order("raw", topic=name, data=bytes_sent.hex())
        for item in ("ros2_wheel", "ros2_old_wheel"):
            wait_until(partial(is_kept, recorder, item))
    record = amberbox.open(folder)
    columns = {column.name: column for column in record.variables("ros2_wheel").columns}
    assert columns["state"].labels == {2: "STUCK"}
    assert record.query("ros2_wheel", ["header_frame_id"]).values("header_frame_id") == ["a"]
    assert raw_messages(folder / "store", "/old_wheel") == [bytes_sent]
    problems = event_texts(folder / "store", "ros2_no_definition")
    expected = [] if robot.way == "bridge" else ["/old_wheel: my_robot/msg/Old: the robot uses an"]
    assert [text[:47] for text in problems] == expected


def is_kept(recorder: Recorder, item: str, count: int = 1) -> bool:
    items = recorder.pipeline.items
    return item in items and items[item].counters.kept == count


def _with_header(text: str) -> str:
    separator = "=" * 80
    header = "builtin_interfaces/Time stamp\nstring frame_id\n"
    time = "int32 sec\nuint32 nanosec\n"
    parts = [text, f"MSG: std_msgs/Header\n{header}", f"MSG: builtin_interfaces/Time\n{time}"]
    return f"{separator}\n".join(parts)


def test_a_recorder_that_stands_still_loses_nothing_uncounted(
    robot: Ros2Robot, tmp_path: Path
) -> None:
    """Four seconds at 1 kHz while recorder and source are frozen."""
    robot.offer("/count", NUMBER)
    folder = folder_of(tmp_path, robot.block(topics=[{"topic": {"name": "/count"}}]))
    store = folder / "store"
    with running("record", folder, log=tmp_path / "log") as process:
        robot.publish_heard("/count", 10)
        wait_until(lambda: heard(store, "ros2_count") == 10)
        family = [process.pid, *_children(process.pid)]
        for pid in family:
            os.kill(pid, signal.SIGSTOP)
        robot.publish("/count", 4000, rate_hz=1000)
        for pid in family:
            os.kill(pid, signal.SIGCONT)
        robot.publish("/count", 10)
        wait_until(lambda: heard(store, "ros2_count") == 4020)
    received = raw_messages(store, "/count")
    lost = 4020 - len(received)
    assert digests(received) == [d for d in robot.sent("/count") if d in set(digests(received))]
    assert lost == last_counters(store)["ros2_count"].get("lost", 0)


def _children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_parameters_are_recorded_when_they_change(tmp_path: Path) -> None:
    """Also those that change after the bridge was gone and has come back."""
    with robot_of("bridge", tmp_path) as robot:
        robot.order("set", name="/talker.speed", value=1.5)
        robot.order("set", name="/talker.mode", value="slow")
        robot.offer("/count", NUMBER)
        folder = folder_of(tmp_path, robot.block(all_topics=True))
        with recording(folder) as recorder:
            wait_until(partial(is_kept, recorder, "ros2_parameters", 2))
            robot.publish_heard("/count", 1)  # it has taken the subscription to parameters before
            robot.order("set", name="/talker.speed", value=2.5)
            robot.order("set", name="/talker.speed", value=2.5)
            wait_until(partial(is_kept, recorder, "ros2_parameters", 3))
            robot.kill()
            with robot_of("bridge", tmp_path, robot.port) as second:
                second.order("set", name="/talker.speed", value=3.5)
                second.offer("/count", NUMBER)
                second.publish_heard("/count", 1)
                wait_until(partial(is_kept, recorder, "ros2_parameters", 4))
                second.order("set", name="/talker.speed", value=4.5)
                wait_until(partial(is_kept, recorder, "ros2_parameters", 5))
        rows = amberbox.open(folder).query("ros2_parameters", ["name", "value", "number"])
    found = list(zip(rows.values("name"), rows.values("value"), strict=True))
    assert [value for name, value in found if name == "/talker.mode"] == ["slow"]
    speeds = ["1.5", "2.5", "3.5", "4.5"]
    assert [value for name, value in found if name == "/talker.speed"] == speeds
    assert rows.values("number")[-1] == 4.5


def test_check_names_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from amberbox.blackbox.sources.ros2_transports import options

    monkeypatch.setattr(options, "find_spec", lambda name: None)
    folder = folder_of(tmp_path, {"via": "zenoh", "all_topics": True, "url": "ws://a:1"})
    assert main(["check", str(folder)]) == 0
    shown = capsys.readouterr()
    assert "pip install 'amberbox[ros2-zenoh]'" in shown.out + shown.err
    assert "url: has no effect with 'via: zenoh'" in shown.out + shown.err
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert "via: zenoh" in options.missing_package("dds")


@pytest.mark.parametrize(
    ("via", "qos", "key", "problem"),
    [
        ("bridge", {"/odom": {"depth": 5}}, "qos", "a bridge subscribes for the box"),
        ("zenoh", {"/odom": {"reliability": "reliable"}}, "qos", "the publisher decides"),
        ("zenoh", {"/odom": {"durability": "volatile", "depth": 5}}, "qos", "sent before"),
        ("dds", {"/odom": {"reliability": "besteffort"}}, "reliability", "mean 'best_effort'"),
        ("dds", {"/odom": {"depth": 0}}, "depth", "must be between 1 and 100000"),
        ("dds", {"/a b": {"depth": 5}}, "qos", "is not a name ROS allows"),
        (
            "dds",
            {"/odom": {"reliability": "best_effort", "durability": "transient_local"}},
            "durability",
            "only comes with 'reliability: reliable'",
        ),
    ],
)
def test_check_refuses_a_quality_that_a_way_cannot_ask_for(
    via: str, qos: object, key: str, problem: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    folder = folder_of(tmp_path, {"via": via, "all_topics": True, "qos": qos})
    assert main(["check", str(folder)]) == 2
    shown = capsys.readouterr()
    (line,) = [line for line in (shown.out + shown.err).splitlines() if problem in line]
    place = re.search(r"/black_box\.yaml:\d+: ros2\.([\w./]+):", line)
    assert place is not None and place[1].endswith(key)


def test_a_publisher_over_zenoh_delivers_as_much_of_before_as_asked_for(tmp_path: Path) -> None:
    qos = {"/fresh/**": {"durability": "volatile"}, "/map": {"depth": 2}}
    names = ["/map", "/fresh/map"]
    with robot_of("zenoh", tmp_path, OFFERS="5") as robot:
        for name in names:
            robot.offer(name, NUMBER, latched=True)
        robot.publish(names, 5)
        with recorded(robot, qos=qos) as sink:
            sink.wait_for("/map", 2)
            wait_until(lambda: len(sink.links) == 2, "both topics")

            def is_heard() -> bool:
                robot.publish(names, 1)
                return bool(sink.of("/fresh/map")) and len(sink.of("/map")) > 2

            wait_until(is_heard, "what is sent now")
        assert digests(sink.of("/map"))[:3] == robot.sent("/map")[3:6]
        assert not set(digests(sink.of("/fresh/map"))) & set(robot.sent("/fresh/map")[:5])


def test_protobuf_that_a_bridge_sends_becomes_columns_and_frames(tmp_path: Path) -> None:
    context = Context()
    server = foxglove.start_server(port=0, context=context)
    channel = FrameTransformChannel("/frames", context=context)
    block = {"via": "bridge", "url": f"ws://127.0.0.1:{server.port}", "all_topics": True}
    folder = folder_of(tmp_path, block)
    sent = 0

    def is_recorded() -> bool:
        nonlocal sent
        sent += 1
        channel.log(
            fox.FrameTransform(
                timestamp=fox.Timestamp(1_700_000_000 + sent, 0),
                parent_frame_id="map", child_frame_id="base",
                translation=fox.Vector3(x=float(sent), y=0.0, z=0.0),
                rotation=fox.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            )
        )  # fmt: skip
        items = recorder.pipeline.items
        return "ros2_frames" in items and items["ros2_frames"].counters.kept >= 10

    try:
        with recording(folder) as recorder:
            wait_until(is_recorded)
    finally:
        server.stop()
    record = amberbox.open(folder)
    table = record.query("ros2_frames", ["translation/x", "child_frame_id"])
    first = table.values("translation_x")[0]
    assert table.values("translation_x") == [first + n for n in range(len(table))]
    at_ns = round((1_700_000_000 + first + 0.5) * 1e9)
    assert record.transform("map", "base", at_ns).translation[0] == first + 0.5
