"""What is played to ROS 1 and ZeroMQ arrives there, and nobody is disturbed without being asked."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

from amberbox.blackbox.play import ros1
from amberbox.blackbox.play import zmq as zmq_target
from amberbox.blackbox.play.ros1 import RosTarget
from amberbox.blackbox.play.zmq import ZmqTarget
from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import NodeSettings, RosError
from amberbox.blackbox.sources.ros1.message_type import MessageType
from amberbox.blackbox.sources.ros1.node import RosNode, TopicReader, TopicWish
from amberbox.blackbox.sources.ros1.tcpros import encode_header, read_header
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import COUNT, number
from tests.support.ros_network import RosMaster

NAME = Topic("/name", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"), latched=True)


@pytest.fixture
def master() -> Iterator[RosMaster]:
    made = RosMaster()
    yield made
    made.stop()


@pytest.fixture
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1, "_PATIENCE_S", 0.3)
    monkeypatch.setattr(zmq_target, "_PATIENCE_S", 0.3)


def soon() -> Deadline:
    return Deadline.within(PATIENCE_S)


@contextmanager
def playing(target: RosTarget | ZmqTarget, *topics: Topic) -> Iterator[None]:
    assert [target.refused(topic) for topic in topics] == [""] * len(topics)
    try:
        target.open(topics)
        yield
    finally:
        target.close()


@contextmanager
def listening(
    master: RosMaster, topic: str, kind: str
) -> Iterator[tuple[TopicReader, list[bytes]]]:
    heard: list[bytes] = []

    def received(node: str, kind: MessageType, data: bytes) -> None:
        heard.append(data)

    settings = NodeSettings(master_uri=master.uri, caller_id="/ear", timeout_s=20.0)
    with RosNode(settings, soon()) as node:
        yield node.subscribe(TopicWish(topic, kind, received), soon()), heard


def test_subscribers_that_are_there_miss_nothing(master: RosMaster) -> None:
    with listening(master, "/count", "std_msgs/Int64") as (_, heard):
        target = RosTarget(master.uri)
        with playing(target, COUNT):
            for n in range(3 * ros1.QUEUE):
                assert target.send(COUNT, number(n), patient=True) == 1
        wait_until(lambda: len(heard) == 3 * ros1.QUEUE, "all messages")
    assert heard == [number(n) for n in range(3 * ros1.QUEUE)]
    assert target.dropped() == 0
    assert master.publishers["/count"] == {}


def test_large_messages_wait_for_room_too(master: RosMaster) -> None:
    """The queue holds 64 MB: far less than a thousand messages."""
    sizes: list[int] = []

    def received(node: str, kind: MessageType, data: bytes) -> None:
        sizes.append(len(data))
        free.wait(PATIENCE_S)

    free, target = threading.Event(), RosTarget(master.uri)
    settings = NodeSettings(master_uri=master.uri, caller_id="/ear", timeout_s=20.0)
    with RosNode(settings, soon()) as node:
        node.subscribe(TopicWish("/name", "std_msgs/String", received), soon())
        with playing(target, NAME):
            for number_ in range(90):
                if number_ == 72:  # the queue is nearly full
                    free.set()
                target.send(NAME, bytes(900_000 + number_), patient=number_ >= 72)
            wait_until(lambda: len(sizes) == 90, "all messages")
    assert target.dropped() == 0 and sizes == [900_000 + n for n in range(90)]


def test_latched_messages_reach_those_who_come_late_and_the_clock_is_told(
    master: RosMaster,
) -> None:
    target = RosTarget(master.uri, with_clock=True)
    assert target.refused(Topic("/clock", "ros1", NAME.schema)) == "--clock publishes the time"
    with playing(target, NAME):
        target.send(NAME, b"\x01\0\0\0a", patient=False)
        assert not target.is_heard()
        with (
            listening(master, "/name", "std_msgs/String") as (_, heard),
            listening(master, "/clock", "rosgraph_msgs/Clock") as (reader, times),
        ):
            wait_until(lambda: heard, "the latched message")
            assert heard == [b"\x01\0\0\0a"] and target.is_heard()
            wait_until(reader.nodes, "the clock's connection")
            target.set_clock(5 * NS + 7)
            wait_until(lambda: times, "the time")
            assert times == [b"\x05\0\0\0\x07\0\0\0"]


def test_topics_that_others_publish_are_left_alone(master: RosMaster) -> None:
    master.register("/count", "/driver", "http://127.0.0.1:1/")
    what = r"publish these topics themselves: /count \(/driver\)"
    with pytest.raises(UsageError, match=what), playing(RosTarget(master.uri), COUNT):
        pass
    assert list(master.publishers["/count"]) == ["/driver"]
    with playing(RosTarget(master.uri, force=True), COUNT):
        assert len(master.publishers["/count"]) == 2
    master.register("/clock", "/gazebo", "http://127.0.0.1:1/")
    target = RosTarget(master.uri, with_clock=True)
    with pytest.raises(UsageError, match="/clock"), playing(target, NAME):
        pass


def test_no_master_is_an_error_with_a_hint() -> None:
    gone = RosMaster()
    gone.stop()
    what = "no ROS master answers"
    with pytest.raises(RosError, match=what) as caught, playing(RosTarget(gone.uri), COUNT):
        pass
    assert "--to ros=" in caught.value.hint


def test_what_is_not_of_ros_1_is_refused_with_the_reason() -> None:
    target = RosTarget()
    assert target.refused(COUNT) == ""
    for topic, why in (
        (Topic("/odom", "cdr", NAME.schema), "messages of ROS 2"),
        (Topic("pose", "json"), "its messages (json) are none of ROS 1"),
        (Topic("/9x", "ros1", NAME.schema), "is not a name that ROS allows"),
        (Topic("/x", "ros1", Schema("a/B", "ros1msg", b"c/D e")), "c/msg/D is missing"),
        (Topic("/count", "ros1", NAME.schema), "another type or definition"),
    ):
        assert why in target.refused(topic), topic


@contextmanager
def connected(port: tuple[str, int]) -> Iterator[socket.socket]:
    """Subscribe to /name, and read nothing but the answer."""
    header = {"callerid": "/hung", "topic": "/name", "type": "*", "md5sum": "*"}
    with socket.create_connection(port) as sock:
        sock.sendall(encode_header(header))
        read_header(sock)
        yield sock


def test_as_many_connect_as_a_large_robot_has(master: RosMaster) -> None:
    target = RosTarget(master.uri)
    with playing(target, NAME), ExitStack() as stack:
        port = target.node.address_of("/name")
        assert port is not None
        sockets = [stack.enter_context(connected(port)) for _ in range(200)]
        assert target.send(NAME, b"\x01\0\0\0a", patient=True) == 200
        assert {sock.recv(100) for sock in sockets} == {b"\x05\0\0\0\x01\0\0\0a"}


@pytest.mark.usefixtures("short_waits")
def test_a_subscriber_that_hangs_holds_nobody_up_for_long(master: RosMaster) -> None:
    """Its queue is bounded by size too, and what it does not get is counted."""
    big = b"\0" * (1 << 20)
    target = RosTarget(master.uri)
    with playing(target, NAME):
        port = target.node.address_of("/name")
        assert port is not None
        with connected(port):
            wait_until(target.is_heard, "the subscriber")
            for _ in range(200):
                target.send(NAME, big, patient=True)
            assert 200 - 64 - 16 < target.dropped() <= 200 - 63


@contextmanager
def subscriber(endpoint: str, **options: Any) -> Iterator[Any]:
    context = zmq.Context()
    sock = context.socket(zmq.SUB)
    for name, value in options.items():
        setattr(sock, name, value)
    sock.subscribe(b"pose")
    sock.connect(endpoint)
    try:
        yield sock
    finally:
        context.destroy(linger=0)


POSE = Topic("pose", "json")


def test_a_subscriber_of_zmq_gets_all_in_order(tmp_path: Path) -> None:
    target, count = ZmqTarget(f"ipc://{tmp_path}/play"), 3 * zmq_target._QUEUE
    with playing(target, POSE), subscriber(target.endpoint, rcvhwm=10) as sock:
        wait_until(target.is_heard, "the subscription")
        heard: list[list[bytes]] = []

        def receive() -> None:
            while len(heard) < count and sock.poll(PATIENCE_S * 1000):
                heard.append(sock.recv_multipart())

        reader = threading.Thread(target=receive)
        reader.start()
        assert target.send(Topic("other", "json"), b"{}", patient=True) == 0
        for n in range(count):
            assert target.send(POSE, b"%d" % n, patient=True) == 1
        reader.join(PATIENCE_S)
    assert heard == [[b"pose", b"%d" % n] for n in range(count)]
    assert target.dropped() == 0


@pytest.mark.usefixtures("short_waits")
def test_a_subscriber_of_zmq_that_hangs_is_counted(tmp_path: Path) -> None:
    target = ZmqTarget(f"ipc://{tmp_path}/play")
    with playing(target, POSE), subscriber(target.endpoint, rcvhwm=1):
        wait_until(target.is_heard, "the subscription")
        sent = 0
        while not target.dropped():
            target.send(POSE, b"x" * 1000, patient=sent > zmq_target._QUEUE)
            sent += 1
        target.send(POSE, b"x", patient=True)
        assert target.dropped() == 2
        target.stop.set()


def test_an_address_that_is_taken_and_messages_of_others(tmp_path: Path) -> None:
    first = ZmqTarget(f"ipc://{tmp_path}/play")
    assert "neither JSON nor msgpack" in first.refused(COUNT)
    with zmq.Context() as context, context.socket(zmq.PUB) as taken:
        port = taken.bind_to_random_port("tcp://127.0.0.1")
        target = ZmqTarget(f"tcp://127.0.0.1:{port}")
        with pytest.raises(AmberboxError, match="cannot publish at tcp"), playing(target, POSE):
            pass
