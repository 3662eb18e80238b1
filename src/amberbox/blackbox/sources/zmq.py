"""ZeroMQ publishers: JSON or msgpack, topic and payload in two frames or in one."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from amberbox.blackbox.payloads.payload import Continuity, detect_encoding
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import TopicSelection, pattern_problem
from amberbox.core.types import Topic

SAMPLE = """\
- zmq:
    endpoint: tcp://localhost:5555
    topics:
      - topic: {name: events, type: json, max_frequency: 30}
      - topic: {name: pose, url: tcp://192.168.1.7, port: 5556, type: msgpack}
"""
PASSIVE = "SUB sockets only: nothing is sent, no other subscriber misses a message"
UNNAMED = "message"  # topic of messages in one frame that name none

MOST_REMEMBERED = 1000  # topics of a publisher that are restored at the start of the next run

_PUBLISHER_MISSING = "publisher not connected yet"
_RUN_START_NS = 1
# wait before a new connection, as ZeroMQ closes one for good at bytes it cannot parse
_GIVEN_UP_S = (0.5, 30.0)
_POLL_MS = 100
_AT_ONCE = 500  # messages of one publisher before the others have their turn
_KEY_LENGTH = 40  # characters of a CURVE key in Z85
_NAME_AND_JSON = re.compile(rb"([^\s{\[\"]+)(?:\0|[ \t][ \t\0]*+)([{\[].*)", re.DOTALL)


@dataclass(frozen=True)
class ZmqTopic(TopicOptions):
    """A topic; ``name`` is the prefix of messages, as ZeroMQ subscribes by prefix, or a pattern.

    What comes before the first ``*`` of a pattern is the prefix; messages of other topics that
    begin with it arrive, and are left out here.
    """

    type: str = option("", "json or msgpack; told apart by the first byte when absent")
    endpoint: str = option("", "its publisher, tcp://HOST:PORT; the block's when absent")
    url: str = option("", "its publisher's host, tcp://HOST, used with 'port'")
    port: int | None = option(None, "its publisher's port")
    sequence: str = option("", "path of a number that counts messages; its holes are gaps")
    rate_hz: float | None = option(
        None, "rate of the stamps named by 'stamp'; their holes are gaps", unit="Hz"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        yield from super().check()
        if self.rate_hz is not None and not 0 < self.rate_hz < float("inf"):
            yield "rate_hz", "must be above 0"
        elif self.rate_hz is not None and not self.stamp:
            yield "rate_hz", "goes together with 'stamp', the path of the time stamp"
        if self.rate_hz is not None and self.sequence:
            yield "rate_hz", "is not needed beside 'sequence'; remove one of them"

    def continuity(self) -> Continuity | None:
        """Return the check for holes in the topic's messages; None if none is configured."""
        if not self.sequence and self.rate_hz is None:
            return None
        return Continuity(self.sequence, self.stamp or "", self.rate_hz or 0.0)


@dataclass(frozen=True)
class ZmqOptions:
    """The ``zmq`` block."""

    endpoint: str | Sequence[str] = option(
        "", "publisher, tcp://HOST:PORT or ipc://PATH, or several"
    )
    url: str = option(
        "", "publisher's host, tcp://HOST, used with 'port'", aliases=("publisher_url",)
    )
    port: int | None = option(None, "publisher's port")
    topics: Sequence[ZmqTopic] = option((), "topics to record; all when absent")
    exclude: Sequence[str] = option((), "names and patterns of topics to leave out on arrival")
    max_message_mb: float | None = option(
        None, "longer messages end the connection; store.queue when absent", unit="MB"
    )
    curve_server_key: str = option("", "publisher's public CURVE key, 40 characters")
    curve_public_key: str = option("", "own public CURVE key; made anew when absent")
    curve_secret_key: str = option("", "own secret CURVE key", secret=True)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not self.topics and not self._own_endpoints():
            yield "endpoint", "names no publisher; write tcp://HOST:PORT"
        for endpoint in self._own_endpoints():
            yield from (("endpoint", what) for what in _wrong_with(endpoint))
        for topic in self.topics:
            yield from (("topics", f"'{topic.name}': {what}") for what in self._wrong_topic(topic))
        wrong = filter(None, map(pattern_problem, self.exclude))
        yield from (("exclude", what) for what in wrong)
        for key in ("curve_server_key", "curve_public_key", "curve_secret_key"):
            if len(getattr(self, key)) not in (0, _KEY_LENGTH):
                yield key, f"a CURVE key has {_KEY_LENGTH} characters (Z85)"
        if bool(self.curve_public_key) != bool(self.curve_secret_key):
            yield "curve_public_key", "goes together with curve_secret_key"
        if self.curve_secret_key and not self.curve_server_key:
            yield "curve_server_key", "is needed to use CURVE"
        if self.max_message_mb is not None and self.max_message_mb <= 0:
            yield "max_message_mb", "must be above 0"

    def _wrong_topic(self, topic: ZmqTopic) -> Iterator[str]:
        if topic.type not in ("", "json", "msgpack"):
            yield f"type '{topic.type}' is neither json nor msgpack"
        if pattern_problem(topic.name):
            yield "** stands for whole levels, as in cam/**/image"
        endpoints = self._endpoints_of(topic)
        if not endpoints:
            yield "names no publisher; write endpoint: tcp://HOST:PORT"
        for endpoint in endpoints:
            yield from _wrong_with(endpoint)

    def publishers(self) -> Mapping[str, Sequence[ZmqTopic]]:
        """Return topics by publisher; an empty list means every topic."""
        found: dict[str, list[ZmqTopic]] = {}
        for topic in self.topics:
            for endpoint in self._endpoints_of(topic):
                found.setdefault(endpoint, []).append(topic)
        return found if self.topics else {endpoint: [] for endpoint in self._own_endpoints()}

    def selection(self, topics: Sequence[ZmqTopic]) -> TopicSelection:
        """Return what chooses among the topics of a publisher."""
        return TopicSelection(topics, all_topics=not topics, exclude=self.exclude)

    def _own_endpoints(self) -> Sequence[str]:
        listed = [self.endpoint] if isinstance(self.endpoint, str) else list(self.endpoint)
        return [e for e in (*listed, _join(self.url, self.port)) if e]

    def _endpoints_of(self, topic: ZmqTopic) -> Sequence[str]:
        if topic.endpoint:
            return [topic.endpoint]
        if topic.url or topic.port:
            return [_join(topic.url or self.url, topic.port or self.port)]
        return self._own_endpoints()


Config = ZmqOptions


def _join(url: str, port: int | None) -> str:
    """Return ``tcp://host:port`` from the two keys of older configurations."""
    if not url:
        return "" if port is None else f"tcp://localhost:{port}"
    full = url if "://" in url else f"tcp://{url}"
    return full if port is None else f"{full}:{port}"


def _wrong_with(endpoint: str) -> Iterator[str]:
    transport, separator, rest = endpoint.partition("://")
    host, _, port = rest.rpartition(":")
    if not separator or transport not in ("tcp", "ipc"):
        yield f"'{endpoint}' is no address; write tcp://HOST:PORT or ipc://PATH"
    elif transport == "tcp" and not (host and port.isdecimal() and 0 < int(port) < 65536):
        yield f"'{endpoint}' has no port; write tcp://HOST:PORT"
    elif transport == "tcp" and host in ("*", "0.0.0.0", "[::]"):  # refused here
        yield f"'{endpoint}' is where a publisher binds; name its host"


class ZmqSource:
    """A subscriber; it never pulls, requests or publishes, so no other one loses messages."""

    lossless = False

    def __init__(self, config: ZmqOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive from all publishers of the block in one thread until ``stop`` is set."""
        import zmq

        context = zmq.Context()
        known_topics = _KnownTopics(sink)
        links = [
            _Link(endpoint, self.config.selection(topics), sink, known_topics)
            for endpoint, topics in self.config.publishers().items()
        ]
        poller = zmq.Poller()
        try:
            for link in links:
                link.expect()
                link.connect(context, self.config)
                poller.register(link.socket, zmq.POLLIN)
                poller.register(link.monitor, zmq.POLLIN)
            while not stop.is_set():
                ready = dict(poller.poll(_POLL_MS))
                for link in links:
                    link.serve(ready)
        finally:
            for link in links:
                link.close()
            context.destroy(linger=0)


Source = ZmqSource


class _KnownTopics:
    """The topics of each publisher, kept across restarts, for blocks that record all topics."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        saved = sink.state().get("topics")
        table = saved if isinstance(saved, dict) else {}
        self._topics = {str(e): [str(name) for name in names] for e, names in table.items()}

    def topics(self, endpoint: str) -> Sequence[str]:
        """Return the topics of a publisher."""
        return self._topics.get(endpoint, ())

    def add(self, endpoint: str, topic: str) -> None:
        """Add a new topic to those restored by the next run."""
        known = self._topics.setdefault(endpoint, [])
        if topic not in known and len(known) < MOST_REMEMBERED:
            known.append(topic)
            self._sink.save_state({"topics": self._topics})


@dataclass
class _Link:
    """The connection to one publisher; ZeroMQ itself connects and connects again."""

    endpoint: str
    selection: TopicSelection
    sink: Sink
    known_topics: _KnownTopics
    is_up: bool = False
    limit: int = 0
    given_up_s: float | None = None
    pause_s: float = _GIVEN_UP_S[0]
    continuities: dict[bytes, Continuity] = field(default_factory=dict)
    streams: dict[tuple[bytes, str], int] = field(default_factory=dict)
    names: Collection[bytes] = ()
    seen: dict[str, None] = field(default_factory=dict)
    reported: set[str] = field(default_factory=set)
    # the type of each topic: empty if the first byte tells it, None for a topic that is left out
    types: dict[bytes, str | None] = field(default_factory=dict)
    socket: Any = None
    monitor: Any = None

    def expect(self) -> None:
        """Register the listed topics, and the remembered ones, whose gaps are opened.

        The recorder opens those of listed topics.
        """
        named = self.selection.named
        self.names = [name.encode() for name in named]
        self.seen = dict.fromkeys(named)
        for name in named:
            self.types[name.encode()] = self._type_of(name)
        known = self.known_topics.topics(self.endpoint) if self.selection.finds_topics else ()
        for name in filter(self._is_wanted, known):
            self.seen[name] = None
            self.sink.link_down(name, self.endpoint, _PUBLISHER_MISSING, _RUN_START_NS)

    def connect(self, context: Any, config: ZmqOptions) -> None:
        """Subscribe; returns at once, whether the publisher is there or not."""
        import zmq

        self.socket = context.socket(zmq.SUB)
        # the queue must never be the place where messages are dropped: that would not be counted
        self.socket.rcvhwm = 0
        limit_mb = config.max_message_mb
        self.limit = self.sink.longest_message() if limit_mb is None else int(limit_mb * 1e6)
        self.socket.maxmsgsize = self.limit
        self.socket.reconnect_ivl_max = 1000
        self.socket.ipv6 = True
        self.socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
        self.socket.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 10)
        self.socket.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 5)
        self.socket.setsockopt(zmq.TCP_KEEPALIVE_CNT, 3)
        _use_keys(self.socket, config)
        self.monitor = self.socket.get_monitor_socket()
        patterns = [pattern.text.partition("*")[0] for pattern, _ in self.selection.patterns]
        for prefix in {*self.selection.named, *patterns} or {""}:
            self.socket.subscribe(prefix.encode())
        self.socket.connect(self.endpoint)

    def serve(self, ready: Mapping[Any, int]) -> None:
        """Process monitor events and messages that have arrived."""
        if self.monitor in ready:
            self._take_monitor_events()
        if self.socket in ready:
            self._take_messages(_AT_ONCE)
        if self.given_up_s is not None and time.monotonic() >= self.given_up_s:
            self._connect_again()

    def close(self) -> None:
        """Report the link as down and close it."""
        if self.is_up:
            self._down("stopped")
        if self.socket is not None:
            self.socket.disable_monitor()

    def _take_monitor_events(self) -> None:
        import zmq
        from zmq.utils.monitor import parse_monitor_message

        while True:
            try:
                event = parse_monitor_message(self.monitor.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                return
            self._take_monitor_event(str(zmq.Event(event["event"]).name), event["value"])

    def _take_monitor_event(self, kind: str, value: int) -> None:
        self.given_up_s = time.monotonic() + self.pause_s if kind == "DISCONNECTED" else None
        if kind == "HANDSHAKE_SUCCEEDED" and not self.is_up:
            self.is_up = True
            self.reported -= {"unreachable", "handshake_failed"}
            for topic in self.seen:
                self.sink.link_up(topic, self.endpoint)
        elif kind == "DISCONNECTED" and self.is_up:
            self._take_messages(None)
            self._down("publisher disconnected")
        elif kind == "CONNECT_RETRIED":
            text = f"no publisher answers at {self.endpoint}; it is tried again"
            self._report_once("unreachable", text)
        elif kind.startswith("HANDSHAKE_FAILED"):
            text = f"{self.endpoint} refuses the connection; are the CURVE keys right?"
            self._report_once("handshake_failed", text, code=value)

    def _connect_again(self) -> None:
        """Reconnect after ZeroMQ has silently given up at bytes it cannot parse."""
        import zmq

        self.given_up_s = None
        self.pause_s = min(2 * self.pause_s, _GIVEN_UP_S[1])
        text = (
            f"{self.endpoint} sent what is no ZeroMQ, or a message of more than {self.limit} bytes "
            "(store.queue, max_message_mb); it is connected again"
        )
        self._report_once("malformed_connection", text)
        with suppress(zmq.ZMQError):  # the endpoint may be gone with the connection
            self.socket.disconnect(self.endpoint)
        self.socket.connect(self.endpoint)

    def _down(self, reason: str) -> None:
        self.is_up = False
        for topic in self.seen:
            self.sink.link_down(topic, self.endpoint, reason)

    def _report_once(self, key: str, text: str, kind: str = "", **details: Any) -> None:
        if key not in self.reported:
            self.reported.add(key)
            self.sink.event(kind or key, text, endpoint=self.endpoint, **details)

    def _take_messages(self, limit: int | None) -> None:
        import zmq

        receive: Callable[[int], list[bytes]] = self.socket.recv_multipart
        taken = 0
        while limit is None or taken < limit:
            try:
                frames = receive(zmq.NOBLOCK)
            except zmq.Again:
                return
            received_ns = self.sink.now_ns()
            topic, payload = _split(frames, self.names)
            if len(frames) > 2:
                text = f"a message of {len(frames)} frames; those after the topic are joined"
                self._report_once(
                    "many_frames", text, topic=topic.decode(errors="backslashreplace")
                )
            taken += 1
            if topic not in self.types:
                self.types[topic] = self._type_of(_name_of(topic))
            kind = self.types[topic]
            if kind is None:
                continue
            encoding = kind or detect_encoding(payload)
            stream = self.streams.get((topic, encoding))
            if stream is None:
                stream = self._new_stream(topic, encoding)
            self.sink.message(stream, payload, received_ns)
            self.pause_s = _GIVEN_UP_S[0]
            watched = self.continuities.get(topic)
            if watched is not None:
                self._watch(watched, topic.decode(), payload, encoding, received_ns)

    def _watch(
        self, watched: Continuity, topic: str, payload: bytes, encoding: str, received_ns: int
    ) -> None:
        """Report how many messages are missing before this one."""
        missing = watched.missing(payload, encoding)
        since_ns, watched.last_received_ns = watched.last_received_ns, received_ns
        if missing is None:
            what = "no number" if watched.sequence else "no time"
            text = f"{topic}: {watched.path} is {what}, so it does not tell what was lost"
            self._report_once(f"no_continuity {topic}", text, "no_continuity", topic=topic)
        elif missing:
            reason = f"lost before the box: holes in {watched.path}"
            self.sink.lost(topic, self.endpoint, since_ns, received_ns, missing, reason)

    def _type_of(self, name: str) -> str | None:
        """Return the type of a topic seen first, and watch its numbers; None if it is left out."""
        if not self._is_wanted(name):
            if name == UNNAMED:
                text = "a message whose topic is in no frame of its own fits no pattern: left out"
                self._report_once("unnamed", text)
            return None
        options = self.selection.options(name)
        if not isinstance(options, ZmqTopic):
            return ""
        found = options.continuity()
        if found is not None:
            self.continuities[name.encode()] = found
        return options.type

    def _is_wanted(self, name: str) -> bool:
        """Return whether a topic is recorded: chosen, or one that begins with a listed name."""
        is_below = any(map(name.startswith, self.selection.named))
        return self.selection.chooses(name) or (is_below and not self.selection.excludes(name))

    def _new_stream(self, topic: bytes, encoding: str) -> int:
        name = _name_of(topic)
        stream = self.streams[topic, encoding] = self.sink.topic(Topic(name, encoding))
        if name not in self.seen:
            self.seen[name] = None
            if self.selection.finds_topics:
                self.known_topics.add(self.endpoint, name)
            if self.is_up:
                self.sink.link_up(name, self.endpoint)
        return stream


def _use_keys(socket: Any, config: ZmqOptions) -> None:
    """Set the CURVE keys of a socket if the publisher's key is given."""
    import zmq

    if not config.curve_server_key:
        return
    own = (config.curve_public_key.encode(), config.curve_secret_key.encode())
    socket.curve_publickey, socket.curve_secretkey = own if own[1] else zmq.curve_keypair()
    socket.curve_serverkey = config.curve_server_key.encode()


def _name_of(topic: bytes) -> str:
    return topic.decode(errors="backslashreplace") or UNNAMED


def _split(frames: Sequence[bytes], names: Collection[bytes]) -> tuple[bytes, bytes]:
    """Return topic and payload of a message; a single frame may hold both."""
    if len(frames) > 1:
        return frames[0], frames[1] if len(frames) == 2 else b"".join(frames[1:])
    frame = frames[0]
    match = _NAME_AND_JSON.match(frame)
    if match is not None:
        return match[1], match[2]
    prefixes = [name for name in names if name and frame.startswith(name)]
    name = max(prefixes, key=len, default=b"")
    return name, frame[len(name) :].lstrip(b" \t\0") if name else frame
