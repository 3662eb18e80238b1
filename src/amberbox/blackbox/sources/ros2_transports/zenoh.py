"""ROS 2 by way of Zenoh, as robots use it that run ``rmw_zenoh``.

What there is, liveliness tokens say; messages carry sequence number, stamp and publisher:
https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md
"""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from amberbox.blackbox.sources.ros2_transports.names import (
    ZenohEntity,
    entity_of_token,
    zenoh_key,
    zenoh_tokens,
)
from amberbox.blackbox.sources.ros2_transports.options import ZENOH_ENDPOINT, Ros2Options
from amberbox.blackbox.sources.ros2_transports.recorded_topics import (
    MOST_TOPICS,
    OfferedTopic,
    RecordedTopics,
    SequenceBook,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph
from amberbox.core.source import Sink

if TYPE_CHECKING:
    import zenoh

_BACKOFF_S = (0.5, 10.0)
_POLL_S = 0.2
_MOST_TOKENS = 100_000
_HISTORY = 1000  # messages that a latched publisher may deliver again to a new subscriber
_STOPPED = "the recorder stopped listening"
# the attachment of each message: number, stamp in ns, length of the id, id
_ATTACHMENT = struct.Struct("<qqB16s")
# the same of rmw_zenoh before 2025, where each part has its name before it
_OLD_ATTACHMENT = struct.Struct("<16xq17xq12x16s")


@dataclass(frozen=True, slots=True)
class MessageOrigin:
    """Who published a message (its id on the wire), as which one, and when by its clock."""

    publisher: bytes
    number: int
    stamp_ns: int


def origin_of(attachment: bytes) -> MessageOrigin | None:
    """Read the attachment of a message; None for one that ``rmw_zenoh`` does not write."""
    if len(attachment) == _ATTACHMENT.size:
        number, stamp_ns, _, publisher = _ATTACHMENT.unpack(attachment)
    elif len(attachment) == _OLD_ATTACHMENT.size:
        number, stamp_ns, publisher = _OLD_ATTACHMENT.unpack(attachment)
    else:
        return None
    return MessageOrigin(publisher, number, stamp_ns)


def session_config(options: Ros2Options, longest_bytes: int) -> zenoh.Config:
    """Return the configuration of a session; raises AmberboxError for a file that is none."""
    import zenoh

    if options.zenoh_config:
        try:
            config = zenoh.Config.from_file(options.zenoh_config)
        except zenoh.ZError as error:
            what = f"{options.zenoh_config} is no configuration of Zenoh: {error}"
            raise AmberboxError(what, "write it as rmw_zenoh does, in JSON5") from error
    else:
        config = zenoh.Config()
        config.insert_json5("mode", json.dumps(options.mode))
        config.insert_json5("scouting/multicast/enabled", json.dumps(options.scouting))
        config.insert_json5("listen/endpoints", "[]")  # it only connects to others
    if options.endpoint or not options.zenoh_config:
        endpoint = _mapped(options.endpoint or ZENOH_ENDPOINT, options)
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("transport/link/rx/max_message_size", str(longest_bytes))
    return config


def _mapped(endpoint: str, options: Ros2Options) -> str:
    """Return an endpoint with the configured address of its host."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    addresses = {name.lower(): known for name, known in options.hosts.items()}
    return f"{protocol}/{addresses.get(host.lower(), host)}:{port}"


class Transport:
    """Listens to the topics of a domain in one Zenoh session, which connects again by itself."""

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set."""
        import zenoh

        topics = RecordedTopics(self._options, sink)
        limit_mb = self._options.max_message_mb
        longest = sink.longest_message() if limit_mb is None else round(limit_mb * 1e6)
        pause_s = _BACKOFF_S[0]
        while not stop.is_set():
            try:
                session = zenoh.open(session_config(self._options, longest))
            except zenoh.ZError as error:
                self._report_unreachable(topics, str(error))
                stop.wait(pause_s)
                pause_s = min(2 * pause_s, _BACKOFF_S[1])
                continue
            listener = ZenohListener(session, self._options, sink, topics)
            try:
                listener.listen(stop, lambda: self._report_unreachable(topics, "it went away"))
            finally:
                listener.close()

    def _report_unreachable(self, topics: RecordedTopics, why: str) -> None:
        text = f"no Zenoh router or peer at {self._where}: {why}; it is tried again"
        topics.report_once(("zenoh",), "zenoh_unreachable", text, endpoint=self._where)

    def _open(self) -> zenoh.Session:
        import zenoh

        try:
            return zenoh.open(session_config(self._options, 1_000_000))
        except zenoh.ZError as error:
            what = f"no Zenoh router or peer at {self._where}: {error}"
            raise AmberboxError(what, "start it: ros2 run rmw_zenoh_cpp rmw_zenohd") from error

    @property
    def _where(self) -> str:
        return self._options.endpoint or self._options.zenoh_config or ZENOH_ENDPOINT

    def follow_nodes(self, tell: Callable[[Collection[str]], None], stop: threading.Event) -> None:
        """Tell which nodes have a liveliness token."""
        import zenoh
        from zenoh.handlers import Callback

        tokens: dict[str, str] = {}  # to their nodes
        lock = threading.Lock()

        def hear(sample: zenoh.Sample) -> None:
            entity = entity_of_token(str(sample.key_expr))
            with lock:
                if sample.kind != zenoh.SampleKind.PUT:
                    tokens.pop(str(sample.key_expr), None)
                elif entity is not None and len(tokens) < _MOST_TOKENS:
                    tokens[str(sample.key_expr)] = entity.node

        session = self._open()
        try:
            callback: Any = Callback(hear, indirect=False)
            expression = zenoh_tokens(self._options.chosen_domain())
            follower = session.liveliness().declare_subscriber(expression, callback, history=True)
            while not stop.wait(_POLL_S):
                if not list(session.info.transports()):
                    raise AmberboxError(f"no Zenoh router or peer at {self._where} any more")
                with lock:
                    nodes = set(tokens.values())
                tell(nodes)
            follower.undeclare()
        finally:
            session.close()

    def read_graph(self, wait_s: float) -> RobotGraph:
        """Return what the liveliness tokens of the domain say."""
        session = self._open()
        try:
            tokens = zenoh_tokens(self._options.chosen_domain())
            replies = session.liveliness().get(tokens, timeout=wait_s)
            found = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        finally:
            session.close()
        return graph_of(filter(None, map(entity_of_token, found[:_MOST_TOKENS])))


@dataclass
class _Subscription:
    """A subscription to one key: a topic with one type."""

    offer: OfferedTopic
    subscriber: Any = None
    nodes: dict[str, str] = field(default_factory=dict)  # token to node
    stream: int | None = None
    # publishers whose first message since the subscription was received
    heard: set[bytes] = field(default_factory=set)

    def peer(self, publisher: bytes) -> str:
        """Return the node of a publisher; its id where several nodes publish."""
        nodes = set(self.nodes.values())
        return nodes.pop() if len(nodes) == 1 else publisher.hex()


class ZenohListener:
    """One session: follows the tokens of the domain, and subscribes to what is chosen."""

    def __init__(
        self, session: zenoh.Session, options: Ros2Options, sink: Sink, topics: RecordedTopics
    ) -> None:
        self._session = session
        self._options = options
        self._domain = options.chosen_domain()
        self._sink = sink
        self._topics = topics
        self._sequences = SequenceBook(sink)
        self._subscriptions: dict[str, _Subscription] = {}  # by key
        self._keys: dict[str, str] = {}  # token to key
        self._news: SimpleQueue[tuple[bool, str, int]] = SimpleQueue()
        self._error: Exception | None = None
        self._lock = threading.Lock()
        self._is_connected = False
        self._knows_all = False  # whether the tokens that were there before have arrived
        # since when publishers may have been there unseen; None: since ever
        self._since_ns: int | None = None

    def listen(self, stop: threading.Event, lost: Callable[[], None]) -> None:
        """Receive until ``stop`` is set; calls ``lost`` when the last connection ends."""
        tokens = self._session.liveliness().declare_subscriber(
            zenoh_tokens(self._domain), self._direct(self._hear_token), history=True
        )
        while not stop.is_set():
            self._watch_connection(lost)
            if self._error is not None:
                raise self._error
            try:
                is_there, token, heard_ns = self._news.get(timeout=_POLL_S)
            except Empty:
                self._knows_all = self._is_connected
                if self._is_connected:
                    self._topics.report_missing()
                continue
            if is_there:
                self._appear(token, heard_ns)
            else:
                self._vanish(token, "its liveliness token is gone")
        tokens.undeclare()

    def close(self) -> None:
        """End the session; reports that nothing arrives any more."""
        for token in list(self._keys):
            self._vanish(token, _STOPPED)
        self._session.close()

    @staticmethod
    def _direct(callback: Callable[[zenoh.Sample], None]) -> Any:
        """Have a callback called in the thread that receives: nothing waits in between."""
        from zenoh.handlers import Callback

        return Callback(callback, indirect=False)

    def _watch_connection(self, lost: Callable[[], None]) -> None:
        is_connected = bool(list(self._session.info.transports()))
        if is_connected and not self._is_connected:
            self._topics.clear("zenoh")
            self._topics.report("zenoh_connected", f"connected to Zenoh, domain {self._domain}")
        elif self._is_connected and not is_connected:
            lost()
            self._knows_all, self._since_ns = False, self._sink.now_ns()
        self._is_connected = is_connected

    def _hear_token(self, sample: zenoh.Sample) -> None:
        import zenoh

        is_there = sample.kind == zenoh.SampleKind.PUT
        self._news.put((is_there, str(sample.key_expr), self._sink.now_ns()))

    def _appear(self, token: str, heard_ns: int) -> None:
        """Subscribe to the topic of a publisher, where it is chosen."""
        entity = entity_of_token(token)
        if entity is None or entity.kind != "MP" or token in self._keys:
            return
        if not self._topics.chooses(entity.name, entity.type_name):
            return
        key = zenoh_key(self._domain, entity.name, entity.type_name, entity.type_hash)
        subscription = self._subscriptions.get(key)
        is_latched = self._reads_history(entity)
        if subscription is not None and is_latched and not subscription.offer.latched:
            subscription.subscriber.undeclare()  # one that latches has come: its history is due
            subscription = None
        if subscription is None:
            if len(self._subscriptions) >= MOST_TOPICS:
                return
            subscription = self._subscribe(key, entity, is_latched)
        self._keys[token] = key
        is_news = entity.node not in subscription.nodes.values()
        subscription.nodes[token] = entity.node
        if is_news:
            since_ns = heard_ns if self._knows_all else self._since_ns
            self._sink.link_up(entity.name, entity.node, since_ns)

    def _reads_history(self, entity: ZenohEntity) -> bool:
        """Return whether what a publisher sent before is read as well."""
        durability = self._options.wanted_qos(entity.name).durability
        if durability == "transient_local" and not entity.latched:
            self._topics.report_not_offered(entity.name, durability)
        return entity.latched and durability != "volatile"

    def _subscribe(self, key: str, entity: ZenohEntity, is_latched: bool) -> _Subscription:
        import zenoh.ext

        offer = OfferedTopic(entity.name, entity.type_name, entity.type_hash, is_latched)
        before = self._subscriptions.get(key)
        subscription = _Subscription(offer, nodes={} if before is None else before.nodes)
        self._subscriptions[key] = subscription
        hear = self._direct(lambda sample: self._hear(subscription, sample))
        if is_latched:
            depth = self._options.wanted_qos(entity.name).depth or _HISTORY
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=depth)
            subscription.subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session, key, hear, history=history
            )
        else:
            subscription.subscriber = self._session.declare_subscriber(key, hear)
        self._topics.expect(offer)
        return subscription

    def _vanish(self, token: str, reason: str) -> None:
        key = self._keys.pop(token, None)
        if key is None:
            return
        subscription = self._subscriptions[key]
        node = subscription.nodes.pop(token)
        if node not in subscription.nodes.values():
            self._sink.link_down(subscription.offer.name, node, reason)

    def _hear(self, subscription: _Subscription, sample: zenoh.Sample) -> None:
        """Take one message, in a thread of Zenoh."""
        received_ns = self._sink.now_ns()
        try:
            data = sample.payload.to_bytes()
            attachment = sample.attachment
            origin = None if attachment is None else origin_of(attachment.to_bytes())
            with self._lock:
                self._take(subscription, data, origin, received_ns)
        except Exception as error:  # it would only be printed by Zenoh
            self._error = error

    def _take(
        self, subscription: _Subscription, data: bytes, origin: MessageOrigin | None, at_ns: int
    ) -> None:
        offer = subscription.offer
        if subscription.stream is None:
            subscription.stream = self._topics.stream(offer, data)
        if origin is None:
            text = f"{offer.name}: messages without number and stamp: what is lost is not known"
            self._topics.report_once(("origin", offer.name), "ros2_no_origin", text)
        else:
            is_first = origin.publisher not in subscription.heard
            if is_first and len(subscription.heard) < MOST_TOPICS:
                subscription.heard.add(origin.publisher)
            peer = partial(subscription.peer, origin.publisher)
            is_news = self._sequences.take(offer.name, origin.publisher, peer, origin.number, at_ns)
            if offer.latched:
                if not is_news or (is_first and self._topics.is_repeat(offer.name, peer(), data)):
                    return
                self._topics.latched(offer.name, data)
        if subscription.stream >= 0:
            self._sink.message(subscription.stream, data, at_ns)


def graph_of(entities: Iterator[ZenohEntity]) -> RobotGraph:
    """Return the graph that tokens describe."""
    nodes: set[str] = set()
    topics: dict[str, tuple[str, set[str], set[str]]] = {}
    services: dict[tuple[str, str], GraphService] = {}
    for entity in entities:
        nodes.add(entity.node)
        if entity.kind in ("MP", "MS"):
            _, publishers, subscribers = topics.setdefault(
                entity.name, (entity.type_name, set(), set())
            )
            (publishers if entity.kind == "MP" else subscribers).add(entity.node)
        elif entity.kind == "SS":
            service = GraphService(entity.name, entity.type_name, entity.node)
            services[entity.name, entity.node] = service
    return RobotGraph(
        tuple(sorted(nodes)),
        tuple(
            GraphTopic(name, kind, tuple(sorted(publishers)), tuple(sorted(subscribers)))
            for name, (kind, publishers, subscribers) in sorted(topics.items())
        ),
        tuple(services[key] for key in sorted(services)),
    )
