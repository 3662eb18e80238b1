"""Calls of services that answer well, badly, slowly, with anything, or not at all."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosError,
    RosNoAnswerError,
    RosRefusedError,
    TcprosError,
)
from amberbox.blackbox.sources.ros1.message_type import service_type
from amberbox.blackbox.sources.ros1.service_client import (
    ServiceFailedError,
    ServiceInfo,
    call_service,
    probe_service,
)
from amberbox.blackbox.sources.ros1.tcpros import encode_header, read_exactly, read_header
from amberbox.testing.clock import PATIENCE_S
from tests.fuzzing import examples, fuzz
from tests.support.ros_network import RosMaster

SET = service_type("std_srvs/SetBool")
HEADER = encode_header({"callerid": "/s", "type": SET.name, "md5sum": SET.md5sum})
Answer = Callable[[socket.socket], None]


class FakeService:
    """A service ``/set`` that sends a header, reads a request and then does as it is told."""

    def __init__(self, master: RosMaster) -> None:
        self.header = HEADER
        self.headers: list[dict[str, bytes]] = []
        self.requests: list[bytes] = []
        self.then: Answer = lambda sock: sock.sendall(response(True, "yes"))
        self._listener = socket.create_server(("127.0.0.1", 0))
        master.services["/set"] = f"rosrpc://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                sock, _ = self._listener.accept()
                threading.Thread(target=self._answer, args=(sock,), daemon=True).start()

    def _answer(self, sock: socket.socket) -> None:
        with sock, suppress(OSError, RosError):
            self.headers.append(read_header(sock))
            sock.sendall(self.header)
            if "probe" in self.headers[-1]:
                return
            self.requests.append(read_exactly(sock, struct.unpack("<I", read_exactly(sock, 4))[0]))
            self.then(sock)

    def close(self) -> None:
        self._listener.close()


def response(success: bool, message: str) -> bytes:
    data = SET.response.encode({"success": success, "message": message})
    return b"\1" + struct.pack("<I", len(data)) + data


def never(sock: socket.socket) -> None:
    """Keep the connection open and send nothing until the peer goes."""
    sock.recv(1)


def drip(sock: socket.socket) -> None:
    """Send one byte after the other, without end."""
    sock.sendall(b"\1" + struct.pack("<I", 10_000))
    while True:
        sock.sendall(b"x")
        time.sleep(0.02)


@pytest.fixture(scope="module")
def master() -> Iterator[RosMaster]:
    made = RosMaster()
    yield made
    made.stop()


@pytest.fixture
def service(master: RosMaster) -> Iterator[FakeService]:
    made = FakeService(master)
    yield made
    made.close()


def call(master: RosMaster, name: str = "/set", within_s: float = PATIENCE_S, **more: Any) -> Any:
    more = {"timeout_s": PATIENCE_S, **more}
    settings = NodeSettings(master_uri=master.uri, caller_id="/caller", **more)
    request = SET.request.encode({"data": True})
    return call_service(name, SET, request, settings, Deadline.within(within_s))


def test_a_call(master: RosMaster, service: FakeService) -> None:
    assert call(master) == {"success": True, "message": "yes"}
    assert service.requests == [b"\1"]
    header = {"callerid": b"/caller", "service": b"/set", "md5sum": SET.md5sum.encode()}
    assert service.headers == [header]


def test_a_probe_calls_nothing(master: RosMaster, service: FakeService) -> None:
    settings = NodeSettings(master_uri=master.uri, caller_id="/caller")
    info = probe_service("/set", settings, Deadline.within(PATIENCE_S))
    assert info == ServiceInfo("/s", SET.name, SET.md5sum)
    assert service.requests == []
    service.header = encode_header({"callerid": "/s"})
    with pytest.raises(TcprosError, match="without md5sum"):
        probe_service("/set", settings, Deadline.within(PATIENCE_S))


@pytest.mark.parametrize(
    ("answer", "kind", "what"),
    [
        (b"\0" + struct.pack("<I", 7) + b"no\nway!", ServiceFailedError, "/set failed: no way!"),
        (b"\0" + struct.pack("<I", 0), ServiceFailedError, "gave no reason"),
        (b"\0" + struct.pack("<I", 0xFFFFFFFF) + b"a" * 5000, ServiceFailedError, "failed: aaa"),
        (b"\1" + struct.pack("<I", 0xFFFFFFFF), TcprosError, "response of 4294967295 bytes"),
        (b"\1" + struct.pack("<I", 1) + b"\1", TcprosError, "does not fit its type"),
        (b"\1" + struct.pack("<I", 9) + b"\1", RosNoAnswerError, "ended without a response"),
        (b"\1", RosNoAnswerError, "ended without a response"),
        (b"", RosNoAnswerError, "ended without a response"),
    ],
)
def test_answers_that_are_no_success(
    master: RosMaster, service: FakeService, answer: bytes, kind: type[RosError], what: str
) -> None:
    service.then = lambda sock: sock.sendall(answer)
    with pytest.raises(kind, match=what):
        call(master)


@pytest.mark.parametrize(
    ("header", "what"),
    [
        (
            encode_header({"error": "md5sums do\nnot match"}),
            "refused the call: md5sums do not match",
        ),
        (encode_header({"md5sum": "0" * 32}), "has another definition of std_srvs/SetBool"),
        (encode_header({"callerid": "/s"}), "without md5sum"),
        (struct.pack("<I", 0xFFFFFFFF), "connection header of 4294967295 bytes"),
        (struct.pack("<II", 8, 100) + b"abcd", "field without name or end"),
    ],
)
def test_headers_that_are_refused(
    master: RosMaster, service: FakeService, header: bytes, what: str
) -> None:
    service.header = header
    with pytest.raises(RosError, match=what):
        call(master)


@pytest.mark.parametrize("header", [b"", struct.pack("<I", 100) + b"x"])
def test_headers_that_do_not_end(master: RosMaster, service: FakeService, header: bytes) -> None:
    service.header = header
    with pytest.raises(RosError, match=r"not answer in time|no connection header"):
        call(master, within_s=0.5)


@pytest.mark.parametrize("then", [never, drip])
def test_a_service_that_does_not_end_is_given_up(
    master: RosMaster, service: FakeService, then: Answer
) -> None:
    service.then = then
    began_s = time.monotonic()
    with pytest.raises(RosNoAnswerError):
        call(master, within_s=0.3)
    assert time.monotonic() - began_s < 20


def test_a_call_can_be_stopped(master: RosMaster, service: FakeService) -> None:
    stop = threading.Event()
    ended = threading.Event()

    def wait(sock: socket.socket) -> None:
        stop.set()
        never(sock)
        ended.set()

    service.then = wait
    settings = NodeSettings(master_uri=master.uri, caller_id="/caller")
    with pytest.raises(RosStoppedError):
        call_service("/set", SET, b"\1", settings, Deadline.within(60, stop.is_set))
    assert ended.wait(PATIENCE_S), "the connection has been closed"


def test_a_service_that_is_not_there(master: RosMaster) -> None:
    with pytest.raises(RosRefusedError, match="there is no service /nothing"):
        call(master, "/nothing")
    for uri in ("", "rosrpc://", "rosrpc://127.0.0.1:0", "rosrpc://127.0.0.1:1", "x" * 1000,
                "rosrpc://127.0.0.1:99999", "http://[::1", "rosrpc://a\nb:1"):  # fmt: skip
        master.services["/bad"] = uri
        with pytest.raises(RosNoAnswerError):
            call(master, "/bad", within_s=3)


def test_a_host_that_does_not_resolve_is_mapped(master: RosMaster, service: FakeService) -> None:
    port = master.services["/set"].rpartition(":")[2]
    master.services["/set"] = f"rosrpc://Robot-PC:{port}"
    assert call(master, hosts={"robot-pc": "127.0.0.1"})["success"]


@fuzz
@settings(max_examples=examples(100))
@given(st.binary(max_size=60))
def test_random_answers_are_a_response_or_an_error(master: RosMaster, answer: bytes) -> None:
    service = FakeService(master)
    service.then = lambda sock: sock.sendall(answer)
    try:
        with suppress(RosError):
            assert set(call(master)) == {"success", "message"}
    finally:
        service.close()
