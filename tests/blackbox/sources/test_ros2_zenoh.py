"""ROS 2 over Zenoh: what tokens and numbers say, and peers that do not keep to it."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from amberbox.blackbox.columns.ros2_types import definition_of, type_hash
from amberbox.blackbox.sources.ros2 import Config, Source, read_graph
from amberbox.blackbox.sources.ros2_transports.names import dds_type, zenoh_key
from amberbox.blackbox.sources.ros2_transports.zenoh import MessageOrigin, origin_of
from amberbox.core.errors import AmberboxError
from amberbox.core.robot_graph import GraphService
from amberbox.core.types import Schema
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import ObservedSink, observe
from tests.support.processes import free_port

NUMBER = "std_msgs/msg/Int64"
HASH = type_hash(Schema(NUMBER, "ros2msg", definition_of("jazzy", NUMBER)))
KEY = zenoh_key(0, "/count", NUMBER, HASH)
ID = bytes(range(16))


def body(value: int) -> bytes:
    return struct.pack("<BBHq", 0, 1, 0, value)


def attachment(number: int, publisher: bytes = ID) -> bytes:
    return struct.pack("<qqB16s", number, 1, 16, publisher)


def token(kind: str, *more: str, number: int = 1, node: str = "talker") -> str:
    return "/".join(["@ros2_lv/0/abc/0", str(number), kind, "%", "%", node, *more])


def publisher_token(topic: str = "%count", number: int = 1, qos: str = "::,10:,:,:,,") -> str:
    return token("MP", topic, dds_type(NUMBER), HASH, qos, number=number)


@contextmanager
def router(port: int) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    for key, value in {
        "mode": "router", "scouting/multicast/enabled": False,
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
    }.items():  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def session(port: int) -> Iterator[zenoh.Session]:
    with router(port) as made:
        yield made


def config(port: int, **more: Any) -> Config:
    return Config(via="zenoh", endpoint=f"tcp/127.0.0.1:{port}", domain=0, all_topics=True, **more)


def listen(port: int, **more: Any) -> Any:
    return observe(Source(config(port, **more), "ros2"))


def wait_for_subscriber(publisher: Any) -> None:
    wait_until(lambda: publisher.matching_status.matching, "a subscriber")


def kinds(sink: ObservedSink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def test_holes_in_the_numbers_are_counted_for_each_publisher(
    session: zenoh.Session, port: int
) -> None:
    kept = session.liveliness().declare_token(publisher_token())
    publisher, other = session.declare_publisher(KEY), bytes(reversed(ID))
    with listen(port) as sink:
        wait_for_subscriber(publisher)
        for number in (5, 6, 9, 10):
            publisher.put(body(number), attachment=attachment(number))
        for number in (100, 103, 2**62, 2**62 + 1):  # no count of messages leads there
            publisher.put(body(number), attachment=attachment(number, other))
        publisher.put(body(11), attachment=attachment(11))
        publisher.put(body(12))
        assert len(sink.wait_for("/count", 10)) == 10
        losses = [(topic, peer, count) for topic, peer, _, _, count, _ in sink.losses]
    assert losses == [("/count", "/talker", 2), ("/count", "/talker", 2)] and kept
    assert all(start < end for _, _, start, end, _, _ in sink.losses)
    assert kinds(sink).count("ros2_no_origin") == 1


def test_a_message_that_is_too_long_is_counted(session: zenoh.Session, port: int) -> None:
    kept = session.liveliness().declare_token(publisher_token())
    publisher = session.declare_publisher(KEY)
    with listen(port, max_message_mb=1.0) as sink:
        wait_for_subscriber(publisher)
        for number, size in enumerate((0, 3_000_000, 0), 1):
            publisher.put(body(number) + bytes(size), attachment=attachment(number))
        assert sink.wait_for("/count", 2) == [body(1), body(3)] and kept
        assert [loss[4] for loss in sink.losses] == [1]


def test_a_router_that_comes_later_and_again(port: int) -> None:
    with listen(port) as sink:
        wait_until(lambda: "zenoh_unreachable" in kinds(sink))
        for run in (1, 2):
            with router(port) as session:
                kept = session.liveliness().declare_token(publisher_token(number=run))
                publisher = session.declare_publisher(KEY)
                wait_for_subscriber(publisher)
                publisher.put(body(run), attachment=attachment(run))
                assert sink.wait_for("/count", run) and kept
            wait_until(lambda: not sink.open_links(), "the gap opens")
    assert kinds(sink)[:2] == ["zenoh_unreachable", "zenoh_connected"]
    assert sink.of("/count") == [body(1), body(2)]


HOSTILE = [
    "@ros2_lv/0/x",
    token("XX", "%a", "b", "c", "d"),
    token("MP", "%a"),
    token("MP", "%count", "not::a::type", HASH, "::"),
    token("MP", "count", dds_type(NUMBER), HASH, "::"),
    token("MP", "%" + "x" * 5000, dds_type(NUMBER), HASH, "::"),
    token("MP", "%..%..%etc", dds_type(NUMBER), HASH, "::"),
    token("NN", node="a b"),
    token("MP", "%qos", dds_type(NUMBER), HASH, ":::::::::::"),
]


def test_tokens_that_rmw_zenoh_does_not_write(session: zenoh.Session, port: int) -> None:
    tokens = [session.liveliness().declare_token(text) for text in HOSTILE]
    tokens.append(session.liveliness().declare_token(publisher_token()))
    publisher = session.declare_publisher(KEY)
    with listen(port) as sink:
        wait_for_subscriber(publisher)
        publisher.put(body(1), attachment=attachment(1))
        sink.wait_for("/count", 1)
        assert {topic for _, topic, *_ in sink.links} <= {"/count", "/qos"}


def test_the_graph_has_nodes_topics_and_services(session: zenoh.Session, port: int) -> None:
    service = dds_type("std_srvs/srv/SetBool")
    tokens = [
        token("NN"), token("NN", node="ears"), publisher_token(),
        token("MS", "%count", dds_type(NUMBER), HASH, "::,10:,:,:,,", node="ears"),
        token("SS", "%reset", service, "RIHS01_ab", "::,10:,:,:,,"),
        token("SC", "%reset", service, "RIHS01_ab", "::,10:,:,:,,", node="ears"),
        *HOSTILE,
    ]  # fmt: skip
    kept = [session.liveliness().declare_token(text) for text in tokens]
    graph = read_graph(config(port), 5.0)
    assert graph.nodes == ("/ears", "/talker") and kept
    (count,) = [topic for topic in graph.topics if topic.name == "/count"]
    assert (count.publishers, count.subscribers) == (("/talker",), ("/ears",))
    assert graph.services == (GraphService("/reset", "std_srvs/srv/SetBool", "/talker"),)
    with pytest.raises(AmberboxError, match="no Zenoh router"):
        read_graph(config(9), 0.5)


def test_attachments_of_both_kinds_are_read() -> None:
    old = b"\x0fsequence_number" + struct.pack("<q", 7)
    old += b"\x10source_timestamp" + struct.pack("<q", 9) + b"\x0asource_gid\x10" + ID
    new = struct.pack("<qqB16s", 7, 9, 16, ID)
    assert origin_of(old) == origin_of(new) == MessageOrigin(ID, 7, 9)
    assert origin_of(b"") is None and origin_of(bytes(34)) is None
