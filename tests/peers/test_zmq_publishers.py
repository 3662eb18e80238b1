"""The zmq source against real publishers: order, loss, restarts, keys."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]  # the package has no type hints
import pytest
import zmq

import amberbox
from amberbox.blackbox.sources.zmq import Config, Source, ZmqTopic
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import ObservedSink, observe
from tests.support.manual_recorder import ManualBox, events, last_counters
from tests.support.processes import free_port


@pytest.fixture
def context() -> Iterator[zmq.Context[Any]]:
    made = zmq.Context()
    yield made
    made.destroy(linger=0)


def bind_publisher(context: zmq.Context[Any], port: int = 0) -> tuple[zmq.Socket[Any], int]:
    publisher = context.socket(zmq.XPUB)  # shows subscriptions, otherwise a PUB
    publisher.sndhwm = 0
    if port:
        publisher.bind(f"tcp://127.0.0.1:{port}")
        return publisher, port
    return publisher, publisher.bind_to_random_port("tcp://127.0.0.1")


def is_bound(publisher: zmq.Socket[Any], port: int) -> bool:
    """Bind a port that a socket closed before may still hold for a moment."""
    try:
        publisher.bind(f"tcp://127.0.0.1:{port}")
    except zmq.ZMQError:
        return False
    return True


def await_subscription(publisher: zmq.Socket[Any]) -> bytes:
    assert publisher.poll(round(PATIENCE_S * 1000)), "nobody subscribed"
    subscription = publisher.recv()
    assert subscription[:1] == b"\1"
    return subscription[1:]


def links(sink: ObservedSink) -> list[tuple[str, str, str]]:
    return [(way, topic, reason) for way, topic, _, reason, _ in sink.links]


@pytest.mark.parametrize(("kind", "pack"), [("json", json.dumps), ("msgpack", msgpack.packb)])
@pytest.mark.parametrize("is_told", [True, False])
def test_every_message_after_the_subscription_arrives_once_in_order(
    context: zmq.Context[Any], kind: str, pack: Callable[[Any], Any], is_told: bool
) -> None:
    publisher, port = bind_publisher(context)
    sent = []
    for number in range(2000):
        packed = pack({"n": number, "v": [1.5, number / 7], "name": "wheel"})
        sent.append(packed.encode() if isinstance(packed, str) else packed)
    topic = ZmqTopic(name="wheels", type=kind if is_told else "")
    config = Config(endpoint=f"tcp://127.0.0.1:{port}", topics=[topic])
    with observe(Source(config, "zmq")) as sink:
        assert await_subscription(publisher) == b"wheels"
        for payload in sent:
            publisher.send_multipart([b"wheels", payload])
        assert sink.wait_for("wheels", 2000) == sent
        assert [(t.name, t.message_encoding, t.schema) for t in sink.topics] == [
            ("wheels", kind, None)
        ]
    assert links(sink) == [("up", "wheels", ""), ("down", "wheels", "stopped")]


def test_without_topics_everything_is_recorded(context: zmq.Context[Any]) -> None:
    publisher, port = bind_publisher(context)
    with observe(Source(Config(url="tcp://127.0.0.1", port=port), "zmq")) as sink:
        assert await_subscription(publisher) == b""
        publisher.send_multipart([b"a", b'{"x": 1}'])
        publisher.send_multipart([b"b/\xff", msgpack.packb({"x": 2})])
        publisher.send(b'{"alone": true}')
        publisher.send(b'pose {"x": 3}')
        publisher.send_multipart([b"c", b'{"x"', b": 4}"])
        publisher.send_multipart([b"c", b'{"x"', b": 5}"])
        publisher.send_multipart([b"a", msgpack.packb([1])])
        publisher.send_multipart([b"bad", b"{not json"])
        assert sink.wait_for("bad", 1) == [b"{not json"]
        assert sink.of("a") == [b'{"x": 1}', msgpack.packb([1])]
        assert sink.of("b/\\xff") == [msgpack.packb({"x": 2})]
        assert sink.of("message") == [b'{"alone": true}']
        assert sink.of("pose") == [b'{"x": 3}']
        assert sink.of("c") == [b'{"x": 4}', b'{"x": 5}']
        assert [kind for kind, _, _ in sink.events] == ["many_frames"]
        wait_until(lambda: len(sink.open_links()) == 6)


def test_publisher_restart_is_seen_and_survived(context: zmq.Context[Any]) -> None:
    publisher, port = bind_publisher(context)
    config = Config(topics=[ZmqTopic(name="odom", url="127.0.0.1", port=port)])
    with observe(Source(config, "zmq")) as sink:
        await_subscription(publisher)
        publisher.send_multipart([b"odom", b'{"n": 1}'])
        sink.wait_for("odom", 1)
        publisher.close(linger=0)
        wait_until(lambda: not sink.open_links())
        publisher, _ = bind_publisher(context, port)
        await_subscription(publisher)
        publisher.send_multipart([b"odom", b'{"n": 2}'])
        assert sink.wait_for("odom", 2) == [b'{"n": 1}', b'{"n": 2}']
        wait_until(lambda: len(sink.links) == 3)
    assert links(sink) == [
        ("up", "odom", ""),
        ("down", "odom", "publisher disconnected"),
        ("up", "odom", ""),
        ("down", "odom", "stopped"),
    ]


def test_publisher_that_comes_late_is_announced_and_found(context: zmq.Context[Any]) -> None:
    port = free_port()
    config = Config(endpoint=f"tcp://127.0.0.1:{port}", topics=[ZmqTopic(name="odom")])
    with observe(Source(config, "zmq")) as sink:
        wait_until(lambda: bool(sink.events))
        assert sink.events[0][0] == "unreachable"
        assert links(sink) == []
        publisher, _ = bind_publisher(context, port)
        await_subscription(publisher)
        publisher.send_multipart([b"odom", b"{}"])
        sink.wait_for("odom", 1)
        wait_until(lambda: links(sink) == [("up", "odom", "")])
    assert len(sink.events) == 1


def test_several_publishers_in_one_block(context: zmq.Context[Any]) -> None:
    first, first_port = bind_publisher(context)
    second, second_port = bind_publisher(context)
    topics = [
        ZmqTopic(name="a", endpoint=f"tcp://127.0.0.1:{first_port}"),
        ZmqTopic(name="b", url="tcp://127.0.0.1", port=second_port),
    ]
    with observe(Source(Config(topics=topics), "zmq")) as sink:
        assert await_subscription(first) == b"a"
        assert await_subscription(second) == b"b"
        for number in range(200):
            first.send_multipart([b"a", str(number).encode()])
            second.send_multipart([b"b", str(-number).encode()])
        assert sink.wait_for("a", 200) == [str(n).encode() for n in range(200)]
        assert sink.wait_for("b", 200) == [str(-n).encode() for n in range(200)]
        peers = dict(sink.open_links())
        assert peers["a"] == f"tcp://127.0.0.1:{first_port}"
        assert peers["b"] == f"tcp://127.0.0.1:{second_port}"


def test_another_subscriber_misses_nothing(context: zmq.Context[Any]) -> None:
    publisher, port = bind_publisher(context)
    other = context.socket(zmq.SUB)
    other.subscribe(b"")
    other.connect(f"tcp://127.0.0.1:{port}")
    await_subscription(publisher)
    publisher.setsockopt(zmq.XPUB_VERBOSE, 1)
    with observe(Source(Config(endpoint=f"tcp://127.0.0.1:{port}"), "zmq")) as sink:
        await_subscription(publisher)
        for number in range(300):
            publisher.send_multipart([b"t", str(number).encode()])
        sink.wait_for("t", 300)
    for number in range(300):
        assert other.poll(round(PATIENCE_S * 1000))
        assert other.recv_multipart() == [b"t", str(number).encode()]
    assert not publisher.poll(0) or publisher.recv() == b"\0"  # at most the unsubscription


@pytest.mark.parametrize("has_own_key", [True, False])
def test_curve_keys(context: zmq.Context[Any], has_own_key: bool) -> None:
    public, secret = zmq.curve_keypair()
    own_public, own_secret = zmq.curve_keypair()
    publisher = context.socket(zmq.XPUB)
    publisher.curve_server = True
    publisher.curve_secretkey = secret
    port = publisher.bind_to_random_port("tcp://127.0.0.1")
    config = Config(
        endpoint=f"tcp://127.0.0.1:{port}",
        curve_server_key=public.decode(),
        curve_public_key=own_public.decode() if has_own_key else "",
        curve_secret_key=own_secret.decode() if has_own_key else "",
    )
    assert list(config.check()) == []
    with observe(Source(config, "zmq")) as sink:
        await_subscription(publisher)
        publisher.send_multipart([b"t", b"{}"])
        assert sink.wait_for("t", 1) == [b"{}"]


def test_wrong_curve_key_is_an_event(context: zmq.Context[Any]) -> None:
    _, secret = zmq.curve_keypair()
    publisher = context.socket(zmq.XPUB)
    publisher.curve_server = True
    publisher.curve_secretkey = secret
    port = publisher.bind_to_random_port("tcp://127.0.0.1")
    other_public, _ = zmq.curve_keypair()
    config = Config(endpoint=f"tcp://127.0.0.1:{port}", curve_server_key=other_public.decode())
    with observe(Source(config, "zmq")) as sink:
        wait_until(lambda: bool(sink.events))
    assert sink.events[0][0] == "handshake_failed"
    assert links(sink) == []


def test_stop_is_heard_while_nothing_comes(context: zmq.Context[Any]) -> None:
    publisher, port = bind_publisher(context)
    with observe(Source(Config(endpoint=f"tcp://127.0.0.1:{port}"), "zmq")):
        await_subscription(publisher)  # leaving fails when the source does not end


def test_what_a_high_water_mark_hides_is_a_gap_with_a_count(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", source="zmq")
    topic = ZmqTopic(name="odom", sequence="n")
    with zmq.Context() as context:
        publisher, port = bind_publisher(context)
        config = Config(endpoint=f"tcp://127.0.0.1:{port}", topics=[topic])
        stop = threading.Event()
        thread = threading.Thread(target=Source(config, "zmq").run, args=(box.sink, stop))
        thread.start()
        await_subscription(publisher)
        for n in [*range(5), *range(8, 10), *range(20, 25)]:
            publisher.send_multipart([b"odom", b'{"n": %d}' % n])
        wait_until(lambda: "zmq_odom" in box.pipeline.items)
        counters = box.pipeline.items["zmq_odom"].counters
        wait_until(lambda: counters.received == 12)
        stop.set()
        thread.join(PATIENCE_S)
        publisher.close(linger=0)
    box.write()
    box.close()
    lost = [gap for gap in amberbox.open(box.store).gaps("zmq_odom") if gap.count]
    assert sum(gap.count or 0 for gap in lost) == 13
    assert {gap.reason for gap in lost} == {"lost before the box: holes in n"}
    assert last_counters(box.store)["zmq_odom"]["lost"] == 13
    assert events(box.store, "no_continuity") == []


def test_without_the_number_that_is_declared_there_is_one_event(
    context: zmq.Context[Any],
) -> None:
    publisher, port = bind_publisher(context)
    topic = ZmqTopic(name="odom", sequence="n")
    with observe(Source(Config(endpoint=f"tcp://127.0.0.1:{port}", topics=[topic]), "z")) as sink:
        await_subscription(publisher)
        for _ in range(3):
            publisher.send_multipart([b"odom", b'{"m": 1}'])
        sink.wait_for("odom", 3)
    assert [kind for kind, _, _ in sink.events] == ["no_continuity"]


def test_a_message_that_is_too_long_is_an_event_and_does_not_end_the_source(
    context: zmq.Context[Any],
) -> None:
    publisher, port = bind_publisher(context)
    config = Config(endpoint=f"tcp://127.0.0.1:{port}", max_message_mb=0.001)
    with observe(Source(config, "z")) as sink:
        await_subscription(publisher)
        publisher.send_multipart([b"a", b'{"x": 1}'])
        sink.wait_for("a", 1)
        publisher.send_multipart([b"a", b"x" * 2000])
        wait_until(lambda: "malformed_connection" in [kind for kind, _, _ in sink.events])
        wait_until(lambda: [way for way, *_ in sink.links] == ["up", "down", "up"])

        def is_heard() -> bool:  # the subscription follows the connection
            publisher.send_multipart([b"a", b'{"x": 2}'])
            return len(sink.of("a")) > 1

        wait_until(is_heard)
    (text,) = [text for kind, text, _ in sink.events if kind == "malformed_connection"]
    assert "max_message_mb" in text


def test_all_topics_of_the_last_run_are_gaps_until_they_are_heard(
    context: zmq.Context[Any],
) -> None:
    publisher, port = bind_publisher(context)
    config = Config(endpoint=f"tcp://127.0.0.1:{port}")
    with observe(Source(config, "z")) as sink:
        await_subscription(publisher)
        publisher.send_multipart([b"a", b'{"x": 1}'])
        sink.wait_for("a", 1)
    publisher.close(linger=0)
    again, stop = ObservedSink(saved=sink.saved), threading.Event()
    thread = threading.Thread(target=Source(config, "z").run, args=(again, stop))
    thread.start()
    try:
        wait_until(lambda: len(again.links) == 1)
        publisher = context.socket(zmq.XPUB)
        wait_until(lambda: is_bound(publisher, port))
        wait_until(lambda: len(again.links) == 2)
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    assert links(again)[:2] == [("down", "a", "publisher not connected yet"), ("up", "a", "")]


def test_a_pattern_subscribes_to_its_beginning_and_leaves_out_what_it_does_not_match(
    context: zmq.Context[Any],
) -> None:
    publisher, port = bind_publisher(context)
    topics = [
        ZmqTopic(name="cam/*/state", type="json", sequence="n"),
        ZmqTopic(name="odom", type="json"),
    ]
    config = Config(endpoint=f"tcp://127.0.0.1:{port}", topics=topics, exclude=["odom/raw"])
    with observe(Source(config, "z")) as sink:
        subscribed = {await_subscription(publisher), await_subscription(publisher)}
        assert subscribed == {b"cam/", b"odom"}
        for number in (1, 2, 5):
            for topic in (b"cam/a/state", b"cam/a/b/state", b"odom/raw", b"odom/fine"):
                publisher.send_multipart([topic, b'{"n": %d}' % number])
        publisher.send(b"cam/\xff")
        publisher.send_multipart([b"odom", b"{}"])
        sink.wait_for("odom", 1)
    names = {topic.name for topic in sink.topics}
    assert names == {"cam/a/state", "odom/fine", "odom"}
    assert len(sink.of("cam/a/state")) == 3
    assert [(topic, count) for topic, *_, count, _ in sink.losses] == [("cam/a/state", 2)]
    assert [kind for kind, _, _ in sink.events] == ["unnamed"]
    assert sink.saved["topics"] == {config.endpoint: ["cam/a/state", "odom/fine"]}
