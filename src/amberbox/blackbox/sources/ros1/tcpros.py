"""TCPROS: connect to one publisher of one topic, exchange headers, cut the stream into messages.

A link reads until the connection ends and tries again with back-off.

https://wiki.ros.org/ROS/TCPROS, https://wiki.ros.org/ROS/Connection%20Header
"""

from __future__ import annotations

import math
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosError,
    RosNoAnswerError,
    RosRefusedError,
    TcprosError,
    request_topic,
)
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic

BUFFER_BYTES = 256 << 10
LARGE_BYTES = 64 << 10
KEPT_BYTES = 16 << 20
# initial buffer of a large message; it doubles as bytes arrive, whatever size was announced
FIRST_BYTES = 1 << 20

_length_at = struct.Struct("<I").unpack_from


class Framer:
    """Splits a stream of bytes into messages.

    Small messages are sliced out of one receive buffer that is reused; the beginning of an
    incomplete one is moved to its front. A message above ``LARGE_BYTES`` that is not complete yet
    gets a buffer of its own, which grows with it and is reused for the next one.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._buffer = memoryview(bytearray(BUFFER_BYTES))
        self._rest = b""
        self._store = bytearray()
        self._large = memoryview(b"")
        self._size = 0
        self._filled = 0

    def room(self) -> memoryview:
        """Return the buffer to receive into."""
        return self._large[self._filled :] if self._large else self._buffer

    def received(self, count: int) -> list[bytes]:
        """Process ``count`` bytes received into ``room()``; return the complete messages."""
        if self._large:
            self._filled += count
            if self._filled < len(self._large):
                return []
            if self._filled < self._size:
                store = bytearray(min(self._size, 2 * self._filled))
                store[: self._filled] = self._large
                self._store = store
                self._large = memoryview(store)
                return []
            message = bytes(self._large)
            self._large = memoryview(b"")
            if len(self._store) > KEPT_BYTES:
                self._store = bytearray()
            return [message]
        data = self._rest + self._buffer[:count]
        messages = []
        at, end, limit = 0, len(data), self._limit
        while end - at >= 4:
            size = _length_at(data, at)[0]
            if size > limit:
                text = f"message of {size} bytes announced, {limit} allowed"
                raise TcprosError(text, "store.queue and max_message_mb set how much")
            stop = at + 4 + size
            if stop > end:
                if size > LARGE_BYTES:
                    first = data[at + 4 :]
                    if len(self._store) < min(size, FIRST_BYTES):
                        self._store = bytearray(min(size, FIRST_BYTES))
                    self._size = size
                    self._large = memoryview(self._store)[:size]
                    self._large[: len(first)] = first
                    self._filled = len(first)
                    at = end
                break
            messages.append(data[at + 4 : stop])
            at = stop
        self._rest = data[at:]
        return messages


class ConnectionReader:
    """Reads one connection to its end; ``last_ns`` is when data were last received."""

    def __init__(self, sock: socket.socket, limit: int, now_ns: Callable[[], int]) -> None:
        self._sock = sock
        self._framer = Framer(limit)
        self._now_ns = now_ns
        self.last_ns = now_ns()
        self.has_read = False

    def run(self, deliver: Callable[[bytes, int], None]) -> None:
        """Deliver every message with its time of receipt until the peer ends the connection.

        Raises MalformedError or OSError.
        """
        framer, now_ns, receive = self._framer, self._now_ns, self._sock.recv_into
        while count := receive(framer.room()):
            self.last_ns = received_ns = now_ns()
            self.has_read = True
            for message in framer.received(count):
                deliver(message, received_ns)


HEADER_LIMIT = 16 << 20
_LENGTH = struct.Struct("<I")
_STARTS_WITH_HEADER = re.compile(rb"((std_msgs|roslib)/)?Header[ \t]+header[ \t]*(#.*)?")


@dataclass(frozen=True)
class PublisherInfo:
    """The connection header of a publisher: its node, and type and definition of the topic."""

    node: str
    type: str
    md5sum: str
    definition: bytes
    latching: bool

    def topic(self, name: str) -> Topic:
        """Return the topic with the message definition received with the connection."""
        return Topic(name, "ros1", Schema(self.type, "ros1msg", self.definition), self.latching)

    def has_header(self) -> bool:
        """Return whether messages begin with a std_msgs/Header, thus with its ``seq``."""
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
            raise TcprosError("connection header ends inside a length")
        start = at + 4
        at = start + _LENGTH.unpack_from(body, at)[0]
        name, equals, value = body[start:at].partition(b"=")
        if at > len(body) or not equals:
            raise TcprosError("connection header holds a field without name or end")
        fields[name.decode("utf-8", "replace")] = value
    return fields


def connect(host: str, port: int, topic: str, settings: NodeSettings) -> socket.socket:
    """Open a connection to a publisher and ask for a topic; raise NoAnswerError."""
    try:
        sock = socket.create_connection((host, port), settings.timeout_s)
    except (OSError, OverflowError, ValueError) as error:  # host and port as given by a peer
        text = getattr(error, "strerror", None) or str(error)
        raise RosNoAnswerError(f"{host}:{port}: {text}") from error
    try:
        sock.sendall(encode_header(_request(topic, settings)))
    except OSError as error:
        sock.close()
        raise RosNoAnswerError(f"{host}:{port}: {error.strerror or error}") from error
    return sock


def _request(topic: str, settings: NodeSettings) -> dict[str, str | bytes]:
    return {
        "callerid": settings.caller_id,
        "topic": topic,
        "md5sum": "*",
        "type": "*",
        "tcp_nodelay": "1" if settings.tcp_nodelay else "0",
    }


def read_answer(sock: socket.socket, fallback_name: str) -> PublisherInfo:
    """Read the publisher's header; raise RefusedError, MalformedError or NoAnswerError."""
    fields = read_header(sock)
    if "error" in fields:
        raise RosRefusedError(f"publisher refused: {_text(fields['error'])}")
    if "type" not in fields or "md5sum" not in fields:
        raise TcprosError("connection header without type or md5sum")
    return PublisherInfo(
        node=_text(fields.get("callerid", fallback_name.encode())),
        type=_text(fields["type"]),
        md5sum=_text(fields["md5sum"]),
        definition=fields.get("message_definition", b""),
        latching=fields.get("latching") == b"1",
    )


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace").strip()


def read_header(sock: socket.socket, end_s: float = math.inf) -> dict[str, bytes]:
    """Read a connection header until a moment of the monotonic clock.

    Raises MalformedError or NoAnswerError. Without ``end_s`` the time limit of the socket holds for
    each part that arrives.
    """
    try:
        length = _LENGTH.unpack(read_exactly(sock, 4, end_s))[0]
        if length > HEADER_LIMIT:
            raise TcprosError(f"connection header of {length} bytes")
        return decode_header(read_exactly(sock, length, end_s))
    except OSError as error:
        raise RosNoAnswerError(f"no connection header: {error.strerror or error}") from error


def read_exactly(sock: socket.socket, count: int, end_s: float = math.inf) -> bytes:
    """Read bytes until a moment of the monotonic clock; raise OSError or NoAnswerError."""
    data = bytearray()
    while len(data) < count:
        if end_s < math.inf:
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError("timed out")
            sock.settimeout(left_s)
        part = sock.recv(min(count - len(data), 1 << 16))
        if not part:
            raise RosNoAnswerError("the peer closed the connection")
        data += part
    return bytes(data)


def listen_only(sock: socket.socket, dead_after_s: float) -> None:
    """Remove the time limit of a socket and detect a dead peer by keep-alive probes.

    Three probes a quarter of ``dead_after_s`` apart: shorter interruptions lose nothing.
    """
    part_s = max(1, round(dead_after_s / 4))
    sock.settimeout(None)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, part_s)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, part_s)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)


ENDED = "the publisher closed the connection"
FAILED = "the recorder failed"


class _LinkOwner(Protocol):
    """Callbacks of a link, called from its thread."""

    def opened(
        self, link: PublisherLink, publisher: PublisherInfo
    ) -> Callable[[bytes, int], None] | None:
        """Handle a finished handshake; return where messages go, None to close the connection."""

    def closed(self, link: PublisherLink, reason: str, since_ns: int | None) -> None:
        """Handle the end of a connection that ``opened`` accepted; ``since_ns`` is when it died."""

    def failed(self, link: PublisherLink, error: RosError) -> None:
        """Handle a failed attempt to connect."""

    def retry_limit_s(self, link: PublisherLink) -> float:
        """Return the longest wait between two attempts."""

    def malformed(self, link: PublisherLink, error: RosError) -> None:
        """Handle data that is not TCPROS; the connection is closed and tried again."""

    def crashed(self, error: Exception) -> None:
        """Handle an internal error."""


class PublisherLink:
    """A thread that keeps one connection. ``peer`` and ``endpoint`` are known once it is open.

    A link is parked while the same process is connected under another address.
    """

    def __init__(
        self,
        topic: str,
        uri: str,
        owner: _LinkOwner,
        settings: NodeSettings,
        now_ns: Callable[[], int],
    ) -> None:
        self.topic = topic
        self.uri = uri
        self.peer = ""
        self.endpoint: object = None
        self.failures = 0
        self.error = ""  # why the last attempt failed; empty once a connection is open
        self.is_parked = False
        self.was_unregistered = threading.Event()
        self._owner = owner
        self._settings = settings
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._sock: socket.socket | None = None
        self._closing = ""
        self._thread = threading.Thread(target=self._run, name=f"ros{topic}", daemon=True)

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def retry_now(self) -> None:
        """Try to connect again at once."""
        self.failures = 0
        self.is_parked = False
        self._wake.set()

    def close(self, reason: str) -> None:
        """Close the connection and end the thread; data already received is still read."""
        with self._lock:
            self._closing = self._closing or reason
            if self._sock is not None:
                with suppress(OSError):  # the peer may have been faster
                    self._sock.shutdown(socket.SHUT_RDWR)
        self._wake.set()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread to end."""
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    @property
    def is_closing(self) -> bool:
        """Return whether ``close`` was called."""
        return bool(self._closing)

    def _run(self) -> None:
        try:
            while not self._closing:
                self._attempt()
                longest_s = self._owner.retry_limit_s(self)
                delay_s = self._settings.first_retry_s * 2.0 ** min(self.failures, 16)
                self._wake.wait(None if self.is_parked else min(delay_s, longest_s))
                self._wake.clear()
        except Exception as error:
            self._owner.crashed(error)

    def _attempt(self) -> None:
        try:
            host, port = request_topic(self.uri, self.topic, self._settings)
            with connect(host, port, self.topic, self._settings) as sock:
                if self._set_socket(sock):
                    self._serve(sock, read_answer(sock, self.uri))
        except RosError as error:
            self.failures += 1
            self.error = error.what
            self._owner.failed(self, error)
        finally:
            self._set_socket(None)

    def _set_socket(self, sock: socket.socket | None) -> bool:
        """Set the socket that ``close`` shuts down; False if ``close`` was called before."""
        with self._lock:
            self._sock = sock
            return not self._closing

    def _serve(self, sock: socket.socket, publisher: PublisherInfo) -> None:
        listen_only(sock, self._settings.dead_after_s)
        self.error = ""
        self.peer = publisher.node
        self.endpoint = sock.getpeername()
        deliver = self._owner.opened(self, publisher)
        self.is_parked = deliver is None
        if deliver is None:
            return
        reason: str = FAILED
        since_ns: int | None = None
        try:
            reason, since_ns = self._read(sock, deliver)
        finally:
            self._owner.closed(self, self._closing or reason, since_ns)

    def _read(self, sock: socket.socket, deliver: Callable[[bytes, int], None]) -> tuple[str, int]:
        reader = ConnectionReader(sock, self._settings.message_limit, self._now_ns)
        self.failures += 1  # until the connection has been of use
        try:
            reader.run(deliver)
        except TcprosError as error:
            self._owner.malformed(self, error)
            return f"malformed data: {error.what}", self._now_ns()
        except OSError as error:
            self._count_use(reader)
            return f"connection lost: {error.strerror}", self._last_received_ns(reader)
        self._count_use(reader)
        return ENDED, self._now_ns()

    def _count_use(self, reader: ConnectionReader) -> None:
        if reader.has_read:
            self.failures = 0

    def _last_received_ns(self, reader: ConnectionReader) -> int:
        """Return when the peer was last known to be alive, by data or keep-alive answers."""
        silence_ns = round((self._settings.dead_after_s + 1) * NS)
        return max(reader.last_ns, self._now_ns() - silence_ns)
