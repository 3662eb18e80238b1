"""What only DDS has: readers without types, losses of best effort, namespaces, stalls."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.sources.ros2_transports.cyclone import (
    Participant,
    RawReader,
    ReaderQos,
    configuration,
)
from amberbox.blackbox.sources.ros2_transports.names import dds_topic, dds_type
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import ObservedSink
from tests.support.manual_recorder import recording
from tests.support.processes import apart
from tests.support.ros2_robots import (
    Ros2Robot,
    digests,
    own_domain,
    process_of_source,
    recorded,
    robot_of,
)

NUMBER = "std_msgs/msg/Int64"
NS = 1_000_000_000


def numbers(sink: ObservedSink, topic: str) -> list[int]:
    return [struct.unpack_from("<q", data, 4)[0] for data in sink.of(topic)]


def lost(sink: ObservedSink) -> int:
    return sum(count for _, _, _, _, count, _ in sink.losses)


@pytest.fixture
def cyclone(tmp_path: Path) -> Iterator[Ros2Robot]:
    with robot_of("cyclone", tmp_path) as robot:
        yield robot


def test_the_process_of_the_source_stands_still(tmp_path: Path) -> None:
    """What its sockets could not hold is counted; what they held has its own times of receipt.

    The lease of the robot is longer than any of that: it is not given up meanwhile.
    """
    with (
        robot_of("cyclone", tmp_path, LEASE_S="60") as cyclone,
        recorded(cyclone) as sink,
    ):
        cyclone.offer("/count", NUMBER)
        cyclone.publish_heard("/count", 20, rate_hz=10)  # its numbers are compared in between
        sink.wait_for("/count", 20)
        process = process_of_source()
        os.kill(process, signal.SIGSTOP)
        cyclone.publish("/count", 16_000, rate_hz=6000)  # more than the kernel keeps
        goes_on_ns = time.time_ns()
        os.kill(process, signal.SIGCONT)

        def has_caught_up() -> bool:
            cyclone.publish("/count", 1)
            return numbers(sink, "/count")[-1] > 16_020

        wait_until(has_caught_up, "what is sent after it stood still arrives")
        last = cyclone.publish("/count", 1)  # a loss is known when a later message arrives
        wait_until(lambda: numbers(sink, "/count")[-1] == last, "the last message")
        wait_until(lambda: len(sink.of("/count")) + lost(sink) == last, "all is known")
    received = numbers(sink, "/count")
    assert received == sorted(set(received)) and 0 < lost(sink) < 16_000
    assert [way for way, *_ in sink.links] == ["up"], "it is no gap"
    held = [at_ns for (_, _, at_ns), number in zip(sink.messages, received, strict=True)
            if 20 < number <= 1020]  # fmt: skip
    assert len(held) == 1000 and held[-1] < goes_on_ns, "they came while it stood still"


def test_the_library_aborts_amid_a_record(cyclone: Ros2Robot, tmp_path: Path) -> None:
    """It costs one hole, and its gap says why."""
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r\n")
    names = ["/count", "/odom"]
    cyclone.offer("/count", NUMBER)
    cyclone.offer("/odom", "nav_msgs/msg/Odometry")
    block = cyclone.block(topics=[{"name": name} for name in names])
    (folder / "black_box.yaml").write_text(f"- ros2: {json.dumps(block)}\n")
    with recording(folder) as recorder:
        items = recorder.pipeline.items

        def kept() -> list[int]:
            return [items[item].counters.kept for item in ("ros2_count", "ros2_odom")]

        cyclone.order("wait", topics=names)
        cyclone.publish(names, 500, rate_hz=500)
        wait_until(lambda: kept() == [500, 500], "the first messages")
        process = process_of_source()
        os.kill(process, signal.SIGABRT)
        # it still passes on messages while it writes its traces
        wait_until(lambda: not Path(f"/proc/{process}").exists(), "the process has ended")

        def is_heard(count: int) -> bool:
            cyclone.publish(names, 1)
            return min(kept()) >= count

        wait_until(lambda: is_heard(501), "it receives both topics again")
        cyclone.publish(names, 500, rate_hz=500)
        wait_until(lambda: is_heard(1000), "as many as before")
        sent = cyclone.publish(names, 1)
    record = amberbox.open(folder)
    received = record.query("ros2_count").values("data")
    assert list(received[:500]) == list(range(1, 501))
    after = list(received[500:])
    assert after == sorted(set(after)) and after[0] > 501
    gaps = record.gaps("ros2_count")
    counted = sum(gap.count or 0 for gap in gaps if "SIGABRT" not in gap.reason)
    missing = sent - after[0] + 1 - len(after)
    assert counted <= missing, "best effort may lose; the newest loss may not be known yet"
    (gap,) = (gap for gap in gaps if "SIGABRT" in gap.reason)
    times = record.query("ros2_count", ["received"]).values("received")
    assert times[499] <= gap.from_ns < gap.to_ns and gap.from_ns < times[500]


@contextmanager
def robot_behind_a_cable(folder: Path) -> Iterator[Ros2Robot]:
    """A robot in a network of its own, joined by one cable.

    Network and addresses go by the domain, which no other test has at the time.
    """
    domain, reserved = own_domain()
    name, near, far = f"amber{domain}", f"amber{domain}n", f"amber{domain}f"
    near_address, far_address = f"10.213.{domain}.1", f"10.213.{domain}.2"

    def run(*words: str) -> None:
        subprocess.run(["ip", *words], check=True)

    subprocess.run(["ip", "netns", "del", name], capture_output=True)  # of a run that was killed
    run("netns", "add", name)
    try:
        run("link", "add", near, "type", "veth", "peer", "name", far, "netns", name)
        run("addr", "add", f"{near_address}/24", "dev", near)
        run("link", "set", near, "up")
        for words in (("addr", "add", f"{far_address}/24", "dev", far), ("link", "set", far, "up"),
                      ("link", "set", "lo", "up")):  # fmt: skip
            run("-n", name, *words)
        more = {"NAMESPACE": name, "PEER_ADDRESS": far_address, "PEER": near_address}
        with robot_of("cyclone", folder, domain, **more) as robot:
            yield robot
    finally:
        run("netns", "del", name)
        reserved.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes networks")
def test_a_cable_that_is_pulled_for_1_s_and_for_10_s(tmp_path: Path) -> None:
    """A short cut is counted; a long one is a gap that begins with the last message."""
    with robot_behind_a_cable(tmp_path) as robot:
        name = f"amber{robot.port}"
        cable = ["ip", "-n", name, "link", "set", f"{name}f"]
        network = f"10.213.{robot.port}."
        near = {"interface": f"{network}1", "peers": [f"{network}2"]}
        robot.offer("/count", NUMBER)
        with recorded(robot, "/count", **near) as sink:
            robot.publish_heard("/count", 100, rate_hz=100)
            sink.wait_for("/count", 100)
            subprocess.run([*cable, "down"], check=True)
            robot.publish("/count", 100, rate_hz=100)
            subprocess.run([*cable, "up"], check=True)
            robot.publish("/count", 100, rate_hz=100)
            wait_until(lambda: len(sink.of("/count")) + lost(sink) == 300, "all is known")
            assert 50 <= lost(sink) <= 200 and [way for way, *_ in sink.links] == ["up"]
            last_ns = sink.messages[-1][2]
            subprocess.run([*cable, "down"], check=True)
            robot.publish("/count", 1000, rate_hz=100)
            subprocess.run([*cable, "up"], check=True)
            wait_until(
                lambda: [way for way, *_ in sink.links] == ["up", "down", "up"], "it is back"
            )
            sent = robot.publish_heard("/count", 100, rate_hz=100)
            wait_until(lambda: numbers(sink, "/count")[-1] == sent, "its newest message")
    received = numbers(sink, "/count")
    assert received == sorted(set(received))
    assert abs(sink.links[1][4] - last_ns) < NS


def test_a_definition_travels_or_is_found_by_its_hash(tmp_path: Path) -> None:
    """A type of nobody else comes with its type object; a known one has its constants."""
    own = "int32 level\nbuiltin_interfaces/Time stamp\nfloat64[3] at\nstring[] names\n"
    own += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    with robot_of("cyclone", tmp_path, TYPE_HASHES="1") as robot:
        robot.offer("/own", "zoo_msgs/msg/Animal", definition=own)
        robot.offer("/battery", "sensor_msgs/msg/BatteryState")
        with recorded(robot) as sink:
            robot.order("wait", topics=["/own"])
            body = struct.pack("<iiIxxxxdddII6s", 3, 7, 9, 0.5, 1.5, 2.5, 1, 6, b"zebra\0")
            robot.order("raw", topic="/own", data=(b"\0\1\0\0" + body).hex())
            (data,) = sink.wait_for("/own", 1)
            wait_until(lambda: len(sink.links) == 2)
    (topic,) = (one for one in sink.topics if one.name == "/own")
    assert topic.schema is not None and topic.schema.name == "zoo_msgs/msg/Animal"
    table = unroller(topic, "").rows([data])
    assert "ros2_no_definition" not in [kind for kind, *_ in sink.events]
    assert table is not None


def test_what_is_too_long_or_no_data_is_counted(tmp_path: Path, fast_dds: None) -> None:
    with robot_of("fastdds", tmp_path) as robot:
        robot.offer("/count", NUMBER)
        robot.offer("/image", "sensor_msgs/msg/Image")
        with recorded(robot, "/count", "/image", max_message_mb=0.5) as sink:
            robot.publish_heard("/count", 1)
            robot.publish_heard("/image", 1, size=1000)
            sink.wait_for("/count", 1)
            sink.wait_for("/image", 1)

            def is_counted(topic: str) -> bool:
                robot.order("raw", topic="/count", data="ffff" + os.urandom(30).hex())
                robot.publish(["/count", "/image"], 1, size=1_000_000)
                return topic in {lost_topic for lost_topic, *_ in sink.losses}

            wait_until(lambda: is_counted("/count"), "what is no data is counted")
            wait_until(lambda: is_counted("/image"), "what is too long is counted")
            robot.publish("/image", 1, size=1000)
            sink.wait_for("/image", 2)
            assert digests(sink.of("/image")) == [robot.sent("/image")[0], robot.sent("/image")[-1]]
            assert numbers(sink, "/count") == list(range(1, len(sink.of("/count")) + 1))


def test_a_topic_is_read_with_the_quality_that_is_asked_for(tmp_path: Path) -> None:
    """The robot sees the readers so; the first name or pattern that fits counts."""
    qos = {"/count": {"reliability": "reliable"}, "/fresh/**": {"durability": "volatile"}}
    names = ["/count", "/other", "/map", "/fresh/map"]
    with robot_of("cyclone", tmp_path, OFFERS="5") as robot:
        for name in names:
            robot.offer(name, NUMBER, latched=name.endswith("map"))
        robot.publish(names, 3)
        with recorded(robot, qos=qos) as sink:
            robot.order("wait", topics=names)
            robot.publish(names, 1)
            wait_until(lambda: all(numbers(sink, name)[-1:] == [4] for name in names), "the last")
            found = {name: robot.order("readers", topic=name) for name in names}
    assert found == {
        "/count": [[True, False]], "/other": [[False, False]],
        "/map": [[True, True]], "/fresh/map": [[False, False]],
    }  # fmt: skip
    assert numbers(sink, "/map") == [1, 2, 3, 4] and numbers(sink, "/fresh/map") == [4]
    assert {topic.name for topic in sink.topics if topic.latched} == {"/map"}
    assert "ros2_qos_not_offered" not in [kind for kind, *_ in sink.events]


def test_a_quality_that_is_not_offered_is_said_and_the_topic_read_without(tmp_path: Path) -> None:
    wanted = {"reliability": "reliable", "durability": "transient_local"}
    with robot_of("cyclone", tmp_path, OFFERS="best_effort") as robot:
        robot.offer("/count", NUMBER)
        with recorded(robot, "/count", qos={"/**": wanted}) as sink:
            robot.publish_heard("/count", 3)
            sink.wait_for("/count", 3)
    said = [text for kind, text, _ in sink.events if kind == "ros2_qos_not_offered"]
    assert said == [
        f"/count: a publisher does not offer {word}; it is read without"
        for word in ("reliable", "transient_local")
    ]


def numbers_of(reader: RawReader) -> list[int]:
    return [struct.unpack_from("<q", sample.data, 4)[0] for sample in reader.take() if sample.data]


def read_late(folder: Path) -> list[int]:
    """Return what a reader of depth 2 has when another one of the topic has taken ten messages."""
    topic, kind, taken = dds_topic("/count"), dds_type(NUMBER), []
    with (
        robot_of("cyclone", folder) as robot,
        Participant(robot.port, configuration("lo", (), False, 1_000_000)) as participant,
    ):
        robot.offer("/count", NUMBER)
        late = participant.open_reader(topic, kind, False, ReaderQos(depth=2))
        other = participant.open_reader(topic, kind, False, ReaderQos(reliable=True))

        def has_taken_ten() -> bool:
            robot.publish("/count", 1)
            taken.extend(numbers_of(other))
            return len(taken) >= 10

        wait_until(has_taken_ten, "ten messages")
        return numbers_of(late)


def test_a_reader_keeps_as_many_messages_as_asked_for(tmp_path: Path) -> None:
    first, second = apart(read_late, tmp_path)
    assert second == first + 1


def ask_the_monitor(domain: int) -> None:
    """Ask the monitor of a participant from this computer, and from another of its addresses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))
        own = probe.getsockname()[0]
    with Participant(domain, configuration("lo", (), False, 1_000_000)) as participant:
        assert participant.last_sequences() == {}
        with pytest.raises(TimeoutError):
            socket.create_connection((own, participant._monitor), timeout=1.0)


def test_the_monitor_of_the_library_hears_nobody_else() -> None:
    """It listens at all addresses of the computer, but answers this process only."""
    domain, reserved = own_domain()
    with reserved:
        apart(ask_the_monitor, domain)


def close_a_reader(domain: int) -> None:
    """Close a reader that a wait has just returned."""
    with Participant(domain, configuration("lo", (), False, 1_000_000)) as participant:
        reader = participant.open_reader("rt/count", dds_type(NUMBER), False, ReaderQos())
        participant.watch(reader)
        assert reader.take() == []
        participant.close_reader(reader)
        assert reader.take() == []
        assert participant.wait_for_messages(0.01) == []


def test_a_reader_that_is_closed_meanwhile_has_nothing() -> None:
    domain, reserved = own_domain()
    with reserved:
        apart(close_a_reader, domain)
