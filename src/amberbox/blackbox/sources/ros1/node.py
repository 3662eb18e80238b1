"""A ROS 1 node that publishes and subscribes for as long as a command runs.

The recorder's subscriber (``client.py``) lives as long as the robot and keeps accounts of gaps;
this node gives up at its deadlines and reports why.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import TracebackType
from typing import TypeVar

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosError,
    RosMaster,
    SystemState,
    host_and_port,
    own_host,
    request_topic,
)
from amberbox.blackbox.sources.ros1.message_type import MOST_BYTES, MessageType, message_type
from amberbox.blackbox.sources.ros1.node_server import NodeServer
from amberbox.blackbox.sources.ros1.tcpros import (
    PublisherInfo,
    PublisherLink,
    connect,
    read_answer,
)
from amberbox.blackbox.sources.ros1.topic_server import (
    MOST_CONNECTIONS,
    OfferedTopic,
    Patience,
    TopicServer,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.tls import is_loopback

MOST_LINKS = 16  # publishers of one topic
RETRY_S = 0.5
CLOSE_S = 0.3

T = TypeVar("T")

Received = Callable[[str, MessageType, bytes], None]
"""Called with the node that published, its type and the message."""


@dataclass(frozen=True)
class TopicWish:
    """A subscription: its type, what is called with messages, and with changes of its links."""

    name: str
    type: str
    received: Received
    kind: MessageType | None = None
    lost: Callable[[str], None] = lambda node: None


class TopicReader:
    """Reads one topic from all its publishers; those of another type are refused, with a reason."""

    def __init__(self, wish: TopicWish, settings: NodeSettings) -> None:
        self._wish = wish
        self._settings = settings
        self._lock = threading.Lock()
        self._links: dict[str, PublisherLink] = {}
        self._open: dict[PublisherLink, str] = {}
        self._is_closed = False
        self.trouble = ""

    def nodes(self) -> set[str]:
        """Return the names of the nodes whose messages arrive."""
        with self._lock:
            return set(self._open.values())

    def listed(self, uris: Sequence[str], is_first: bool = False) -> None:
        """Connect to these publishers, and to no others, unless newer ones are known already."""
        with self._lock:
            wanted = set(list(uris)[:MOST_LINKS])
            for uri in () if is_first else self._links.keys() - wanted:
                self._links.pop(uri).close("not listed any more")
            for uri in wanted - self._links.keys():
                if not self._is_closed:
                    link = PublisherLink(self._wish.name, uri, self, self._settings, time.time_ns)
                    self._links[uri] = link
                    link.start()

    def close(self) -> None:
        """Close all connections."""
        with self._lock:
            self._is_closed = True
            links = list(self._links.values())
        for link in links:
            link.close("the command has ended")

    # Callbacks of the links, from their threads.

    def opened(
        self, link: PublisherLink, publisher: PublisherInfo
    ) -> Callable[[bytes, int], None] | None:
        """Check the type of a publisher; None, which closes the connection, if it does not fit."""
        node, wish = publisher.node, self._wish
        try:
            kind = _agreed(wish, publisher)
        except AmberboxError as error:
            self.trouble = f"{node}: {error.what}"
            return None
        with self._lock:
            if link.is_closing:
                return None
            self._open[link] = node
        return lambda data, received_ns: wish.received(node, kind, data)

    def closed(self, link: PublisherLink, reason: str, since_ns: int | None) -> None:
        """Report the end of a connection."""
        with self._lock:
            node = self._open.pop(link, None)
        if node is not None:
            self._wish.lost(node)

    def failed(self, link: PublisherLink, error: RosError) -> None:
        """Keep why a connection failed; it is tried again."""
        self.trouble = error.what

    def malformed(self, link: PublisherLink, error: RosError) -> None:
        """Keep what was wrong with the data of a publisher."""
        self.trouble = f"{link.peer}: {error.what}"

    def crashed(self, error: Exception) -> None:
        """Keep an internal error: the link has ended."""
        self.trouble = f"{type(error).__name__}: {error}"

    def retry_limit_s(self, link: PublisherLink) -> float:
        """Return the longest wait between two attempts."""
        return RETRY_S


def _agreed(wish: TopicWish, publisher: PublisherInfo) -> MessageType:
    """Return the type of a publisher's messages; raises AmberboxError if it is not the wanted."""
    if publisher.type != wish.type:
        raise AmberboxError(f"publishes {publisher.type[:100]} on {wish.name}, not {wish.type}")
    if wish.kind is None:
        kind = message_type(wish.type, publisher.definition.decode("utf-8", "replace"))
        if kind.md5sum != publisher.md5sum:
            raise AmberboxError(f"sent a definition of {wish.type} that is not that of its md5sum")
        return kind
    if wish.kind.md5sum != publisher.md5sum:
        raise AmberboxError(f"has another definition of {wish.type} on {wish.name}")
    return wish.kind


class RosNode:
    """A node with its servers; use it in a ``with`` block, which unregisters it at the end.

    Of two nodes with one name the master keeps the younger: a node that takes the place of one
    that crashed leaves no trace of it.
    """

    def __init__(
        self,
        settings: NodeSettings,
        deadline: Deadline,
        most_connections: int = MOST_CONNECTIONS,
    ) -> None:
        limit = min(settings.message_limit, MOST_BYTES)
        self.settings = replace(settings, message_limit=limit)
        self._readers: dict[str, TopicReader] = {}
        self._ended = ""
        self._is_closed = False
        host, _ = host_and_port(settings.master_uri)
        bind_host = "127.0.0.1" if is_loopback(host) else ""
        self._own_host = deadline.call(
            lambda: own_host(settings.advertise, os.environ, settings.master_uri),
            f"the name {host} is not resolved",
        )
        self._registered: list[tuple[str, bool]] = []
        try:
            self._topics = TopicServer(bind_host, settings.caller_id, most_connections)
            self._server = NodeServer(
                bind_host, 0, settings.master_uri, self._updated, self._shut_down, self
            )
        except OSError as error:
            raise RosError(f"no port for a ROS node: {error.strerror or error}") from error
        self._uri = f"http://{self._own_host}:{self._server.port}/"
        self._server.start()

    def __enter__(self) -> RosNode:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def advertise(self, topic: OfferedTopic, deadline: Deadline) -> None:
        """Register as a publisher and serve the topic; raise RosError."""
        self._topics.offer(topic)
        self._registered.append((topic.name, True))
        self._call(
            lambda master: master.publish(topic.name, topic.type, self._uri),
            lambda master: master.unpublish(topic.name, self._uri),
            deadline,
            f"register a publisher of {topic.name}",
        )

    def subscribe(self, wish: TopicWish, deadline: Deadline) -> TopicReader:
        """Register as a subscriber and connect to the publishers, now and later."""
        reader = self._readers[wish.name] = TopicReader(wish, self.settings)
        self._registered.append((wish.name, False))
        uris = self._call(
            lambda master: master.subscribe(wish.name, self._uri),
            lambda master: master.unsubscribe(wish.name, self._uri),
            deadline,
            f"register a subscriber of {wish.name}",
        )
        reader.listed(uris, is_first=True)
        return reader

    def _call(
        self,
        work: Callable[[RosMaster], T],
        undo: Callable[[RosMaster], object],
        deadline: Deadline,
        what: str,
    ) -> T:
        """Call the master; a registration that comes through after the end is taken back."""

        def run() -> T:
            master = RosMaster(self.settings)
            try:
                result = work(master)
                if self._is_closed:
                    undo(master)
                return result
            finally:
                master.close()

        return deadline.call(run, f"{self.settings.master_uri} did not {what}")

    def subscribers(self, topic: str, deadline: Deadline) -> set[str]:
        """Return the nodes that the master lists as subscribers of a topic."""
        return set(self.graph(deadline).subscribers.get(topic, ()))

    def graph(self, deadline: Deadline) -> SystemState:
        """Return the publishers and subscribers of all topics, as the master lists them."""
        return self._call(RosMaster.graph, lambda master: None, deadline, "give the system state")

    @property
    def dropped(self) -> int:
        """Return how many messages subscribers have lost because they were too slow."""
        return self._topics.dropped

    def learn(self, offered: OfferedTopic, deadline: Deadline) -> None:
        """Take over the definition of a type from another publisher of the topic, if there is one.

        Otherwise the first subscriber that sends one is asked, when it connects.
        """
        what = f"the definition of {offered.type} is not known"
        offered.kind = deadline.call(lambda: self._learnt(offered), what)

    def _learnt(self, offered: OfferedTopic) -> MessageType | None:
        wish = TopicWish(offered.name, offered.type, lambda *_: None)
        master = RosMaster(self.settings)
        try:
            for node in master.graph().publishers.get(offered.name, ())[:MOST_LINKS]:
                with suppress(AmberboxError):  # the next one may tell
                    host, port = request_topic(master.node_uri(node), offered.name, self.settings)
                    with connect(host, port, offered.name, self.settings) as sock:
                        return _agreed(wish, read_answer(sock, node))
        finally:
            master.close()
        return None

    def publish(self, topic: str, data: bytes) -> int:
        """Send a message to all that are connected; return to how many; raise RosError."""
        if self._ended:
            raise RosError(f"the node was shut down: {self._ended}")
        return self._topics.send(topic, data)

    def wait_for(self, topic: str, nodes: set[str], count: int, deadline: Deadline) -> set[str]:
        """Wait for subscribers as ``TopicServer.wait_for`` does."""
        return self._topics.wait_for(topic, nodes, count, deadline)

    def connected(self, topic: str) -> set[str]:
        """Return the nodes that are connected to a topic that this node publishes."""
        return self._topics.nodes(topic)

    def flush(self, topic: str, deadline: Deadline) -> set[str]:
        """Wait until all is sent; return the nodes that have not taken theirs."""
        return self._topics.flush(topic, deadline)

    def wait_for_room(self, topic: str, size: int, patience: Patience) -> None:
        """Wait until subscribers have room for a message, as ``TopicServer`` does."""
        self._topics.wait_for_room(topic, size, patience)

    def finish(self, patience: Patience) -> None:
        """Publish nothing more, and wait until subscribers have read all, as ``TopicServer``."""
        self._topics.finish(patience)

    def close(self) -> None:
        """Unregister, unless the master is slow to answer, and close all connections."""
        self._is_closed = True
        end = Deadline.within(CLOSE_S)
        master = RosMaster(replace(self.settings, timeout_s=CLOSE_S))
        with suppress(RosError):  # a registration that stays is replaced by the next run's
            end.call(lambda: self._unregister(master), "the master is slow")
        for reader in self._readers.values():
            reader.close()
        self._topics.close()
        self._server.close()

    def _unregister(self, master: RosMaster) -> None:
        for topic, publishes in self._registered:
            (master.unpublish if publishes else master.unsubscribe)(topic, self._uri)
        master.close()

    # Called by the node server, from its threads.

    def address_of(self, topic: str) -> tuple[str, int] | None:
        """Return where a topic is served."""
        offered = any(topic == each.name for each in self._topics.offered())
        return (self._own_host, self._topics.port) if offered else None

    def topics(self) -> Sequence[tuple[str, str]]:
        """Return the topics that are published, with their types."""
        return [(each.name, each.type) for each in self._topics.offered()]

    def _updated(self, topic: str, uris: Sequence[str]) -> None:
        reader = self._readers.get(topic)
        if reader is not None:
            reader.listed(uris)

    def _shut_down(self, reason: str) -> None:
        """Publish nothing more: another node has taken this one's name, or a person ended it."""
        self._ended = " ".join(reason.split())[:200] or "no reason given"
