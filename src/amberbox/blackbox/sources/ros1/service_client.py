"""Calls services of ROS 1: found by the master, one connection for each call.

A service tells its type and MD5 sum, not its definition; the caller brings that.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosError,
    RosMaster,
    RosNoAnswerError,
    RosRefusedError,
    TcprosError,
    host_and_port,
    mapped_host,
)
from amberbox.blackbox.sources.ros1.message_type import MOST_BYTES, ServiceType
from amberbox.blackbox.sources.ros1.tcpros import encode_header, read_exactly, read_header

MOST_ERROR_BYTES = 4096  # of a service's own text; what is longer is cut
_LENGTH = struct.Struct("<I")

T = TypeVar("T")


@dataclass(frozen=True)
class ServiceInfo:
    """What a service tells about itself."""

    node: str
    type: str
    md5sum: str


class ServiceUnreachableError(RosNoAnswerError):
    """No connection to the address that the master has of a service."""


class ServiceFailedError(RosError):
    """A service answered that it failed."""


def probe_service(name: str, settings: NodeSettings, deadline: Deadline) -> ServiceInfo:
    """Request the type and MD5 sum of a service; it is not called. Raises RosError."""
    return _within(
        deadline, f"the service {name} does not answer", lambda end: _probe(name, settings, end)
    )


def call_service(
    name: str,
    kind: ServiceType,
    request: bytes,
    settings: NodeSettings,
    deadline: Deadline,
    sending: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Call a service and return its response, as ``MessageType.decode`` does.

    ``sending`` is called right before the request is sent: an error before means that the service
    has not been called. Raises ServiceFailedError with the text of the service, and RosError.
    """

    def call(call: _OpenCall) -> dict[str, Any]:
        with call.connect(name, settings, {"service": name, "md5sum": kind.md5sum}) as sock:
            info = _info(name, read_header(sock, call.end_s))
            if info.md5sum not in (kind.md5sum, "*"):
                what = f"{name} has another definition of {kind.name}"
                raise RosRefusedError(f"{what} (md5sum {info.md5sum[:100]}, not {kind.md5sum})")
            deadline.check(f"the service {name} answers too late")
            sending()
            sock.sendall(_LENGTH.pack(len(request)) + request)
            return _response(name, kind, sock, call.end_s, settings)

    return _within(deadline, f"the service {name} does not answer in time", call)


class _OpenCall:
    """The connection of a call; ``hang_up`` ends it from another thread."""

    def __init__(self, end_s: float) -> None:
        self.end_s = end_s
        self._sock: socket.socket | None = None
        self._is_over = False

    def connect(
        self, name: str, settings: NodeSettings, fields: dict[str, str | bytes]
    ) -> socket.socket:
        """Connect to a service and send a connection header; raise RosError."""
        host, port = _address(name, settings)
        left_s = max(0.01, self.end_s - time.monotonic())
        try:
            sock = socket.create_connection((host, port), min(left_s, settings.timeout_s))
        except (OSError, OverflowError, ValueError) as error:  # as the master gave host and port
            text = getattr(error, "strerror", None) or str(error)
            raise ServiceUnreachableError(f"{name} at {host}:{port}: {text}") from error
        self._sock = sock
        if self._is_over:
            sock.close()
            raise RosNoAnswerError(f"{name}: too late")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.settimeout(left_s)
        sock.sendall(encode_header({"callerid": settings.caller_id, **fields}))
        return sock

    def hang_up(self) -> None:
        """End the connection: the thread that reads gets an error."""
        self._is_over = True
        if self._sock is not None:
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_RDWR)


def _within(deadline: Deadline, what: str, work: Callable[[_OpenCall], T]) -> T:
    """Run a call, and hang up when its time is up; errors of its socket become RosError."""
    call = _OpenCall(deadline.end_s)

    def run() -> T:
        try:
            return work(call)
        except TimeoutError as error:
            raise RosNoAnswerError(what) from error
        except OSError as error:
            raise RosNoAnswerError(f"{what}: {error.strerror or error}") from error

    try:
        return deadline.call(run, what)
    finally:
        call.hang_up()


def _probe(name: str, settings: NodeSettings, call: _OpenCall) -> ServiceInfo:
    fields: dict[str, str | bytes] = {"service": name, "md5sum": "*", "probe": "1"}
    with call.connect(name, settings, fields) as sock:
        return _info(name, read_header(sock, call.end_s))


def _address(name: str, settings: NodeSettings) -> tuple[str, int]:
    """Return host and port of a service, as the master knows them; raise RosError."""
    master = RosMaster(settings)
    try:
        uri = master.service_uri(name)
    except RosRefusedError as error:
        raise RosRefusedError(f"there is no service {name}", "is its node running?") from error
    finally:
        master.close()
    try:
        host, port = host_and_port(uri)
    except ValueError as error:
        raise RosNoAnswerError(f"the master gave no address of {name}: {error}") from error
    return mapped_host(host, settings.hosts), port


def _info(name: str, fields: dict[str, bytes]) -> ServiceInfo:
    texts = {key: value.decode("utf-8", "replace").strip() for key, value in fields.items()}
    if "error" in texts:
        raise RosRefusedError(f"{name} refused the call: {_one_line(texts['error'])}")
    if "md5sum" not in texts:
        raise TcprosError(f"{name} sent a connection header without md5sum")
    return ServiceInfo(texts.get("callerid", ""), texts.get("type", ""), texts["md5sum"])


def _response(
    name: str, kind: ServiceType, sock: socket.socket, end_s: float, settings: NodeSettings
) -> dict[str, Any]:
    """Read the response: a byte that is 1, then the message; or a byte 0, then a text."""
    try:
        succeeded = read_exactly(sock, 1, end_s) != b"\0"
        size = _LENGTH.unpack(read_exactly(sock, 4, end_s))[0]
        limit = min(settings.message_limit, MOST_BYTES)
        if succeeded and size > limit:
            raise TcprosError(f"{name} announced a response of {size} bytes, {limit} are allowed")
        data = read_exactly(sock, size if succeeded else min(size, MOST_ERROR_BYTES), end_s)
    except RosNoAnswerError as error:
        raise RosNoAnswerError(f"{name} ended without a response", "did its node end?") from error
    if not succeeded:
        text = _one_line(data.decode("utf-8", "replace")) or "it gave no reason"
        raise ServiceFailedError(f"{name} failed: {text}")
    return kind.response.decode(data)


def _one_line(text: str) -> str:
    return " ".join(text.split())[:500]
