"""A node that publishes and subscribes, on a small network, also to our own listener."""

from __future__ import annotations

import socket
import threading
import time
import xmlrpc.client
from collections.abc import Iterator
from typing import Any

import pytest

from amberbox.blackbox.sources.ros1.client import RosSubscriber
from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosError,
    RosNoAnswerError,
    SubscriberSettings,
)
from amberbox.blackbox.sources.ros1.message_type import MessageType, message_type
from amberbox.blackbox.sources.ros1.node import RosNode, TopicWish
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic
from amberbox.core.source import TopicOptions
from amberbox.core.topic_selection import TopicSelection
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink
from tests.support.ros_network import RosMaster, RosPublisher, RosTopic

STRING = message_type("std_msgs/String")


@pytest.fixture
def master() -> Iterator[RosMaster]:
    made = RosMaster()
    yield made
    made.stop()


def node(master: RosMaster, name: str = "/act") -> RosNode:
    return RosNode(NodeSettings(master_uri=master.uri, caller_id=name, timeout_s=20.0), soon())


def soon() -> Deadline:
    return Deadline.within(PATIENCE_S)


def offered(name: str = "/t", kind: MessageType | None = STRING) -> OfferedTopic:
    return OfferedTopic(name, "std_msgs/String", kind)


def text(data: str) -> bytes:
    return STRING.encode({"data": data})


class Heard:
    """What a subscription receives, and whom it loses."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, dict[str, Any]]] = []
        self.lost: list[str] = []

    def wish(self, kind: MessageType | None = STRING, name: str = "/t") -> TopicWish:
        return TopicWish(name, "std_msgs/String", self.received, kind, self.lost.append)

    def received(self, peer: str, kind: MessageType, data: bytes) -> None:
        self.messages.append((peer, kind.decode(data)))


def test_our_own_listener_records_what_is_published(master: RosMaster) -> None:
    sink, stop = MemorySink(), threading.Event()
    settings = SubscriberSettings(master_uri=master.uri, poll_s=0.05)
    subscriber = RosSubscriber(settings, TopicSelection([TopicOptions("/t")]), sink)
    listening = threading.Thread(target=subscriber.run, args=(stop,))
    listening.start()
    try:
        with node(master) as publisher:
            publisher.advertise(offered(), soon())
            publisher.wait_for("/t", {"/amberbox"}, 1, soon())
            assert publisher.publish("/t", text("hello")) == 1
            wait_until(lambda: sink.of("/t") == [text("hello")], "the message")
        assert master.publishers["/t"] == {}
    finally:
        stop.set()
        listening.join(PATIENCE_S)
    (topic,) = sink.topics
    assert topic.schema is not None and topic.schema.data.decode() == STRING.definition


def test_two_nodes_talk_and_the_end_of_one_is_noticed(master: RosMaster) -> None:
    heard = Heard()
    with node(master, "/ear") as ear:
        reader = ear.subscribe(heard.wish(), soon())
        with node(master, "/mouth") as mouth:
            mouth.advertise(offered(), soon())
            mouth.wait_for("/t", {"/ear"}, 1, soon())
            assert mouth.subscribers("/t", soon()) == {"/ear"}
            mouth.publish("/t", text("hello"))
            wait_until(lambda: heard.messages, "the message")
            assert heard.messages == [("/mouth", {"data": "hello"})]
            assert reader.nodes() == {"/mouth"} and heard.lost == []
        wait_until(lambda: heard.lost == ["/mouth"], "the loss")
    assert master.publishers["/t"] == {} and master.subscribers["/t"] == {}


def test_a_node_answers_tools(master: RosMaster) -> None:
    with node(master) as publisher:
        publisher.advertise(offered(), soon())
        proxy: Any = xmlrpc.client.ServerProxy(master.publishers["/t"]["/act"])
        assert proxy.getPublications("/x") == [1, "", [["/t", "std_msgs/String"]]]
        code, _, address = proxy.requestTopic("/x", "/t", [["UDPROS"], ["TCPROS"]])
        assert code == 1 and address[:2] == ["TCPROS", "127.0.0.1"]
        assert proxy.requestTopic("/x", "/other", [["TCPROS"]])[0] == 0
        assert proxy.requestTopic("/x", "/t", [["UDPROS"]])[0] == 0
        with pytest.raises(xmlrpc.client.Fault):
            proxy.requestTopic("/x", "/t", 5)


def test_a_node_that_is_asked_to_shut_down_publishes_nothing_more(master: RosMaster) -> None:
    with node(master) as publisher:
        publisher.advertise(offered(), soon())
        proxy = xmlrpc.client.ServerProxy(master.publishers["/t"]["/act"])
        proxy.shutdown("/master", "new node\nregistered with same name")
        with pytest.raises(RosError, match="shut down: new node registered with same name"):
            publisher.publish("/t", text("too late"))


def test_the_definition_of_a_type_is_learnt_from_another_publisher(master: RosMaster) -> None:
    other = RosPublisher("/other", {"/t": RosTopic()}, master)
    try:
        with node(master) as publisher:
            topic = offered(kind=None)
            publisher.learn(topic, soon())
            assert topic.kind is not None and topic.kind.md5sum == STRING.md5sum
            nobody = offered("/nobody", kind=None)
            publisher.learn(nobody, soon())
            assert nobody.kind is None
    finally:
        other.leave()


@pytest.mark.parametrize(
    ("topic", "kind", "what"),
    [
        (
            RosTopic(type="std_msgs/Int8"),
            STRING,
            "publishes std_msgs/Int8 on /t, not std_msgs/String",
        ),
        (RosTopic(md5sum="0" * 32), STRING, "has another definition"),
        (RosTopic(md5sum="0" * 32), None, "not that of its md5sum"),
        (RosTopic(definition="nonsense"), None, "/other: "),
        (RosTopic(error="go away"), STRING, "go away"),
    ],
)
def test_publishers_that_are_refused(
    master: RosMaster, topic: RosTopic, kind: MessageType | None, what: str
) -> None:
    heard = Heard()
    other = RosPublisher("/other", {"/t": topic}, master)
    try:
        with node(master) as ear:
            reader = ear.subscribe(heard.wish(kind), soon())
            wait_until(lambda: what in reader.trouble, f"{what}, not {reader.trouble}")
            assert reader.nodes() == set() and heard.messages == []
    finally:
        other.leave()


def test_a_publisher_that_sends_garbage_is_lost(master: RosMaster) -> None:
    heard = Heard()
    other = RosPublisher("/other", {"/t": RosTopic()}, master)
    try:
        with node(master) as ear:
            reader = ear.subscribe(heard.wish(), soon())
            other.wait_for_subscribers("/t")
            other.send("/t", b"\xff\xff\xff\xff")
            wait_until(lambda: heard.lost, "the loss")
            assert "message of 4294967295 bytes announced" in reader.trouble
    finally:
        other.leave()


def test_a_master_that_hangs_is_given_up_in_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        uri = f"http://127.0.0.1:{deaf.getsockname()[1]}/"
        settings = NodeSettings(master_uri=uri, caller_id="/act", timeout_s=30)
        stop = threading.Event()
        began_s = time.monotonic()
        with RosNode(settings, soon()) as publisher:
            with pytest.raises(RosNoAnswerError, match="did not register a publisher of /t"):
                publisher.advertise(offered(), Deadline.within(0.2))
            threading.Timer(0.2, stop.set).start()
            with pytest.raises(RosStoppedError):
                publisher.advertise(offered(), Deadline.within(60, stop.is_set))
        assert time.monotonic() - began_s < 20


def test_a_registration_that_comes_through_after_the_end_is_taken_back(master: RosMaster) -> None:
    registering, go_on = threading.Event(), threading.Event()
    announce = master.register

    def slow(topic: str, node: str, uri: str) -> None:
        registering.set()
        go_on.wait(PATIENCE_S)
        announce(topic, node, uri)

    master.register = slow  # type: ignore[method-assign]  # its double
    with node(master) as publisher, pytest.raises(RosStoppedError):
        publisher.advertise(offered(), Deadline.within(PATIENCE_S, registering.is_set))
    go_on.set()
    wait_until(lambda: master.publishers.get("/t") == {}, "it is taken back")
    wait_until(lambda: master.calls.count("unregisterPublisher") == 2, "both")
