"""What is served to subscribers: their headers, messages, queues, and what hostile ones send."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.sources.ros1 import topic_server as module
from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import RosError, RosNoAnswerError
from amberbox.blackbox.sources.ros1.message_type import message_type
from amberbox.blackbox.sources.ros1.tcpros import encode_header, read_exactly, read_header
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic, TopicServer
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.fuzzing import examples, fuzz

STRING = message_type("std_msgs/String")
GOOD = {"callerid": "/ear", "topic": "/t", "type": STRING.name, "md5sum": STRING.md5sum}
UNKNOWN_TEXT = "int8 x\nstring y\n"


@pytest.fixture
def server() -> Iterator[TopicServer]:
    made = TopicServer("127.0.0.1", "/mouth")
    made.offer(OfferedTopic("/t", STRING.name, STRING))
    yield made
    made.close()


def dial(server: TopicServer, data: bytes = b"") -> socket.socket:
    sock = socket.create_connection(("127.0.0.1", server.port), PATIENCE_S)
    sock.sendall(data)
    return sock


def subscribe(server: TopicServer, **changes: str) -> tuple[socket.socket, dict[str, bytes]]:
    sock = dial(server, encode_header({**GOOD, **changes}))
    return sock, read_header(sock)


def receive(sock: socket.socket) -> bytes:
    return read_exactly(sock, struct.unpack("<I", read_exactly(sock, 4))[0])


def is_hung_up(sock: socket.socket) -> bool:
    with suppress(ConnectionResetError):
        return sock.recv(1) == b""
    return True


def soon() -> Deadline:
    return Deadline.within(PATIENCE_S)


def text(data: str) -> bytes:
    return STRING.encode({"data": data})


def test_a_subscriber_gets_a_header_and_messages(server: TopicServer) -> None:
    assert server.send("/t", text("nobody hears this")) == 0
    sock, header = subscribe(server)
    assert header == {
        "callerid": b"/mouth", "topic": b"/t", "type": b"std_msgs/String", "latching": b"0",
        "md5sum": STRING.md5sum.encode(), "message_definition": STRING.definition.encode(),
    }  # fmt: skip
    assert server.wait_for("/t", {"/ear"}, 1, soon()) == {"/ear"}
    assert server.send("/t", text("one")) == server.send("/t", text("two")) == 1
    assert [receive(sock), receive(sock)] == [text("one"), text("two")]
    assert server.flush("/t", soon()) == set()
    sock.close()
    wait_until(lambda: server.nodes("/t") == set(), "the subscriber is gone")


def test_a_subscriber_of_anything_is_served(server: TopicServer) -> None:
    _, header = subscribe(server, type="*", md5sum="*", callerid="ear_2")
    assert "error" not in header
    assert server.nodes("/t") == {"/ear_2"}


def test_a_latched_topic_gives_its_last_message_to_each_subscriber(server: TopicServer) -> None:
    server.offer(OfferedTopic("/l", STRING.name, STRING, is_latched=True))
    server.send("/l", text("first"))
    server.send("/l", text("last"))
    for name in ("/a", "/b"):
        sock, header = subscribe(server, topic="/l", callerid=name)
        assert header["latching"] == b"1"
        assert receive(sock) == text("last")
    server.send("/l", text("next"))
    assert receive(sock) == text("next")


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"md5sum": "0" * 32}, "md5sums of std_msgs/String differ"),
        ({"md5sum": ""}, "md5sums of std_msgs/String differ"),
        ({"type": "std_msgs/Int8"}, "/t has messages of std_msgs/String, not std_msgs/Int8"),
        ({"topic": "/other"}, "publishes no such topic"),
        ({"topic": "../t"}, "publishes no such topic"),
        ({"callerid": ""}, "callerid is missing"),
        ({"callerid": "/../../etc"}, "no name of a node"),
        ({"callerid": "/a b"}, "no name of a node"),
        ({"callerid": "/" + "a" * 300}, "no name of a node"),
    ],
)
def test_headers_that_are_refused(server: TopicServer, changes: dict[str, str], what: str) -> None:
    sock, header = subscribe(server, **changes)
    assert what in header["error"].decode()
    assert is_hung_up(sock)
    assert server.nodes("/t") == set()


def test_the_reason_of_a_refusal_is_told_to_who_waits(server: TopicServer) -> None:
    subscribe(server, md5sum="0" * 32)
    with pytest.raises(RosNoAnswerError, match="refused: /ear has another definition"):
        server.wait_for("/t", set(), 1, Deadline.within(0.05))
    for _ in range(50):
        subscribe(server, md5sum="0" * 32)
    assert len(server.offered()[0].refused) == module.MOST_REFUSALS


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<I", module.HEADER_BYTES + 1),
        struct.pack("<I", 0xFFFFFFFF) + b"x" * 100,
        struct.pack("<II", 8, 0xFFFFFFFF) + b"abcd",
        struct.pack("<II", 8, 4) + b"abcd",
        struct.pack("<I", 2) + b"ab",
        struct.pack("<I", 0),
        b"GET / HTTP/1.1\r\n\r\n",
    ],
)
def test_bytes_that_are_no_header(server: TopicServer, data: bytes) -> None:
    sock = dial(server, data)
    header = read_header(sock)
    assert list(header) == ["error"]
    assert is_hung_up(sock)


@fuzz
@settings(max_examples=examples(100))
@given(st.binary(min_size=1, max_size=200))
def test_random_bytes_do_no_harm(data: bytes) -> None:
    server = TopicServer("127.0.0.1", "/mouth")
    server.offer(OfferedTopic("/t", STRING.name, STRING))
    try:
        with dial(server, struct.pack("<I", len(data)) + data):
            sock, _ = subscribe(server)
            server.send("/t", text("still here"))
            assert receive(sock) == text("still here")
    finally:
        server.close()


def test_a_header_that_never_ends_is_given_up(
    server: TopicServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "HEADER_S", 0.1)
    slow = dial(server, struct.pack("<I", 1000) + b"x")
    assert is_hung_up(slow)


def test_a_subscriber_that_goes_on_talking_is_dropped(server: TopicServer) -> None:
    sock, _ = subscribe(server)
    sock.sendall(b"x" * 100_000)
    wait_until(lambda: server.nodes("/t") == set(), "it is dropped")


def test_a_crowd_is_turned_away(server: TopicServer) -> None:
    crowd = [subscribe(server, callerid=f"/ear{n}")[0] for n in range(module.MOST_CONNECTIONS)]
    assert len(server.nodes("/t")) == module.MOST_CONNECTIONS
    one_more = dial(server)
    assert is_hung_up(one_more)
    crowd[0].close()
    wait_until(lambda: len(server.nodes("/t")) < module.MOST_CONNECTIONS, "room for another")
    _, header = subscribe(server)
    assert "error" not in header


def test_a_subscriber_that_does_not_read_loses_the_oldest_and_holds_up_nobody(
    server: TopicServer,
) -> None:
    server.offer(OfferedTopic("/q", STRING.name, STRING, queue=3))
    deaf, _ = subscribe(server, topic="/q", callerid="/deaf")
    ear, _ = subscribe(server, topic="/q")
    big = "x" * 1_000_000
    began_s = time.monotonic()
    for number in range(30):
        server.send("/q", text(f"{number} {big}"))
        assert receive(ear) == text(f"{number} {big}")
    assert time.monotonic() - began_s < 20
    assert server.dropped > 10
    assert server.flush("/q", Deadline.within(0.05)) == {"/deaf"}
    heard = [receive(deaf)]
    while heard[-1] != text(f"29 {big}"):
        heard.append(receive(deaf))
    assert len(heard) <= 30 - server.dropped


def test_a_type_that_is_not_known_is_learnt_if_its_sum_agrees(server: TopicServer) -> None:
    kind = message_type("my_msgs/New", UNKNOWN_TEXT)
    good = {"topic": "/n", "type": kind.name, "md5sum": kind.md5sum}
    server.offer(OfferedTopic("/n", kind.name))
    for changes, what in (
        ({"message_definition": ""}, "it sent no definition"),
        ({"message_definition": "int8 x\n"}, "does not have its md5sum"),
        ({"message_definition": "no definition"}, "not known here"),
        ({"message_definition": "#" * (module.LEARNT_BYTES + 1)}, "it sent no definition"),
        ({"message_definition": UNKNOWN_TEXT, "md5sum": "*"}, "does not have its md5sum"),
    ):
        assert what in subscribe(server, **(good | changes))[1]["error"].decode()
    _, header = subscribe(server, **good, message_definition=UNKNOWN_TEXT)
    assert header["md5sum"].decode() == kind.md5sum
    assert server.offered()[-1].kind == kind


def test_waiting_ends_at_its_deadline_or_when_it_is_stopped(server: TopicServer) -> None:
    with pytest.raises(RosNoAnswerError, match="0 of 1 subscribers of /t are connected"):
        server.wait_for("/t", set(), 1, Deadline.within(0.05))
    with pytest.raises(RosStoppedError):
        server.wait_for("/t", set(), 1, Deadline.within(PATIENCE_S, lambda: True))
    sock, _ = subscribe(server)
    assert server.wait_for("/t", {"/ear", "/gone"}, 1, Deadline.within(0.05)) == {"/ear"}
    sock.close()


def test_nothing_is_sent_after_the_end(server: TopicServer) -> None:
    sock, _ = subscribe(server)
    server.close()
    assert is_hung_up(sock)
    with pytest.raises(RosError, match="no longer served"):
        server.send("/t", b"")
