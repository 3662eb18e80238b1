"""TCPROS connections: the header that both sides exchange, and the socket that follows it.

https://wiki.ros.org/ROS/TCPROS, https://wiki.ros.org/ROS/Connection%20Header
"""

from __future__ import annotations

import re
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from amberbox.blackbox.ros1.settings import MalformedError, NoAnswerError, RefusedError, Settings
from amberbox.core.types import Schema, Topic

HEADER_LIMIT = 16 << 20
_LENGTH = struct.Struct("<I")
_STARTS_WITH_HEADER = re.compile(rb"((std_msgs|roslib)/)?Header[ \t]+header[ \t]*(#.*)?")


@dataclass(frozen=True)
class Publisher:
    """What a publisher says of itself and its topic in the connection header."""

    node: str
    type: str
    md5sum: str
    definition: bytes
    latching: bool

    def topic(self, name: str) -> Topic:
        """Return the topic with the message definition that came over the wire."""
        return Topic(name, "ros1", Schema(self.type, "ros1msg", self.definition), self.latching)

    def has_header(self) -> bool:
        """Tell whether messages begin with a std_msgs/Header, thus with its ``seq``."""
        for line in self.definition.splitlines():
            text = line.strip()
            if text and not text.startswith(b"#") and b"=" not in text.split(b"#")[0]:
                return _STARTS_WITH_HEADER.fullmatch(text) is not None
        return False


def encode_header(fields: Mapping[str, str | bytes]) -> bytes:
    """Write a connection header with its length in front."""
    body = b"".join(_field(name, value) for name, value in fields.items())
    return _LENGTH.pack(len(body)) + body


def _field(name: str, value: str | bytes) -> bytes:
    data = name.encode() + b"=" + (value.encode() if isinstance(value, str) else value)
    return _LENGTH.pack(len(data)) + data


def decode_header(body: bytes) -> dict[str, bytes]:
    """Read a connection header without its length; raise MalformedError."""
    fields = {}
    at = 0
    while at < len(body):
        if at + 4 > len(body):
            raise MalformedError("connection header ends inside a length")
        start = at + 4
        at = start + _LENGTH.unpack_from(body, at)[0]
        name, equals, value = body[start:at].partition(b"=")
        if at > len(body) or not equals:
            raise MalformedError("connection header holds a field without name or end")
        fields[name.decode("utf-8", "replace")] = value
    return fields


def connect(host: str, port: int, topic: str, settings: Settings) -> socket.socket:
    """Open a connection to a publisher and ask for a topic; raise NoAnswerError."""
    try:
        sock = socket.create_connection((host, port), settings.timeout_s)
    except (OSError, OverflowError, ValueError) as error:  # what a peer calls host and port
        text = getattr(error, "strerror", None) or str(error)
        raise NoAnswerError(f"{host}:{port}: {text}") from error
    try:
        sock.sendall(encode_header(_request(topic, settings)))
    except OSError as error:
        sock.close()
        raise NoAnswerError(f"{host}:{port}: {error.strerror or error}") from error
    return sock


def _request(topic: str, settings: Settings) -> dict[str, str | bytes]:
    return {
        "callerid": settings.caller_id,
        "topic": topic,
        "md5sum": "*",
        "type": "*",
        "tcp_nodelay": "1" if settings.tcp_nodelay else "0",
    }


def read_answer(sock: socket.socket, fallback_name: str) -> Publisher:
    """Read the publisher's header; raise RefusedError, MalformedError or NoAnswerError."""
    try:
        length = _LENGTH.unpack(_read_exactly(sock, 4))[0]
        if length > HEADER_LIMIT:
            raise MalformedError(f"connection header of {length} bytes")
        fields = decode_header(_read_exactly(sock, length))
    except OSError as error:
        raise NoAnswerError(f"no connection header: {error.strerror or error}") from error
    if "error" in fields:
        raise RefusedError(f"publisher refused: {_text(fields['error'])}")
    if "type" not in fields or "md5sum" not in fields:
        raise MalformedError("connection header without type or md5sum")
    return Publisher(
        node=_text(fields.get("callerid", fallback_name.encode())),
        type=_text(fields["type"]),
        md5sum=_text(fields["md5sum"]),
        definition=fields.get("message_definition", b""),
        latching=fields.get("latching") == b"1",
    )


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace").strip()


def _read_exactly(sock: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        part = sock.recv(min(count - len(data), 1 << 16))
        if not part:
            raise NoAnswerError("the publisher closed the connection during the handshake")
        data += part
    return bytes(data)


def listen_only(sock: socket.socket, dead_after_s: float) -> None:
    """Prepare a socket for reading for hours: no time limit, but a dead peer is noticed.

    Three probes a quarter of ``dead_after_s`` apart: shorter cuts of the cable lose nothing.
    """
    part_s = max(1, round(dead_after_s / 4))
    sock.settimeout(None)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, part_s)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, part_s)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
