"""MQTT brokers: topics by pattern, JSON or bytes, and vehicles that speak VDA 5050."""

from __future__ import annotations

import hashlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.payloads.paced_events import PacedEvents
from amberbox.blackbox.payloads.payload import KINDS, Continuity, is_json, payload_topic
from amberbox.core.clock import NS
from amberbox.core.mqtt import (
    BrokerAddress,
    BrokerLogin,
    broker_address,
    filter_problem,
    login_problems,
    new_client,
    overlap,
)
from amberbox.core.options import option
from amberbox.core.pacing import Backoff
from amberbox.core.safe_text import one_line
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import TopicPattern, TopicSelection
from amberbox.core.types import Topic

SAMPLE = """\
- mqtt:
    broker: localhost
    topics:
      - topic: {name: sensors/+/temperature, max_frequency: 1}
      - topic: {name: gripper/#, type: json}
    vda5050: {manufacturer: ACME, serial: "0007"}
"""
PASSIVE = "subscribes as client '{config.client_name}'; it publishes nothing and keeps no session"

BROKER = Topic("broker", "json")
"""Once a second what arrived; a topic of this name gets a ``_``."""

_POLL_S = 0.1
_EVERY_S = 1.0
_ANSWER_S = 10.0  # until the broker has accepted the connection
_STABLE_S = 10.0  # a connection that lasts as long was no failure
_SHORT_CONNECTIONS = 3
_MOST_TOPICS = 5000
_LONGEST = 500
# reason codes of MQTT 5
_UNSPECIFIED, _UNSUPPORTED_VERSION, _KEEP_ALIVE_TIMEOUT, _TAKEN_OVER = 128, 132, 141, 142
_HEADER_ID = "headerId"


@dataclass(frozen=True)
class MqttTopic(TopicOptions):
    """A topic, or with ``+`` and ``#`` all that match."""

    type: str = option("", "json, msgpack or raw; JSON and other bytes are told apart when absent")
    qos: int | None = option(None, "quality of service 0, 1 or 2; the block's when absent")
    sequence: str = option("", "path of a number that counts messages; its holes are gaps")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        yield from super().check()
        if self.type not in ("", *KINDS):
            yield "type", f"'{self.type}' is none of {', '.join(KINDS)}"
        if self.qos not in (None, 0, 1, 2):
            yield "qos", "must be 0, 1 or 2"


@dataclass(frozen=True)
class Vda5050Options:
    """Vehicles whose topics are INTERFACE/VERSION/MANUFACTURER/SERIAL/TOPIC."""

    interface: str = option("uagv", "first level of the topics")
    version: str = option("+", "major version of VDA 5050, such as v2; any when absent")
    manufacturer: str = option("+", "manufacturer of the vehicles; any when absent")
    serial: str = option("+", "serial number of the vehicle; all when absent")
    topics: Sequence[str] = option(
        ("state", "connection"), "topics to record; also visualization, order, instantActions ..."
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        for key in ("interface", "version", "manufacturer", "serial"):
            text = getattr(self, key)
            if text != "+" and (filter_problem(text) or any(char in text for char in "/+#")):
                yield key, "is one level of a topic; + is any"
        if any(filter_problem(name) or any(char in name for char in "/+#") for name in self.topics):
            yield "topics", "names the last level of topics, such as state"

    def filters(self) -> Sequence[str]:
        """Return the filters to subscribe to."""
        vehicle = f"{self.interface}/{self.version}/{self.manufacturer}/{self.serial}"
        return [f"{vehicle}/{name}" for name in self.topics]


@dataclass(frozen=True)
class MqttOptions:
    """The ``mqtt`` block: one broker."""

    broker: str = option("localhost", "HOST, HOST:PORT, or mqtts://HOST:PORT for TLS")
    client_id: str = option(
        "", "name of the box at the broker, used by no other; from the host's name when absent"
    )
    username: str = option("", "user at the broker")
    password: str = option("", "password of the user", secret=True)
    ca_file: str = option("", "certificate of the authority, PEM; the system's when absent")
    cert_file: str = option("", "own certificate, PEM")
    key_file: str = option("", "key of the own certificate, PEM")
    topics: Sequence[MqttTopic] = option((), "topics to record; all when absent")
    exclude: Sequence[str] = option((), "topics and filters to leave out on arrival")
    qos: int = option(1, "quality of service of the subscriptions: 0, 1 or 2")
    keepalive_s: int = option(5, "a broker that is silent for twice as long is lost", unit="s")
    vda5050: Vda5050Options | None = option(None, "record vehicles that speak VDA 5050")

    @property
    def client_name(self) -> str:
        """Return the client id, without the block's name."""
        return self.client_id or f"amberbox_{socket.gethostname()}"

    def in_folder(self, folder: Path) -> MqttOptions:
        """Return the same with paths seen from a folder."""

        def seen(name: str) -> str:
            return str(folder / Path(name).expanduser()) if name else ""

        return replace(
            self,
            ca_file=seen(self.ca_file),
            cert_file=seen(self.cert_file),
            key_file=seen(self.key_file),
        )

    def login(self, client_id: str) -> BrokerLogin:
        """Return who the client is."""
        files = (self.ca_file, self.cert_file, self.key_file)
        return BrokerLogin(client_id, self.username, self.password, *files)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        keys = ("broker", "ca_file", "cert_file", "key_file")
        yield from login_problems(self.broker, self.login(""), keys)
        if self.password and not self.username:
            yield "username", "is needed beside the password"
        if self.qos not in (0, 1, 2):
            yield "qos", "must be 0, 1 or 2"
        if not 1 <= self.keepalive_s <= 3600:
            yield "keepalive_s", "must be between 1 and 3600"
        names = {"topics": [topic.name for topic in self.topics], "exclude": self.exclude}
        for key, listed in names.items():
            yield from ((key, filter_problem(name)) for name in listed if filter_problem(name))

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield what may surprise."""
        listed = [topic.name for topic in self.topics]
        for one, other in combinations(listed, 2):
            if overlap(one, other) and not (_covers(one, other) or _covers(other, one)):
                what = f"'{one}' and '{other}' overlap: a broker may deliver what fits both twice"
                yield "topics", what

    def wanted(self) -> Sequence[MqttTopic]:
        """Return the options of all filters, those of VDA 5050 included; none means all."""
        vehicles = self.vda5050.filters() if self.vda5050 else ()
        own = (
            MqttTopic(name, type="json", stamp="timestamp", sequence=_HEADER_ID)
            for name in vehicles
        )
        return [*self.topics, *own]

    def subscriptions(self) -> Sequence[tuple[str, int]]:
        """Return filters and their quality of service; none that another one covers."""
        wanted = {topic.name: topic for topic in self.wanted()} or {"#": MqttTopic("#")}
        return [
            (name, self.qos if topic.qos is None else topic.qos)
            for name, topic in wanted.items()
            if not any(other != name and _covers(other, name) for other in wanted)
        ]


Config = MqttOptions


def _pattern(text: str) -> str:
    """Return a filter as our patterns are written; ``a/#`` is what lies below ``a``."""
    levels = {"+": "*", "#": "**"}
    return "/".join(levels.get(level, level) for level in text.split("/"))


def _covers(one: str, other: str) -> bool:
    return TopicPattern(_pattern(one)).covers(_pattern(other))


def beside_recorder(config: MqttOptions) -> MqttOptions:
    """Return the same as another client: a broker ends the connection of the first of a name."""
    return replace(config, client_id=f"{config.client_name}_doctor")


class MqttSource:
    """A subscriber to one broker."""

    lossless = False

    def __init__(self, config: MqttOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the topics configured; the state of the connection is always there."""
        wanted = [replace(topic, name=_pattern(topic.name)) for topic in self.config.wanted()]
        return [*wanted, TopicOptions(BROKER.name)] if wanted else ()

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set; a broker that is missing or lost is connected again."""
        own = f"{self.config.client_name}_{self.name}"
        _Subscriber(self.config, self.config.client_id or own, sink).run(stop)


Source = MqttSource


class _ConnectionState(msgspec.Struct):
    connectionState: str  # noqa: N815 - its name in the message


_CONNECTION = msgspec.json.Decoder(_ConnectionState)


@dataclass
class _Heard:
    """A topic that has been heard. ``peer`` is its broker, or its vehicle."""

    name: str
    kind: str
    peer: str
    is_connection: bool = False
    continuity: Continuity | None = None
    streams: dict[tuple[str, bool], int] = field(default_factory=dict)
    is_latched: bool = False
    is_up: bool = False
    # number of the connection on which it was heard last, and what it said
    connection: int = 0
    digest: bytes = b""


@dataclass
class _Subscriber:
    """The state of a run: the connection, the topics heard, the vehicles."""

    config: MqttOptions
    client_id: str
    sink: Sink
    is_v5: bool = True
    _heard: dict[str, _Heard] = field(default_factory=dict)
    _vehicles: dict[str, str] = field(default_factory=dict)
    _counts: Counter[str] = field(default_factory=Counter)
    _connection: int = 0
    _is_up: bool = False
    _end: str = ""
    _is_late: bool = False
    _last_ns: int = 0
    _due_s: float = 0.0

    def run(self, stop: threading.Event) -> None:
        self._address: BrokerAddress = broker_address(self.config.broker)
        self._events = PacedEvents(self.sink)
        self._broker_stream = self.sink.topic(BROKER)
        wanted = self.config.wanted()
        self._selection = TopicSelection(
            [replace(topic, name=_pattern(topic.name)) for topic in wanted],
            all_topics=not wanted,
            exclude=map(_pattern, self.config.exclude),
        )
        self._vehicle_filters = [
            TopicPattern(_pattern(name))
            for name in (self.config.vda5050.filters() if self.config.vda5050 else ())
        ]
        for name in self._selection.named:
            self._find(name)
        backoff, short = Backoff(most_s=10.0), 0
        while not stop.is_set():
            began_s = time.monotonic()
            end = self._connect_and_listen(stop)
            if end:
                self._events.add_once("mqtt_missing", end, broker=str(self._address))
            if time.monotonic() - began_s > _STABLE_S:
                backoff.succeeded()
                short = 0
            elif not end:
                short += 1
            if short == _SHORT_CONNECTIONS and not stop.is_set():
                text = (
                    f"lost soon after each connection: is another client called {self.client_id}?"
                )
                self._events.add("mqtt_unstable", text)
            until_s = time.monotonic() + backoff.failed()
            while time.monotonic() < until_s and not stop.wait(_POLL_S):
                self._report()
        self._report(at_once=True)
        if self._connection:
            self.sink.link_down(BROKER.name, self.client_id, "stopped")

    def _connect_and_listen(self, stop: threading.Event) -> str:
        """Listen on one connection; return why there was none, empty if there was one."""
        client = new_client(self._address, self.config.login(self.client_id), is_v5=self.is_v5)
        client.on_connect, client.on_disconnect = self._connected, self._disconnected
        client.on_subscribe, client.on_message = self._subscribed, self._received
        self._end, self._is_late = "", False
        try:
            client.connect(
                self._address.host, self._address.port, self.config.keepalive_s,
                properties=self._limits(),
            )  # fmt: skip
        except (OSError, ValueError) as error:  # also of TLS, or of a name that is none
            return f"no connection to {self._address}: {_text(error)}; it is tried again"
        reason = self._listen(client, stop)
        if not self._is_up:
            return f"{self._address} does not accept the box: {reason}; it is tried again"
        self._is_up = False
        now_ns = self.sink.now_ns()
        noticed_ns = now_ns - 2 * self.config.keepalive_s * NS if self._is_late else now_ns
        for heard in self._heard.values():
            self._down(heard, reason, max(self._last_ns, noticed_ns))
        self._vehicles.clear()
        if not stop.is_set():
            self._events.add("mqtt_lost", f"{self._address}: {reason}")
        return ""

    def _limits(self) -> Any:
        """Return what the broker is asked for: no message that would find no room."""
        if not self.is_v5:
            return None
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        limits: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # has no types
        limits.MaximumPacketSize = min(self.sink.longest_message(), (1 << 32) - 1)
        return limits

    def _listen(self, client: Any, stop: threading.Event) -> str:
        """Receive until the connection ends; return why."""
        began_s = time.monotonic()
        reason = "stopped"
        while not stop.is_set():
            try:
                code = client.loop(_POLL_S)
            except Exception as error:  # of bytes that paho cannot read
                self._counts["malformed"] += 1
                reason = f"what it sends is no MQTT: {_text(error)}"
                break
            if self._end or code:
                reason = self._end or f"connection lost: {_text(code.name)}"
                break
            if not self._is_up and time.monotonic() - began_s > _ANSWER_S:
                reason = f"no answer for {_ANSWER_S:g} s"
                break
            self._report()
        with suppress(Exception):  # the connection is given up in any case
            client.disconnect()
        return reason

    # what paho calls

    def _connected(
        self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any
    ) -> None:
        if reason.is_failure:
            self._end = _text(reason)
            if reason.value == _UNSUPPORTED_VERSION and self.is_v5:
                self.is_v5, self._end = False, "it does not speak MQTT 5, so 3.1.1 is used"
            return
        self._is_up = True
        self._connection += 1
        if self._connection == 1:
            self.sink.link_up(BROKER.name, self.client_id)
        version = "5" if self.is_v5 else "3.1.1"
        text = f"connected to {self._address} as {self.client_id}, MQTT {version}"
        self._events.add("mqtt_connected", text)
        self._events.forget()
        client.subscribe([self._subscription(*one) for one in self.config.subscriptions()])
        for heard in self._heard.values():
            if heard.peer == str(self._address):
                self._up(heard)

    def _subscription(self, name: str, qos: int) -> tuple[str, Any]:
        if not self.is_v5:
            return name, qos
        from paho.mqtt.subscribeoptions import SubscribeOptions

        return name, SubscribeOptions(qos, retainAsPublished=True)

    def _subscribed(
        self, _client: Any, _data: Any, _number: Any, reasons: Any, _properties: Any
    ) -> None:
        for (name, _), reason in zip(self.config.subscriptions(), reasons, strict=False):
            if reason.is_failure:
                self._events.add_once("mqtt_refused", f"the broker refuses {name}: {_text(reason)}")

    def _disconnected(
        self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any
    ) -> None:
        self._is_late = reason.value == _KEEP_ALIVE_TIMEOUT
        if reason.value == _TAKEN_OVER:
            self._end = f"another client has the name {self.client_id}: set client_id"
        elif reason.is_failure:
            why = "" if reason.value == _UNSPECIFIED else f": {_text(reason)}"
            self._end = self._end or f"connection lost{why}"
        else:
            self._end = self._end or "the broker has ended the connection"

    def _received(self, _client: Any, _data: Any, message: Any) -> None:
        received_ns = self._last_ns = self.sink.now_ns()
        self._counts["messages"] += 1
        try:
            name = str(message.topic)
        except UnicodeDecodeError:
            self._counts["malformed"] += 1
            return
        heard = self._heard.get(name) or self._find(name)
        if heard is None:
            self._counts["left_out"] += 1
            return
        payload = bytes(message.payload)
        if heard.is_connection:
            self._take_connection(heard, payload)
        elif heard.peer != str(self._address):
            self._take_sign_of_life(heard)
        if self._is_repeated(heard, payload, bool(message.retain)):
            self._counts["repeated"] += 1
            return
        kind = heard.kind
        if not kind:
            kind = "json" if is_json(payload) else "raw"
            self._counts["not_json"] += kind == "raw"
        self._up(heard)
        self.sink.message(self._stream(heard, kind), payload, received_ns)
        if heard.continuity is not None:
            self._count_missing(heard, heard.continuity, payload, received_ns)

    # topics

    def _find(self, name: str) -> _Heard | None:
        """Return a topic that is heard first; None if it is not recorded."""
        if not self._selection.chooses(name):
            return None
        if len(self._heard) >= _MOST_TOPICS and name not in self._selection.named:
            text = f"more than {_MOST_TOPICS} topics; further ones are not recorded"
            self._events.add_once("mqtt_many_topics", text)
            return None
        options = self._selection.options(name)
        given = options if isinstance(options, MqttTopic) else MqttTopic(name)
        shown = f"{name}_" if name == BROKER.name else name
        heard = self._heard[name] = _Heard(shown, given.type, str(self._address))
        if any(one.fits(name) for one in self._vehicle_filters):
            manufacturer, serial, last = name.split("/")[-3:]
            heard.is_connection = last == "connection"
            if not heard.is_connection:
                heard.peer = one_line(f"{manufacturer}/{serial}")
        if given.sequence and not heard.is_connection:
            heard.continuity = Continuity(given.sequence, "", 0.0)
        return heard

    def _stream(self, heard: _Heard, kind: str) -> int:
        key = (kind, heard.is_latched)
        if key not in heard.streams:
            topic = payload_topic(heard.name, kind, heard.is_latched)
            heard.streams[key] = self.sink.topic(topic)
        return heard.streams[key]

    def _is_repeated(self, heard: _Heard, payload: bytes, is_retained: bool) -> bool:
        """Return whether this is a retained message that is recorded already.

        Each new subscription gets it, as the first message of its topic.
        """
        is_first, heard.connection = heard.connection != self._connection, self._connection
        heard.is_latched = heard.is_latched or is_retained
        digest, before = _digest(payload), heard.digest
        heard.digest = digest
        if not (is_first and is_retained):
            return False
        if not before:
            last = self.sink.last_latched(heard.name)
            before = b"" if last is None else _digest(last)
        return before == digest

    def _count_missing(
        self, heard: _Heard, continuity: Continuity, payload: bytes, received_ns: int
    ) -> None:
        missing = continuity.missing(payload, heard.kind or "json")
        since_ns, continuity.last_received_ns = continuity.last_received_ns, received_ns
        if missing:
            self._counts["lost"] += missing
            reason = f"lost before the box: holes in {continuity.path}"
            self.sink.lost(heard.name, heard.peer, since_ns, received_ns, missing, reason)

    def _up(self, heard: _Heard) -> None:
        if not heard.is_up and (heard.peer == str(self._address) or self._is_online(heard)):
            heard.is_up = True
            self.sink.link_up(heard.name, heard.peer)

    def _down(self, heard: _Heard, reason: str, since_ns: int | None = None) -> None:
        if heard.is_up:
            heard.is_up = False
            self.sink.link_down(heard.name, heard.peer, reason, since_ns)

    # vehicles

    def _is_online(self, heard: _Heard) -> bool:
        return self._vehicles.get(heard.peer, "ONLINE") == "ONLINE"

    def _take_sign_of_life(self, heard: _Heard) -> None:
        if len(self._vehicles) < _MOST_TOPICS:
            self._vehicles.setdefault(heard.peer, "ONLINE")

    def _take_connection(self, heard: _Heard, payload: bytes) -> None:
        """Take what a vehicle, or the broker as its last will, says of its connection."""
        try:
            state = _CONNECTION.decode(payload).connectionState
        except (msgspec.MsgspecError, RecursionError, ValueError):
            self._counts["malformed"] += 1
            return
        vehicle = one_line("/".join(heard.name.split("/")[-3:-1]))
        state = one_line(state[:_LONGEST])
        before = self._vehicles.get(vehicle)
        if before is None and len(self._vehicles) >= _MOST_TOPICS:
            return
        if state == before:
            return
        self._vehicles[vehicle] = state
        self._events.add(
            "vda5050_connection", f"{vehicle} is {state}", vehicle=vehicle, state=state
        )
        for other in self._heard.values():
            if other.peer == vehicle and state == "ONLINE":
                self._up(other)
            elif other.peer == vehicle:
                self._down(other, f"the vehicle is {state}")

    # reports

    def _report(self, *, at_once: bool = False) -> None:
        """Put a row of the topic ``broker``, of the time since the last one, once connected."""
        if not self._connection or (time.monotonic() < self._due_s and not at_once):
            return
        self._due_s = time.monotonic() + _EVERY_S
        counts, self._counts = self._counts, Counter()
        names = ("messages", "left_out", "repeated", "not_json", "malformed", "lost")
        row = {"connected": self._is_up, **{name: counts[name] for name in names}}
        self.sink.message(self._broker_stream, msgspec.json.encode(row), self.sink.now_ns())


def _digest(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=16).digest()


def _text(error: object) -> str:
    return one_line(str(error))[:_LONGEST] or type(error).__name__
