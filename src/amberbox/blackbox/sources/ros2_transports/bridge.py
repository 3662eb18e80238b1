"""ROS 2 by way of a Foxglove bridge on the robot: definitions travel with the topics.

The protocol is that of ``foxglove_bridge`` and of all servers made with the Foxglove SDK:
https://github.com/foxglove/ws-protocol, subprotocols ``foxglove.sdk.v1`` and
``foxglove.websocket.v1``.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from amberbox.blackbox.sources.ros2_transports.names import MOST_CHARACTERS
from amberbox.blackbox.sources.ros2_transports.options import BRIDGE_URL, Ros2Options
from amberbox.blackbox.sources.ros2_transports.recorded_topics import (
    MOST_TOPICS,
    OfferedTopic,
    RecordedTopics,
)
from amberbox.blackbox.sources.ros2_transports.websocket import WebSocket, WebSocketError
from amberbox.core.errors import AmberboxError
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph
from amberbox.core.source import Sink
from amberbox.core.types import Schema, Topic

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
PARAMETERS = "parameters"  # the item of parameters; no topic of ROS can be called so
_DATA = 1  # first byte of a binary frame with a message
_HEAD = struct.Struct("<BIQ")  # that, the subscription, the server's time in ns
_HIGHEST_ID = 0xFFFF_FFFF
_BACKOFF_S = (0.5, 15.0)
_POLL_S = 0.2
_CONNECT_S = 5.0  # to a bridge whose nodes are followed
_LONGEST_TEXT = 64_000_000  # bytes of a text frame when only the graph is read
_MOST_STATUSES = 100  # events of status messages of one connection
# a bridge may announce a channel before it knows it itself, and refuses what comes at once
_REFUSED = re.compile(r"\bchannel\D{0,20}(\d{1,10})", re.IGNORECASE)
_MOST_TRIES, _AGAIN_AFTER_S = 10, 0.1  # the pause doubles
_MOST_SCHEMA_CHARACTERS = 2 << 20  # of a definition; base64 included
_MOST_PARAMETERS = 20_000
_TEXT_SCHEMAS = {"ros2msg", "ros1msg", "ros2idl", "omgidl", "jsonschema"}
# how the schema of messages in an encoding is written where the server does not say it
_SCHEMA_ENCODINGS = {
    "cdr": "ros2msg", "ros1": "ros1msg", "json": "jsonschema", "protobuf": "protobuf",
    "flatbuffer": "flatbuffer",
}  # fmt: skip
_LEVELS = ("info", "warning", "error")
_STOPPED = "the recorder stopped listening"
_UNADVERTISED = "the bridge does not offer it any more"


class _Frame(msgspec.Struct):
    op: str


class _ServerInfo(msgspec.Struct):
    name: str = ""
    capabilities: list[str] = []


class _Status(msgspec.Struct):
    message: str
    level: int = 0


class _Channel(msgspec.Struct):
    id: int
    topic: str
    encoding: str
    schema_name: str = msgspec.field(name="schemaName", default="")
    text: str = msgspec.field(name="schema", default="")
    schema_encoding: str | None = msgspec.field(name="schemaEncoding", default=None)


class _Advertise(msgspec.Struct):
    channels: list[_Channel]


class _Unadvertise(msgspec.Struct):
    ids: list[int] = msgspec.field(name="channelIds")


class _Parameter(msgspec.Struct):
    name: str
    value: Any = None
    type: str | None = None


class _ParameterValues(msgspec.Struct):
    parameters: list[_Parameter]


class _Service(msgspec.Struct):
    name: str
    type: str = ""


class _Services(msgspec.Struct):
    services: list[_Service]


class _Ends(msgspec.Struct):
    """A topic or service, and who is at one end of it."""

    name: str
    publishers: list[str] = msgspec.field(name="publisherIds", default=[])
    subscribers: list[str] = msgspec.field(name="subscriberIds", default=[])
    providers: list[str] = msgspec.field(name="providerIds", default=[])


class _Graph(msgspec.Struct):
    published: list[_Ends] = msgspec.field(name="publishedTopics", default=[])
    subscribed: list[_Ends] = msgspec.field(name="subscribedTopics", default=[])
    served: list[_Ends] = msgspec.field(name="advertisedServices", default=[])
    gone_topics: list[str] = msgspec.field(name="removedTopics", default=[])
    gone_services: list[str] = msgspec.field(name="removedServices", default=[])


_OPERATIONS: Mapping[str, Any] = {
    "serverInfo": _ServerInfo,
    "status": _Status,
    "advertise": _Advertise,
    "unadvertise": _Unadvertise,
    "parameterValues": _ParameterValues,
    "advertiseServices": _Services,
    "connectionGraphUpdate": _Graph,
}


def decode_text(text: bytes) -> Any:
    """Return what a text frame says; None for an operation that is not known.

    Raises WebSocketError for what is not of the protocol.
    """
    try:
        kind = _OPERATIONS.get(msgspec.json.decode(text, type=_Frame).op)
        return None if kind is None else msgspec.json.decode(text, type=kind)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise WebSocketError(f"a text frame is not of the protocol: {error}") from error


def _is_sound(channel: _Channel) -> bool:
    """Return whether a channel can be subscribed to, and its texts can stand in a record."""
    texts = (channel.schema_name, channel.encoding, channel.schema_encoding or "")
    return (
        0 <= channel.id <= _HIGHEST_ID
        and max(map(len, texts)) <= MOST_CHARACTERS
        and len(channel.text) <= _MOST_SCHEMA_CHARACTERS
    )


def offered_topic(channel: _Channel) -> OfferedTopic:
    """Return the topic of a channel, with its definition as it travelled."""
    encoding = channel.schema_encoding or _SCHEMA_ENCODINGS.get(channel.encoding, "")
    name = channel.topic if channel.topic.startswith("/") else f"/{channel.topic}"
    data = channel.text.encode()
    if encoding and encoding not in _TEXT_SCHEMAS:  # binary, in base64
        try:
            data = base64.b64decode(data, validate=True)
        except (binascii.Error, ValueError):
            encoding, data = "", b""
    schema: Schema | None = Schema(channel.schema_name, encoding if data else "", data)
    if not data and channel.encoding == "cdr":
        schema = None  # the bridge has no definition of its own: those of folders may help
    return OfferedTopic(name, channel.schema_name, encoding=channel.encoding, schema=schema)


def _open(options: Ros2Options, longest_bytes: int, timeout_s: float) -> WebSocket:
    return WebSocket.open(
        options.url or BRIDGE_URL,
        SUBPROTOCOLS,
        hosts=options.hosts,
        authority=options.authority,
        longest_bytes=longest_bytes,
        timeout_s=timeout_s,
        dead_after_s=options.dead_after_s,
    )


class Transport:
    """Listens to a bridge; connects again when it is gone."""

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set."""
        limit_mb = self._options.max_message_mb
        longest = sink.longest_message() if limit_mb is None else round(limit_mb * 1e6)
        topics = RecordedTopics(self._options, sink)
        url = self._options.url or BRIDGE_URL
        parameters = ParameterLog(sink)
        pause_s, since_ns = _BACKOFF_S[0], None
        while not stop.is_set():
            listener = BridgeListener(url, self._options, sink, topics, parameters, since_ns)
            try:
                with _open(self._options, longest + _HEAD.size, timeout_s=5.0) as socket:
                    listener.listen(socket, stop)
            except WebSocketError as error:
                listener.close(f"the bridge is gone: {error.what}")
                topics.report_once(
                    ("bridge",), "bridge_unreachable", f"{url}: {error.what}; it is tried again",
                    url=url,
                )  # fmt: skip
            else:
                listener.close(_STOPPED)
            if listener.was_greeted:
                pause_s, since_ns = _BACKOFF_S[0], sink.now_ns()
            stop.wait(pause_s)
            pause_s = min(2 * pause_s, _BACKOFF_S[1])

    def read_graph(self, wait_s: float) -> RobotGraph:
        """Return what the bridge says until it has said all that it can."""
        end_s = time.monotonic() + wait_s
        reading = GraphReading()
        with _open(self._options, _LONGEST_TEXT, wait_s) as socket:
            while (left_s := end_s - time.monotonic()) > 0 and reading.missing:
                for is_text, data in socket.receive(min(left_s, _POLL_S)):
                    if is_text:
                        reading.take(decode_text(data), socket.send_text)
        if "greeting" in reading.missing:
            what = f"what answers at {self._options.url or BRIDGE_URL} says nothing"
            raise AmberboxError(what, "is it a Foxglove bridge?")
        return reading.graph()

    def follow_nodes(self, tell: Callable[[Collection[str]], None], stop: threading.Event) -> None:
        """Tell which nodes the bridge says are at the ends of topics and services."""
        following = GraphFollowing()
        with _open(self._options, _LONGEST_TEXT, _CONNECT_S) as socket:
            while not stop.is_set():
                for is_text, data in socket.receive(_POLL_S):
                    if is_text:
                        following.take(decode_text(data), socket.send_text)
                if following.is_known:
                    tell(following.nodes())


@dataclass
class BridgeListener:
    """One connection to a bridge: its channels, subscriptions and parameters."""

    url: str
    options: Ros2Options
    sink: Sink
    topics: RecordedTopics
    parameters: ParameterLog
    # since when topics may have been offered unseen: since the connection before, or ever
    since_ns: int | None = None
    was_greeted: bool = False
    # by channel, which is also the number of the subscription to it
    _channels: dict[int, OfferedTopic] = field(default_factory=dict)
    _streams: dict[int, int] = field(default_factory=dict)
    # messages may be overtaken by the end of their channel
    _withdrawn: dict[int, OfferedTopic] = field(default_factory=dict)
    _up: dict[str, int] = field(default_factory=dict)  # topic to how many channels carry it
    _knows_all: bool = False  # whether all topics that were there before are known
    _tries: dict[int, int] = field(default_factory=dict)  # by channel that was refused
    _refused: set[int] = field(default_factory=set)
    _again_s: float = 0.0
    _statuses: int = 0
    _follows_parameters: bool = False
    _followed: set[str] = field(default_factory=set)

    def listen(self, socket: WebSocket, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; raises WebSocketError when the connection ends."""
        while not stop.is_set():
            frames = socket.receive(_POLL_S)
            received_ns = self.sink.now_ns()
            self._knows_all |= self.was_greeted and not frames
            for is_text, data in frames:
                if is_text:
                    self._take_text(data, socket.send_text)
                else:
                    self._take_binary(data, received_ns)
            self._subscribe_again(socket.send_text)
            if self._knows_all:
                self.since_ns = received_ns
                self.topics.report_missing()

    def close(self, reason: str) -> None:
        """Report that nothing arrives any more."""
        for topic in self._up:
            self.sink.link_down(topic, self.url, reason)
        self._up.clear()

    def _take_binary(self, data: bytes, received_ns: int) -> None:
        if len(data) < _HEAD.size:
            if data[:1] != b"\x02":  # the server's clock; it is not used
                self._malformed("a binary frame is too short")
            return
        kind, number, _ = _HEAD.unpack_from(data)
        if kind != _DATA:
            return
        stream = self._streams.get(number)
        if stream is None:
            offer = self._channels.get(number) or self._withdrawn.get(number)
            if offer is None:
                self._malformed(f"a message of subscription {number}, which there is not")
                return
            stream = self._streams[number] = self.topics.stream(offer, data[_HEAD.size :])
        self._knows_all = True
        if stream >= 0:
            self.sink.message(stream, data[_HEAD.size :], received_ns)

    def _malformed(self, what: str) -> None:
        text = f"{self.url}: {what}; it is left out"
        self.topics.report_once(("malformed", what[:20]), "bridge_malformed", text, url=self.url)

    def _take_text(self, text: bytes, send: Callable[[Any], None]) -> None:
        said = decode_text(text)
        if isinstance(said, _ServerInfo):
            self._greet(said, send)
        elif isinstance(said, _Advertise):
            self._add(said.channels, send)
        elif isinstance(said, _Unadvertise):
            self._remove(said.ids, send)
        elif isinstance(said, _Status):
            self._report_status(said)
        elif isinstance(said, _ParameterValues) and self.options.parameters:
            self.parameters.take(said.parameters, self.sink.now_ns())
            self._follow(said.parameters, send)

    def _greet(self, info: _ServerInfo, send: Callable[[Any], None]) -> None:
        self.was_greeted = True
        for key in ("bridge", "malformed", "status"):
            self.topics.clear(key)
        text = f"connected to the bridge {info.name[:100]!r} at {self.url}"
        self.topics.report("bridge_connected", text, url=self.url)
        if self.options.parameters and "parameters" in info.capabilities:
            self._follows_parameters = "parametersSubscribe" in info.capabilities
            send({"op": "getParameters", "parameterNames": [], "id": "amberbox"})

    def _follow(self, parameters: Sequence[_Parameter], send: Callable[[Any], None]) -> None:
        """Have the bridge report changes of parameters."""
        new = sorted({parameter.name for parameter in parameters} - self._followed)
        new = new[: _MOST_PARAMETERS - len(self._followed)]
        self._followed.update(new)
        if new and self._follows_parameters:
            send({"op": "subscribeParameterUpdates", "parameterNames": new})

    def _add(self, channels: Sequence[_Channel], send: Callable[[Any], None]) -> None:
        wanted = []
        for channel in channels:
            offer = offered_topic(channel)
            if not self.topics.chooses(offer.name, offer.type_name):
                continue
            if len(self._channels) >= MOST_TOPICS or not _is_sound(channel):
                self._malformed(f"channel {channel.id} cannot be subscribed to")
                continue
            if channel.id in self._channels:
                if self._channels[channel.id] == offer:
                    continue
                self._remove([channel.id], send)
            self._channels[channel.id] = offer
            self._streams.pop(channel.id, None)
            wanted.append(channel.id)
            self._up[offer.name] = self._up.get(offer.name, 0) + 1
            if self._up[offer.name] == 1:
                self.sink.link_up(offer.name, self.url, self.since_ns)
        self._subscribe(wanted, send)

    def _subscribe(self, numbers: Sequence[int], send: Callable[[Any], None]) -> None:
        if numbers:
            wanted = [{"id": number, "channelId": number} for number in numbers]
            send({"op": "subscribe", "subscriptions": wanted})

    def _take_refusal(self, status: _Status) -> None:
        """Note that a subscription of which nothing has come may have been refused."""
        named = _REFUSED.search(status.message) if status.level > 0 else None
        number = int(named[1]) if named else -1
        tries = self._tries.get(number, 0)
        if number in self._channels and number not in self._streams and tries < _MOST_TRIES:
            self._tries[number] = tries + 1
            self._refused.add(number)
            self._again_s = time.monotonic() + _AGAIN_AFTER_S * 2**tries

    def _subscribe_again(self, send: Callable[[Any], None]) -> None:
        if self._refused and time.monotonic() >= self._again_s:
            self._subscribe(sorted(self._refused & self._channels.keys()), send)
            self._refused.clear()

    def _remove(self, ids: Sequence[int], send: Callable[[Any], None]) -> None:
        gone = [number for number in ids if number in self._channels]
        if len(self._withdrawn) + len(gone) > MOST_TOPICS:
            self._withdrawn.clear()
            self._streams = {n: self._streams[n] for n in self._streams.keys() & self._channels}
        for number in gone:
            self._tries.pop(number, None)
            self._withdrawn[number] = self._channels.pop(number)
            name = self._withdrawn[number].name
            self._up[name] -= 1
            if not self._up[name]:
                del self._up[name]
                self.sink.link_down(name, self.url, _UNADVERTISED)
        if gone:
            send({"op": "unsubscribe", "subscriptionIds": gone})

    def _report_status(self, status: _Status) -> None:
        self._take_refusal(status)
        self._statuses += 1
        level = _LEVELS[min(max(status.level, 0), 2)]
        if self._statuses <= _MOST_STATUSES:
            key = ("status", level, status.message[:200])
            text = f"{self.url}: {level}: {status.message}"
            self.topics.report_once(key, "bridge_status", text, url=self.url, level=level)


@dataclass
class ParameterLog:
    """Records parameters whose value is new or has changed, one message each."""

    sink: Sink
    _values: dict[str, str] = field(default_factory=dict)
    _stream: int | None = None

    def take(self, parameters: Sequence[_Parameter], received_ns: int) -> None:
        """Record what changed."""
        for parameter in parameters:
            try:
                text = json.dumps(parameter.value, sort_keys=True)
            except RecursionError:  # nested deeper than anybody wrote it
                continue
            if self._values.get(parameter.name) == text:
                continue
            if parameter.name not in self._values and len(self._values) >= _MOST_PARAMETERS:
                continue
            self._values[parameter.name] = text
            if self._stream is None:
                self._stream = self.sink.topic(Topic(PARAMETERS, "json"))
            message = msgspec.json.encode(_parameter_row(parameter, text))
            self.sink.message(self._stream, message, received_ns)


def _parameter_row(parameter: _Parameter, text: str) -> dict[str, Any]:
    """Return one parameter as a row: its value as text, and as a number where it is one."""
    value, kind = parameter.value, parameter.type
    if kind is None:
        kinds = {bool: "bool", int: "integer", float: "double", str: "string", list: "array"}
        kind = "not set" if value is None else kinds.get(type(value), "structure")
    row = {"name": parameter.name, "type": kind, "value": value if kind == "string" else text}
    if isinstance(value, int | float):
        row["number"] = float(value)
    return row


@dataclass
class GraphReading:
    """Collects what a bridge says of the robot; nodes are known where it sends the graph only."""

    topics: dict[str, GraphTopic] = field(default_factory=dict)
    services: dict[str, GraphService] = field(default_factory=dict)
    # what the bridge has not said yet
    missing: set[str] = field(default_factory=lambda: {"greeting", "topics"})

    def take(self, said: Any, send: Callable[[Any], None]) -> None:
        """Take one text frame."""
        if isinstance(said, _ServerInfo):
            self.missing.discard("greeting")
            if "connectionGraph" in said.capabilities:
                self.missing.add("graph")
                send({"op": "subscribeConnectionGraph"})
        elif isinstance(said, _Advertise):
            self.missing.discard("topics")
            for channel in said.channels[:MOST_TOPICS]:
                offer = offered_topic(channel)
                self.topics[offer.name] = replace(self._topic(offer.name), type=offer.type_name)
        elif isinstance(said, _Services):
            for service in said.services[:MOST_TOPICS]:
                known = self._service(service.name)
                self.services[service.name] = replace(known, type=service.type)
        elif isinstance(said, _Graph):
            self.missing.discard("graph")
            self._add_ends(said)

    def _topic(self, name: str) -> GraphTopic:
        return self.topics.get(name, GraphTopic(name))

    def _service(self, name: str) -> GraphService:
        return self.services.get(name, GraphService(name))

    def _add_ends(self, graph: _Graph) -> None:
        for end in (*graph.published, *graph.subscribed)[:MOST_TOPICS]:
            known = self._topic(end.name)
            self.topics[end.name] = replace(
                known,
                publishers=tuple(sorted({*known.publishers, *end.publishers} - {""})),
                subscribers=tuple(sorted({*known.subscribers, *end.subscribers} - {""})),
            )
        for end in graph.served[:MOST_TOPICS]:
            node = next(iter(end.providers), "")
            self.services[end.name] = replace(self._service(end.name), node=node)

    def graph(self) -> RobotGraph:
        """Return what was said so far."""
        nodes = {n for topic in self.topics.values() for n in topic.publishers + topic.subscribers}
        nodes |= {service.node for service in self.services.values() if service.node}
        return RobotGraph(
            tuple(sorted(nodes)),
            tuple(self.topics[name] for name in sorted(self.topics) if name),
            tuple(self.services[name] for name in sorted(self.services) if name),
        )


class GraphFollowing:
    """Keeps which nodes are at the ends of topics and services, by the changes a bridge sends."""

    def __init__(self) -> None:
        self.is_known = False
        self._ends: dict[tuple[str, str], list[str]] = {}

    def take(self, said: Any, send: Callable[[Any], None]) -> None:
        """Take one text frame. Raises AmberboxError if the bridge knows no nodes."""
        if isinstance(said, _ServerInfo):
            if "connectionGraph" not in said.capabilities:
                raise AmberboxError("the bridge does not say which nodes there are")
            send({"op": "subscribeConnectionGraph"})
        elif isinstance(said, _Graph):
            if self.is_known and (said.gone_topics or said.gone_services):
                # it does not say which end of a topic is gone: ask for all that is there
                self.is_known = False
                self._ends.clear()
                send({"op": "unsubscribeConnectionGraph"})
                send({"op": "subscribeConnectionGraph"})
                return
            self.is_known = True
            self._ends |= {("published", end.name): end.publishers for end in said.published}
            self._ends |= {("subscribed", end.name): end.subscribers for end in said.subscribed}
            self._ends |= {("served", end.name): end.providers for end in said.served}
            if len(self._ends) > 3 * MOST_TOPICS:
                raise AmberboxError(f"the bridge has more than {MOST_TOPICS} topics")

    def nodes(self) -> set[str]:
        """Return the nodes that are there now."""
        return {node for nodes in self._ends.values() for node in nodes if node}
