"""The TCPROS connection header, from both sides and with every defect."""

from __future__ import annotations

import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.sources.ros1.master import RosNoAnswerError, RosRefusedError, TcprosError
from amberbox.blackbox.sources.ros1.tcpros import (
    PublisherInfo,
    decode_header,
    encode_header,
    listen_only,
    read_answer,
)
from amberbox.core.types import Schema, Topic

FIELDS = {"type": "std_msgs/String", "md5sum": "992c", "callerid": "/talker", "latching": "1"}

names = st.text(st.characters(codec="utf-8", exclude_characters="="), max_size=20)


def answer(data: bytes) -> PublisherInfo:
    """Read what a publisher answers that sends ``data`` and hangs up."""
    ours, theirs = socket.socketpair()
    with ours:
        with theirs:
            theirs.sendall(data)
        return read_answer(ours, "http://there:1/")


def publisher(definition: bytes) -> PublisherInfo:
    return PublisherInfo("/n", "a/B", "1", definition, latching=False)


@given(st.dictionaries(names, st.binary(max_size=100), max_size=8))
def test_what_is_written_is_read(fields: dict[str, bytes]) -> None:
    data = encode_header(dict(fields))
    assert struct.unpack_from("<I", data)[0] == len(data) - 4
    assert decode_header(data[4:]) == fields


@pytest.mark.parametrize(
    "body", [b"\x05\x00", b"\x05\x00\x00\x00a=1", b"\x01\x00\x00\x00a", b"\x00\x00\x00\x00"]
)
def test_a_broken_header_is_malformed(body: bytes) -> None:
    with pytest.raises(TcprosError):
        decode_header(body)


def test_an_answer_tells_type_and_definition() -> None:
    definition = "string data # Straße\n".encode()
    heard = answer(encode_header({**FIELDS, "message_definition": definition}))
    assert heard == PublisherInfo("/talker", "std_msgs/String", "992c", definition, latching=True)
    schema = Schema("std_msgs/String", "ros1msg", definition)
    assert heard.topic("/chatter") == Topic("/chatter", "ros1", schema, latched=True)


def test_an_answer_without_name_is_called_by_its_address() -> None:
    heard = answer(encode_header({"type": "a/B", "md5sum": "1"}))
    assert (heard.node, heard.latching, heard.definition) == ("http://there:1/", False, b"")


def test_a_refusal_is_told() -> None:
    with pytest.raises(RosRefusedError, match="no such topic"):
        answer(encode_header({"error": "no such topic"}))


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b"", RosNoAnswerError),
        (b"HTTP/1.1 400 Bad Request\r\n", TcprosError),
        (encode_header(dict(FIELDS))[:-1], RosNoAnswerError),
        (encode_header({"callerid": "/talker"}), TcprosError),
        (struct.pack("<I", 1 << 30), TcprosError),
    ],
)
def test_anything_else_is_an_error(data: bytes, error: type[Exception]) -> None:
    with pytest.raises(error):
        answer(data)


@pytest.mark.parametrize(
    ("definition", "expected"),
    [
        (b"Header header\nfloat64 x\n", True),
        (b"# text\n\nuint8 A=1 # one\n  std_msgs/Header   header # stamp\n", True),
        (b"roslib/Header header\nfloat64 x\n", True),
        (b"float64 x\nHeader header\n", False),
        (b"Header h\n", False),
        (b"", False),
    ],
)
def test_messages_that_begin_with_a_header_are_known(definition: bytes, expected: bool) -> None:
    assert publisher(definition).has_header() is expected


def test_a_socket_for_hours_is_probed() -> None:
    server = socket.create_server(("127.0.0.1", 0))
    with server, socket.create_connection(server.getsockname()) as sock:
        listen_only(sock, 40.0)
        assert sock.gettimeout() is None
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 10
