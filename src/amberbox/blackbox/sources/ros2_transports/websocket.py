"""A WebSocket client that reads in one thread: bounded messages, probes of a silent server."""

from __future__ import annotations

import json
import socket
import ssl
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from amberbox.core.errors import AmberboxError

if TYPE_CHECKING:
    from websockets.client import ClientProtocol

_READ_BYTES = 256 << 10
_SEND_S = 5.0
_CLOSE_S = 0.3


class WebSocketError(AmberboxError):
    """The connection cannot be made, or has ended; ``what`` is why."""


class WebSocket:
    """An open connection."""

    def __init__(
        self, connection: socket.socket, protocol: ClientProtocol, dead_after_s: float
    ) -> None:
        self._socket = connection
        self._protocol = protocol
        self._dead_after_s = dead_after_s
        self._heard_s = time.monotonic()
        self._probed = False
        self._parts: list[bytes] = []
        self._is_text = False

    @classmethod
    def open(
        cls,
        url: str,
        subprotocols: Sequence[str],
        *,
        hosts: Mapping[str, str],
        authority: str,
        longest_bytes: int,
        timeout_s: float,
        dead_after_s: float,
    ) -> WebSocket:
        """Connect; raises WebSocketError with the reason when that fails within the time."""
        from websockets.client import ClientProtocol
        from websockets.uri import parse_uri

        names: Any = list(subprotocols)
        protocol = ClientProtocol(parse_uri(url), subprotocols=names, max_size=longest_bytes)
        try:
            connection = _connect(url, hosts, authority, timeout_s)
        except (OSError, ValueError) as error:
            raise WebSocketError(f"no connection: {error}") from error
        made = cls(connection, protocol, dead_after_s)
        try:
            made._shake_hands(timeout_s)
        except BaseException:
            connection.close()
            raise
        return made

    def __enter__(self) -> WebSocket:
        return self

    def __exit__(self, *_: object) -> None:
        """Say goodbye and close, without waiting for an answer."""
        with suppress(Exception):  # what the protocol raises where it is not open any more
            self._protocol.send_close(1000)
            self._socket.settimeout(_CLOSE_S)
            self._flush()
        self._socket.close()

    def _shake_hands(self, timeout_s: float) -> None:
        from websockets.protocol import CONNECTING

        end_s = time.monotonic() + timeout_s
        self._protocol.send_request(self._protocol.connect())
        self._flush()
        while self._protocol.state is CONNECTING:
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                raise WebSocketError(f"no answer to the WebSocket request within {timeout_s:.0f} s")
            self._read(left_s)
            if self._protocol.handshake_exc is not None:
                raise WebSocketError(f"no WebSocket: {self._protocol.handshake_exc}")

    def send_text(self, value: Any) -> None:
        """Send a value as JSON; raises WebSocketError when the connection has ended."""
        self._protocol.send_text(json.dumps(value).encode())
        self._flush()

    def receive(self, timeout_s: float) -> list[tuple[bool, bytes]]:
        """Return the messages that have arrived, as (whether it is text, its bytes).

        Waits for one at most for the time given. Raises WebSocketError when the connection has
        ended, or when its other side does not even answer probes.
        """
        from websockets.protocol import OPEN

        found = self._messages()  # with the answer to the handshake some may have come
        if not found:
            self._read(timeout_s)
            found = self._messages()
        if found:
            return found
        if self._protocol.state is not OPEN:
            raise WebSocketError(self._why_closed())
        silent_s = time.monotonic() - self._heard_s
        if silent_s > self._dead_after_s:
            raise WebSocketError(f"nothing was heard for {silent_s:.0f} s, nor an answer to probes")
        if silent_s > self._dead_after_s / 2 and not self._probed:
            self._probed = True
            self._protocol.send_ping(b"amberbox")
            self._flush()
        return found

    def _read(self, timeout_s: float) -> None:
        self._socket.settimeout(timeout_s)
        try:
            data = self._socket.recv(_READ_BYTES)
        except (TimeoutError, ssl.SSLWantReadError):
            return
        except OSError as error:
            raise WebSocketError(f"the connection broke: {error.strerror or error}") from error
        self._heard_s = time.monotonic()
        self._probed = False
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._flush()

    def _flush(self) -> None:
        """Send what the protocol has to say, such as answers to pings."""
        data = b"".join(self._protocol.data_to_send())
        if data:
            self._socket.settimeout(_SEND_S)
            try:
                self._socket.sendall(data)
            except OSError as error:
                raise WebSocketError(f"nothing can be sent: {error.strerror or error}") from error

    def _messages(self) -> list[tuple[bool, bytes]]:
        """Take the frames that are complete; parts of a message are joined."""
        from websockets.frames import Frame, Opcode

        found = []
        for event in self._protocol.events_received():
            if not isinstance(event, Frame):
                continue
            if event.opcode in (Opcode.TEXT, Opcode.BINARY):
                self._is_text = event.opcode is Opcode.TEXT
                if event.fin:
                    found.append((self._is_text, bytes(event.data)))
                else:
                    self._parts = [bytes(event.data)]
            elif event.opcode is Opcode.CONT:
                self._parts.append(bytes(event.data))
                if event.fin:
                    found.append((self._is_text, b"".join(self._parts)))
                    self._parts = []
        return found

    def _why_closed(self) -> str:
        error = self._protocol.parser_exc
        if error is not None and not isinstance(error, EOFError):
            return f"it sent what is not allowed: {error or type(error).__name__}"
        return f"it closed the connection: {self._protocol.close_exc}"


def _connect(url: str, hosts: Mapping[str, str], authority: str, timeout_s: float) -> socket.socket:
    parts = urlsplit(url)
    host, is_tls = parts.hostname or "", parts.scheme == "wss"
    port = parts.port or (443 if is_tls else 80)
    addresses = {name.lower(): address for name, address in hosts.items()}
    connection = socket.create_connection((addresses.get(host.lower(), host), port), timeout_s)
    try:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if not is_tls:
            return connection
        context = ssl.create_default_context(cafile=authority or None)
        return context.wrap_socket(connection, server_hostname=host)
    except BaseException:
        connection.close()
        raise
