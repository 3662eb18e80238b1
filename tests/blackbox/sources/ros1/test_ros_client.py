"""The subscriber on a ROS network in memory: publishers start, stop and restart, with events."""

from __future__ import annotations

import socket
import struct
import threading
import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

from amberbox.blackbox.sources.ros1.client import RosSubscriber
from amberbox.blackbox.sources.ros1.master import SubscriberSettings
from amberbox.core.source import TopicOptions
from amberbox.core.topic_selection import TopicSelection
from amberbox.core.types import Topic
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink
from tests.support.processes import free_port
from tests.support.ros_network import RosMaster, RosPublisher, RosTopic

TOPIC = "/chat"
NODE = "/talker"


@dataclass
class Network:
    """A master, its publishers, and how the box is set up."""

    master: RosMaster
    publishers: list[RosPublisher] = field(default_factory=list)

    def settings(self, **changes: Any) -> SubscriberSettings:
        values: dict[str, Any] = {"poll_s": 0.05, "listed_retry_s": 0.1, "unknown_after_s": 0.2}
        return SubscriberSettings(master_uri=self.master.uri, **(values | changes))

    def talker(self, node: str = NODE, registers: bool = True, **offer: Any) -> RosPublisher:
        master = self.master if registers else None
        publisher = RosPublisher(node, {TOPIC: RosTopic(**offer)}, master)
        self.publishers.append(publisher)
        return publisher


@pytest.fixture
def network() -> Iterator[Network]:
    made = Network(RosMaster())
    yield made
    for publisher in made.publishers:
        publisher.kill()
    made.master.stop()


def chosen(*names: str, kind: str = "", **choice: Any) -> TopicSelection:
    return TopicSelection([TopicOptions(name, type=kind) for name in names], **choice)


def everything() -> TopicSelection:
    return chosen(all_topics=True, left_out=["/rosout"])


@contextmanager
def listening(
    settings: SubscriberSettings, sink: MemorySink, selection: TopicSelection | None = None
) -> Iterator[None]:
    """Run the subscriber in a thread; raise its exceptions."""
    stop = threading.Event()
    errors: list[BaseException] = []

    def run() -> None:
        try:
            RosSubscriber(settings, selection or chosen(TOPIC), sink).run(stop)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    if errors:
        raise errors[0]


def ways(sink: MemorySink) -> list[tuple[str, str, str]]:
    return [(way, peer, reason) for way, _, peer, reason, _ in list(sink.links)]


def wait_for_link(sink: MemorySink, way: str, count: int = 1) -> None:
    wait_until(lambda: [w for w, *_ in ways(sink)].count(way) >= count, f"{count} links {way}")


def wait_for_event(sink: MemorySink, kind: str) -> str:
    wait_until(lambda: any(k == kind for k, _, _ in list(sink.events)), f"event {kind}")
    return next(text for k, text, _ in sink.events if k == kind)


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


@pytest.mark.parametrize("invisible", [False, True])
def test_messages_arrive_once_and_in_order(network: Network, invisible: bool) -> None:
    sink = MemorySink()
    with listening(network.settings(invisible=invisible), sink):
        talker = network.talker()
        talker.wait_for_subscribers(TOPIC)
        talker.publish(TOPIC, b"one", b"", b"two")
        talker.publish(TOPIC, b"x" * 300_000)
        assert sink.wait_for(TOPIC, 4) == [b"one", b"", b"two", b"x" * 300_000]
        assert talker.requests[0]["md5sum"] == "*" and talker.requests[0]["callerid"] == "/amberbox"
        registered = bool(network.master.subscribers.get(TOPIC))
        assert registered is not invisible
    assert ("registerSubscriber" in network.master.calls) is not invisible
    assert not network.master.subscribers.get(TOPIC)
    assert ways(sink) == [("up", NODE, ""), ("down", NODE, "the recorder stopped listening")]
    assert [topic.name for topic in sink.topics] == [TOPIC]
    assert sink.topics[0].schema is not None
    assert sink.topics[0].schema.data == b"string data\n"
    assert sink.events == []


def test_what_has_arrived_is_delivered_when_the_box_stops(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = network.talker()
        talker.wait_for_subscribers(TOPIC)
        wait_for_link(sink, "up")
        talker.publish(TOPIC, *[b"%d" % n for n in range(5000)])
    assert sink.of(TOPIC) == [b"%d" % n for n in range(5000)]


def test_a_publisher_that_leaves_is_gone(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(poll_s=5.0), sink):
        wait_until(lambda: network.master.subscribers.get(TOPIC), "registered")
        talker = network.talker()
        talker.wait_for_subscribers(TOPIC)
        wait_for_link(sink, "up")
        talker.leave()
        wait_for_link(sink, "down")
    assert ways(sink)[1] == ("down", NODE, "publisher gone")
    assert sink.saved["publishers"][TOPIC] == {}


def say(network: Network, sink: MemorySink, text: bytes, **offer: Any) -> RosPublisher:
    """Start a publisher, let it send one message and wait until that is recorded."""
    talker = network.talker(**offer)
    talker.wait_for_subscribers(TOPIC)
    before = len(sink.of(TOPIC))
    talker.publish(TOPIC, text)
    sink.wait_for(TOPIC, before + 1)
    return talker


@pytest.mark.parametrize("announces", [True, False])
@pytest.mark.parametrize("invisible", [False, True])
def test_a_publisher_that_was_killed_is_heard_again(
    network: Network, invisible: bool, announces: bool
) -> None:
    network.master.announces = announces
    sink = MemorySink()
    with listening(network.settings(invisible=invisible), sink):
        say(network, sink, b"first").kill()
        wait_for_link(sink, "down")
        say(network, sink, b"second")
    assert sink.of(TOPIC) == [b"first", b"second"]
    assert [way for way, *_ in ways(sink)] == ["up", "down", "up", "down"]
    assert ways(sink)[1][2] == "the publisher closed the connection"


def test_all_publishers_of_a_topic_are_heard(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        say(network, sink, b"a", node="/a")
        say(network, sink, b"b", node="/b")
    assert sink.of(TOPIC) == [b"a", b"b"]
    assert {peer for way, peer, _ in ways(sink) if way == "up"} == {"/a", "/b"}


def test_the_gap_of_a_new_publisher_begins_before_it_registered(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        say(network, sink, b"a", node="/a")
        calls = len(network.master.calls)
        wait_until(lambda: len(network.master.calls) > calls + 2, "two more polls")
        polled_ns = sink.now_ns() - 300_000_000
        registered_ns = sink.now_ns()
        say(network, sink, b"b", node="/b")
        since_ns = next(at for way, _, peer, _, at in sink.links if peer == "/b")
    assert polled_ns < since_ns <= registered_ns


def test_a_master_that_was_restarted_gets_the_registration_again(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = say(network, sink, b"before")
        network.master.stop()
        wait_for_event(sink, "ros_master_unreachable")
        talker.publish(TOPIC, b"without master")
        network.master = RosMaster(network.master.port)
        wait_for_event(sink, "ros_registered_again")
        wait_until(lambda: network.master.subscribers.get(TOPIC), "registered")
        talker.publish(TOPIC, b"after")
        sink.wait_for(TOPIC, 3)
        say(network, sink, b"other", node="/other")
    assert sink.of(TOPIC) == [b"before", b"without master", b"after", b"other"]
    assert ways(sink)[:2] == [("up", NODE, ""), ("up", "/other", "")]
    assert kinds(sink) == ["ros_master_unreachable", "ros_master_back", "ros_registered_again"]


@pytest.mark.parametrize("invisible", [False, True])
def test_a_box_that_restarts_finds_publishers_the_master_has_forgotten(
    network: Network, invisible: bool
) -> None:
    sink = MemorySink()
    with listening(network.settings(invisible=invisible), sink):
        talker = say(network, sink, b"before")
    network.master.publishers.clear()
    again = MemorySink(saved=sink.saved)
    with listening(network.settings(invisible=invisible), again):
        wait_for_link(again, "up")
        talker.publish(TOPIC, b"after")
        assert again.wait_for(TOPIC, 1) == [b"after"]


def test_a_box_that_restarts_comes_back_under_the_same_address(network: Network) -> None:
    sink, addresses = MemorySink(), []
    for _ in range(2):
        with listening(network.settings(), sink):
            wait_until(lambda: network.master.subscribers.get(TOPIC), "registered")
            addresses.append(network.master.subscribers[TOPIC]["/amberbox"])
    assert addresses[0] == addresses[1]


def test_a_latched_message_is_not_recorded_again_after_a_reconnect(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = say(network, sink, b"map", latching=True)
        talker.hang_up(TOPIC)
        wait_for_event(sink, "ros_latched_repeat")
        talker.publish(TOPIC, b"map")
        talker.publish(TOPIC, b"new map")
        sink.wait_for(TOPIC, 3)
    assert sink.of(TOPIC) == [b"map", b"map", b"new map"]
    assert sink.topics[0].latched
    again = MemorySink(saved=sink.saved, latched={TOPIC: b"new map"})
    with listening(network.settings(), again):
        wait_for_event(again, "ros_latched_repeat")
    assert again.of(TOPIC) == []


def test_the_latched_messages_of_several_nodes_are_told_apart(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talkers = [
            say(network, sink, n, node=f"/{n.decode()}", latching=True) for n in (b"a", b"b")
        ]
        for talker in talkers:
            talker.hang_up(TOPIC)
        wait_until(lambda: kinds(sink).count("ros_latched_repeat") == 2, "two repeats")
    assert sink.of(TOPIC) == [b"a", b"b"]


def test_what_a_restarted_publisher_latches_is_new(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        say(network, sink, b"map", latching=True).kill()
        wait_for_link(sink, "down")
        say(network, sink, b"map", latching=True)
    assert sink.of(TOPIC) == [b"map", b"map"]


def test_a_refusal_is_an_event_and_tried_again(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = network.talker(error="not for you")
        assert "not for you" in wait_for_event(sink, "ros_publisher_refused")
        talker.topics[TOPIC].error = ""
        wait_for_link(sink, "up")
    assert kinds(sink) == ["ros_publisher_refused"]


def test_malformed_data_ends_the_connection_and_is_an_event(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(message_limit=1000), sink):
        talker = say(network, sink, b"fine")
        talker.send(TOPIC, struct.pack("<I", 0x7FFFFFFF))
        assert "2147483647 bytes" in wait_for_event(sink, "ros_malformed")
        wait_for_link(sink, "up", 2)
        talker.wait_for_subscribers(TOPIC, 2)
        talker.topics[TOPIC].connections.pop(0).close()
        talker.publish(TOPIC, b"fine again")
        sink.wait_for(TOPIC, 2)
    assert ways(sink)[1][2].startswith("malformed data")


def test_a_connection_that_breaks_is_down_since_it_was_heard_last(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = say(network, sink, b"last words")
        heard_ns = sink.messages[-1][2]
        network.master.publishers.clear()
        connection = talker.topics[TOPIC].connections.pop()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
        wait_for_link(sink, "down")
        down = next(link for link in sink.links if link[0] == "down")
    assert down[3] == "connection lost: Connection reset by peer"
    assert down[4] == heard_ns


def test_another_type_is_another_stream(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink, chosen(TOPIC, kind="std_msgs/Int8")):
        say(network, sink, b"text").kill()
        wait_for_link(sink, "down")
        say(network, sink, b"12345678", type="a/B", definition="int64 x\n", md5sum="2")
    assert [t.schema.name for t in sink.topics if t.schema] == ["std_msgs/String", "a/B"]
    assert [stream for stream, _, _ in sink.messages] == [0, 1]
    assert kinds(sink) == ["ros_type_differs", "ros_type_differs", "ros_type_changed"]


def test_a_topic_nobody_publishes_is_an_event(network: Network) -> None:
    network.talker()
    sink = MemorySink()
    with listening(network.settings(), sink, chosen("/chta")):
        text = wait_for_event(sink, "ros_no_publisher")
    assert text == "no publisher of /chta; did you mean '/chat'?; the master knows /chat"
    assert sink.links == []


def test_an_unreachable_master_is_one_event(network: Network) -> None:
    port = free_port()
    sink = MemorySink()
    with listening(SubscriberSettings(f"http://127.0.0.1:{port}/", poll_s=0.05), sink):
        wait_for_event(sink, "ros_master_unreachable")
        network.master.stop()
        network.master = RosMaster(port)
        wait_for_event(sink, "ros_master_back")
        say(network, sink, b"hello")
    assert kinds(sink) == ["ros_master_unreachable", "ros_master_back"]


def test_something_else_than_a_master_is_an_event() -> None:
    sink = MemorySink()
    server = socket.create_server(("127.0.0.1", 0))
    with server:
        threading.Thread(target=_answer_nonsense, args=(server,), daemon=True).start()
        uri = f"http://127.0.0.1:{server.getsockname()[1]}/"
        with listening(SubscriberSettings(uri, poll_s=0.05), sink):
            assert "does not speak ROS" in wait_for_event(sink, "ros_master_unreachable")


def _answer_nonsense(server: socket.socket) -> None:
    connection, _ = server.accept()
    with connection:
        connection.recv(1 << 16)
        connection.sendall(b"220 ftp ready\r\n")


def test_a_master_that_hangs_does_not_hold_up_the_end() -> None:
    silent = socket.create_server(("127.0.0.1", 0))
    with silent:
        sink, stop = MemorySink(), threading.Event()
        settings = SubscriberSettings(
            f"http://127.0.0.1:{silent.getsockname()[1]}/", timeout_s=4 * PATIENCE_S
        )
        thread = threading.Thread(
            target=RosSubscriber(settings, chosen(TOPIC), sink).run, args=(stop,)
        )
        thread.start()
        connection, _ = silent.accept()
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        connection.close()


def test_nobody_on_the_network_can_stop_the_box(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = say(network, sink, b"before")
        box: Any = xmlrpc.client.ServerProxy(network.master.subscribers[TOPIC]["/amberbox"])
        assert box.shutdown("/rosnode", "killed")[0] == 1
        assert "killed" in wait_for_event(sink, "ros_shutdown_refused")
        talker.publish(TOPIC, b"after")
        sink.wait_for(TOPIC, 2)


def test_a_node_that_is_back_elsewhere_replaces_its_dead_connection(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        old = say(network, sink, b"old")
        say(network, sink, b"new")
        wait_for_link(sink, "up", 2)
        assert [way for way, *_ in ways(sink)] == ["up", "down", "up"]
        assert ways(sink)[1][2] == "replaced by a newer connection"
        old.kill()
    assert [way for way, *_ in ways(sink)] == ["up", "down", "up", "down"]


def test_one_process_under_two_addresses_is_heard_once(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        talker = say(network, sink, b"one")
        other_name = talker.uri.replace("127.0.0.1", "localhost")
        network.master.register(TOPIC, "/alias", other_name)
        wait_until(lambda: len(talker.requests) >= 2, "second connection")
        talker.topics[TOPIC].connections[0].sendall(struct.pack("<I", 3) + b"two")
        sink.wait_for(TOPIC, 2)
    assert ways(sink)[:1] == [("up", NODE, "")] and len(ways(sink)) == 2


def test_host_names_are_mapped(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(hosts={"robot-7": "127.0.0.1"}), sink):
        talker = network.talker(registers=False)
        address = talker.uri.replace("127.0.0.1", "Robot-7")
        network.master.register(TOPIC, NODE, address)
        talker.wait_for_subscribers(TOPIC)
        talker.publish(TOPIC, b"hello")
        assert sink.wait_for(TOPIC, 1) == [b"hello"]


def test_an_unknown_host_is_an_event_with_a_hint(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink):
        network.master.register(TOPIC, NODE, "http://no-such-robot.invalid:4711/")
        text = wait_for_event(sink, "ros_publisher_silent")
    assert "give the address of 'no-such-robot.invalid' under 'hosts:'" in text


def test_all_topics_are_followed_on_request(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink, everything()):
        network.master.register("/rosout", "/nobody", "http://127.0.0.1:1/")
        say(network, sink, b"hello")
    assert sink.of(TOPIC) == [b"hello"]
    assert "/rosout" not in network.master.subscribers


def test_patterns_find_topics_that_come_later_and_exclusions_are_never_subscribed(
    network: Network,
) -> None:
    sink, selection = MemorySink(), chosen("/cam/*", "/lid/**", exclude=["/cam/raw"])
    with listening(network.settings(), sink, selection):
        assert "no publisher of /cam/*" in wait_for_event(sink, "ros_no_publisher")
        offered = {name: RosTopic() for name in ("/cam/small", "/cam/raw", "/cam/a/b", "/odom")}
        camera = RosPublisher("/camera", offered, network.master)
        network.publishers.append(camera)
        camera.wait_for_subscribers("/cam/small")
        camera.publish("/cam/small", b"hello")
        assert sink.wait_for("/cam/small", 1) == [b"hello"]
        assert set(network.master.subscribers) == {"/cam/small"}
    assert [topic.name for topic in sink.topics] == ["/cam/small"]
    assert {request["topic"] for request in camera.requests} == {"/cam/small"}


def test_types_choose_before_anything_is_subscribed(network: Network) -> None:
    image, text = RosTopic("sensor_msgs/Image", "uint8 x\n"), RosTopic()
    network.publishers.append(RosPublisher("/n", {"/a": image, "/b": text}, network.master))
    sink = MemorySink()
    with listening(
        network.settings(), sink, chosen(all_topics=True, exclude_types=["sensor_msgs/*"])
    ):
        network.publishers[0].wait_for_subscribers("/b")
        # a topic of unknown type is not subscribed until the master knows it
        network.master.register("/c", "/n", network.publishers[0].uri)
        network.publishers[0].topics["/c"] = RosTopic()
        asked = network.master.calls.count("getTopicTypes")
        wait_until(lambda: network.master.calls.count("getTopicTypes") > asked + 1, "asked again")
        assert set(network.master.subscribers) == {"/b"}
        network.master.types["/c"] = "std_msgs/String"
        network.publishers[0].wait_for_subscribers("/c")
    assert set(network.master.subscribers) == {"/b", "/c"}


def test_the_type_of_a_pattern_is_compared_with_that_of_each_topic(network: Network) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink, chosen("/**", kind="std_msgs/msg/Int8")):
        say(network, sink, b"hello")
        assert "configured is std_msgs/Int8" in wait_for_event(sink, "ros_type_differs")


@pytest.mark.parametrize(
    "selection",
    [everything(), chosen("/**", exclude_types=["sensor_msgs/*"])],
    ids=["all", "types"],
)
def test_all_topics_are_heard_again_when_box_and_master_have_restarted(
    network: Network, selection: TopicSelection
) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink, selection):
        talker = say(network, sink, b"before")
    network.master.publishers.clear()
    talker.topics["/new"] = RosTopic()
    again = MemorySink(saved=sink.saved)
    with listening(network.settings(), again, selection):
        talker.wait_for_subscribers("/new")
        talker.publish("/new", b"told by the node itself")
        talker.publish(TOPIC, b"after")
        assert again.wait_for(TOPIC, 1) == [b"after"]
        again.wait_for("/new", 1)
    assert {(way, peer) for way, peer, _ in ways(again)} == {("up", NODE), ("down", NODE)}


@pytest.mark.parametrize("all_topics", [True, False])
def test_a_remembered_publisher_that_is_dead_is_a_gap_and_an_event(
    network: Network, all_topics: bool
) -> None:
    sink, topics = MemorySink(), everything() if all_topics else chosen(TOPIC)
    with listening(network.settings(), sink, topics):
        say(network, sink, b"before").kill()
        wait_for_link(sink, "down")
    network.master.publishers.clear()
    again = MemorySink(saved={"publishers": {TOPIC: {NODE: network.publishers[0].uri}}})
    with listening(network.settings(), again, topics):
        wait_for_event(again, "ros_publisher_silent")
        wait_until(lambda: again.saved["publishers"][TOPIC] == {}, "not for the next run")
        assert len(again.links) == 1
        say(network, again, b"back at another address")
    assert ways(again)[0][:2] == ("down", NODE)
    assert ways(again)[0][2].startswith("publisher not connected: http://127.0.0.1")
    assert "refused" in ways(again)[0][2]
    assert [way for way, *_ in ways(again)] == ["down", "up", "down"]


def test_a_node_that_publishes_a_topic_no_more_is_not_missed(network: Network) -> None:
    sink = MemorySink()
    talker = network.talker()
    remembered = {"/old": {NODE: talker.uri}, TOPIC: {NODE: talker.uri}}
    sink.saved = {"publishers": remembered}
    with listening(network.settings(), sink, everything()):
        wait_until(lambda: sink.saved["publishers"].get("/old") == {}, "forgotten")
        wait_for_link(sink, "up")
    assert [topic for _, topic, *_ in sink.links] == [TOPIC, TOPIC]


def test_a_publisher_that_cannot_be_reached_is_a_gap_though_another_is_heard(
    network: Network,
) -> None:
    sink = MemorySink()
    with listening(network.settings(), sink, everything()):
        say(network, sink, b"heard")
        network.master.register(TOPIC, "/far", f"http://127.0.0.1:{free_port()}/")
        wait_for_link(sink, "down")
        text = wait_for_event(sink, "ros_publisher_silent")
    missing = next(link for link in sink.links if link[2] == "/far")
    assert missing[0] == "down" and missing[3].startswith("publisher not connected")
    assert TOPIC in text


def test_a_sink_that_is_stuck_holds_nobody_else(network: Network) -> None:
    release = threading.Event()

    class StuckSink(MemorySink):
        def message(self, stream: int, data: bytes, received_ns: int) -> None:
            if data == b"stuck":
                release.wait(PATIENCE_S)
            super().message(stream, data, received_ns)

    sink = StuckSink()
    with listening(network.settings(), sink):
        first = network.talker("/a")
        first.wait_for_subscribers(TOPIC)
        first.publish(TOPIC, b"stuck")
        say(network, sink, b"free", node="/b")
        assert sink.of(TOPIC) == [b"free"]
        release.set()
        sink.wait_for(TOPIC, 2)


def test_messages_that_wait_for_their_type_are_stamped_when_they_come(network: Network) -> None:
    is_built, asked = threading.Event(), threading.Event()

    class SlowTypes(MemorySink):
        def topic(self, topic: Topic) -> int:
            asked.set()
            is_built.wait(PATIENCE_S)
            return super().topic(topic)

    sink = SlowTypes()
    with listening(network.settings(), sink):
        talker = network.talker()
        talker.wait_for_subscribers(TOPIC)
        wait_for_link(sink, "up")
        assert asked.wait(PATIENCE_S)
        calls = len(network.master.calls)
        talker.publish(TOPIC, b"one", b"two")
        talker.hang_up(TOPIC)
        wait_until(lambda: len(network.master.calls) > calls + 2, "two more polls")
        released_ns = sink.now_ns()
        is_built.set()
        sink.wait_for(TOPIC, 2)
    assert sink.of(TOPIC) == [b"one", b"two"]
    assert max(received_ns for _, _, received_ns in sink.messages) < released_ns
    down_ns = next(at for way, _, _, _, at in sink.links if way == "down")
    assert down_ns < released_ns


def test_an_error_of_the_sink_ends_the_run(network: Network) -> None:
    class BrokenSink(MemorySink):
        def message(self, stream: int, data: bytes, received_ns: int) -> None:
            raise RuntimeError("disk on fire")

    sink = BrokenSink()
    with pytest.raises(RuntimeError, match="disk on fire"), listening(network.settings(), sink):
        talker = network.talker()
        talker.wait_for_subscribers(TOPIC)
        talker.publish(TOPIC, b"hello")
        wait_for_link(sink, "down")
