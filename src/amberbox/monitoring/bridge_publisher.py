"""Publishes statuses through a Foxglove bridge of the robot, which passes them on to ROS.

The bridge has to allow it (capability ``clientPublish``). It names the encodings that it takes: a
bridge to ROS 1 takes its messages, one to ROS 2 CDR.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import msgspec

from amberbox.blackbox.sources.ros1.message_type import message_type
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.monitoring.background_sender import Message

TYPE = "diagnostic_msgs/DiagnosticArray"
SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_WAIT_S = 5.0
_DEAD_AFTER_MS = 10_000
_MOST_BYTES = 4 << 20  # of a frame of the bridge: it advertises all its topics in one
_MOST_FRAMES = 1000  # read at once; we subscribe to nothing
_CHANNEL = 1
_MESSAGE = struct.Struct("<BI")
_MESSAGE_DATA = 1


class BridgeEncoding(NamedTuple):
    """How messages are passed to a bridge."""

    name: str
    schema_name: str
    schema_encoding: str
    schema: str
    encode: Callable[[Message], bytes]


class BridgePublisher:
    """One connection to a bridge, on which one topic is advertised."""

    def __init__(self, url: str, topic: str, stopped: Callable[[], bool]) -> None:
        self._url = url
        try:
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ImportError:
            what = "the package websockets is not installed"
            raise UsageError(what, "pip install amberbox[link]") from None
        self._errors = (OSError, WebSocketException)
        protocols: Any = SUBPROTOCOLS
        try:
            self._socket = connect(
                url, subprotocols=protocols, open_timeout=_WAIT_S, close_timeout=0.3,
                max_size=_MOST_BYTES, compression=None,
            )  # fmt: skip
        except self._errors as error:
            raise AmberboxError(f"no Foxglove bridge answers: {error}") from error
        options = self._socket.socket
        options.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        options.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_AFTER_MS)
        try:
            self._encoding = self._agreed(self._server_info(stopped))
            self._advertise(topic)
        except BaseException:
            self.close()
            raise

    def _server_info(self, stopped: Callable[[], bool]) -> Mapping[str, Any]:
        end_s = time.monotonic() + _WAIT_S
        while not stopped() and time.monotonic() < end_s:
            frame = self._received(0.1)
            if isinstance(frame, str):
                try:
                    values = msgspec.json.decode(frame)
                except msgspec.DecodeError:
                    break
                if isinstance(values, dict) and values.get("op") == "serverInfo":
                    return values
        raise AmberboxError("the peer is no Foxglove bridge: it does not introduce itself")

    def _agreed(self, info: Mapping[str, Any]) -> BridgeEncoding:
        """Return the encoding that the bridge takes; raises AmberboxError if it takes none."""
        capabilities, taken = info.get("capabilities"), info.get("supportedEncodings")
        if not isinstance(capabilities, list) or "clientPublish" not in capabilities:
            raise AmberboxError(
                "the bridge does not let its clients publish",
                "start foxglove_bridge with clientPublish among its capabilities",
            )
        offered = taken if isinstance(taken, list) else []
        for name, make in _ENCODINGS.items():
            if name in offered:
                return make()
        names = ", ".join(str(name)[:40] for name in offered[:10]) or "none"
        raise AmberboxError(f"the bridge takes none of {', '.join(_ENCODINGS)} (but {names})")

    def _advertise(self, topic: str) -> None:
        channel = {
            "id": _CHANNEL,
            "topic": topic,
            "encoding": self._encoding.name,
            "schemaName": self._encoding.schema_name,
            "schemaEncoding": self._encoding.schema_encoding,
            "schema": self._encoding.schema,
        }
        self._sent({"op": "advertise", "channels": [channel]})

    def send(self, message: Message) -> None:
        """Send an array; raises AmberboxError when the connection is lost."""
        self._sent(_MESSAGE.pack(_MESSAGE_DATA, _CHANNEL) + self._encoding.encode(message))

    def _sent(self, frame: bytes | Mapping[str, Any]) -> None:
        data = frame if isinstance(frame, bytes) else msgspec.json.encode(frame).decode()
        try:
            self._socket.send(data)
        except self._errors as error:
            raise AmberboxError(f"the bridge has closed the connection: {error}") from error

    def check(self) -> None:
        """Read what the bridge sends, and pass it over; raises AmberboxError when it is gone."""
        for _ in range(_MOST_FRAMES):
            if self._received(0) is None:
                return

    def _received(self, wait_s: float) -> str | bytes | None:
        try:
            return self._socket.recv(timeout=wait_s)
        except TimeoutError:
            return None
        except self._errors as error:
            raise AmberboxError(f"the bridge has closed the connection: {error}") from error

    def dropped(self) -> int:
        """Return 0: what a bridge drops, it does not tell."""
        return 0

    def close(self) -> None:
        """End the connection."""
        self._socket.close()


def _ros1() -> BridgeEncoding:
    kind = message_type(TYPE)
    return BridgeEncoding("ros1", TYPE, "ros1msg", kind.definition, kind.encode)


def _cdr() -> BridgeEncoding:
    from rosbags.typesys import Stores, get_typestore

    name = TYPE.replace("/", "/msg/")
    ros2 = get_typestore(Stores.ROS2_HUMBLE)
    text = ros2.generate_msgdef(name, ros_version=2)[0]
    encode = message_type(TYPE).encode
    to_cdr = partial(ros2.ros1_to_cdr, typename=name)
    return BridgeEncoding("cdr", name, "ros2msg", text, lambda m: bytes(to_cdr(encode(m))))


def _json() -> BridgeEncoding:
    return BridgeEncoding("json", TYPE, "jsonschema", "", msgspec.json.encode)


_ENCODINGS: Mapping[str, Callable[[], BridgeEncoding]] = {"ros1": _ros1, "cdr": _cdr, "json": _json}
