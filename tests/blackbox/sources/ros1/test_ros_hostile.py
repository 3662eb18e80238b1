"""Masters and publishers with arbitrary answers: reported errors, never a crash."""

from __future__ import annotations

import gzip
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.sources.ros1 import tcpros
from amberbox.blackbox.sources.ros1.master import (
    RosError,
    RosMaster,
    RosNoAnswerError,
    SubscriberSettings,
    TcprosError,
    request_topic,
)
from amberbox.blackbox.sources.ros1.tcpros import decode_header
from tests.fuzzing import examples, fuzz


class Peer:
    """Answers every connection with the same bytes, and hangs up."""

    def __init__(self) -> None:
        self.answer = b""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.settings = SubscriberSettings(
            master_uri=f"http://127.0.0.1:{self.port}/", timeout_s=0.5
        )
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                with connection, suppress(OSError):
                    connection.recv(65536)
                    connection.sendall(self.answer)

    def close(self) -> None:
        self._listener.close()

    def answers(self, value: Any) -> None:
        text = xmlrpc.client.dumps((value,), methodresponse=True, allow_none=True)
        self.sends(b"200 OK", text.encode())

    def sends(self, status: bytes, body: bytes, more: bytes = b"") -> None:
        self.answer = b"HTTP/1.1 %s\r\n%s\r\n%s" % (status, more, body)


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    made = Peer()
    yield made
    made.close()


def ask(peer: Peer) -> Any:
    master = RosMaster(peer.settings)
    try:
        return master.graph()
    finally:
        master.close()


@pytest.mark.parametrize(
    ("status", "more"),
    [
        (b"200 OK", b"Content-Length: 99999999999\r\n"),
        (b"500 no", b"Content-Length: 99999999999\r\n"),
        (b"200 OK", b"Content-Encoding: gzip\r\n"),
        (b"200 OK", b"Transfer-Encoding: chunked\r\n"),
    ],
)
def test_what_a_master_announces_is_not_believed(peer: Peer, status: bytes, more: bytes) -> None:
    peer.sends(status, gzip.compress(bytes(100_000_000)) if b"gzip" in more else b"ffff", more)
    with pytest.raises(RosNoAnswerError):
        ask(peer)


@pytest.mark.parametrize(
    "value", [5, [1, "", 5], [1, "", [[5], [], []]], [1, "", [[["/t", 5]], [], []]]]
)
def test_states_that_are_none_are_no_answer(peer: Peer, value: Any) -> None:
    peer.answers(value)
    with pytest.raises(RosNoAnswerError):
        ask(peer)


@pytest.mark.parametrize("address", [["", 1], ["127.0.0.1", 99999], ["a\u20ac" * 99, 1], ["a", -1]])
def test_addresses_that_are_none_are_no_answer(peer: Peer, address: list[Any]) -> None:
    peer.answers([1, "", ["TCPROS", *address]])
    with pytest.raises(RosNoAnswerError):
        host, port = request_topic(peer.settings.master_uri, "/t", peer.settings)
        tcpros.connect(host, port, "/t", peer.settings)


@fuzz
@settings(max_examples=examples(25))
@given(st.binary(max_size=200))
def test_random_answers_are_errors_of_ros(peer: Peer, answer: bytes) -> None:
    peer.answer = answer
    with pytest.raises(RosNoAnswerError):
        ask(peer)
    with (
        suppress(RosError),
        tcpros.connect("127.0.0.1", peer.port, "/t", peer.settings) as connection,
    ):
        tcpros.read_answer(connection, "nobody")


@fuzz
@settings(max_examples=examples(50))
@given(st.binary(max_size=200))
def test_random_headers_are_fields_or_malformed(body: bytes) -> None:
    with suppress(TcprosError):
        assert all(isinstance(name, str) for name in decode_header(body))
