"""The subscription of one topic: a link to each of its publishers, and when each was connected."""

from __future__ import annotations

import hashlib
import socket
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from amberbox.blackbox.sources.ros1.master import (
    RosError,
    RosRefusedError,
    SubscriberSettings,
    host_of,
)
from amberbox.blackbox.sources.ros1.tcpros import ENDED, FAILED, PublisherInfo, PublisherLink
from amberbox.core.errors import did_you_mean
from amberbox.core.source import Sink
from amberbox.core.topic_selection import TopicSelection, short_type
from amberbox.core.types import Topic

MOST_PER_TOPIC = 8
MOST_TOPICS = 4096
SAVE_EVERY_S = 0.2

Table = dict[str, dict[str, str]]


class PublisherHistory:
    """Types of topics, addresses and digests of latched messages of nodes, across restarts.

    A master that was restarted does not know the publishers that are still running; their last
    known addresses do. The digest distinguishes a repeated delivery from a new message. The port of
    the node server is kept as well.
    """

    def __init__(self, sink: Sink) -> None:
        state = sink.state()
        self._sink = sink
        self._lock = threading.Lock()
        self._saving = threading.Lock()
        self._changed = False
        self._news = threading.Event()
        self._ended = threading.Event()
        self.port = int(state.get("port", 0))
        self._uris: Table = _table(state.get("publishers"))
        self._latched: Table = _table(state.get("latched"))
        self._types: dict[str, str] = _texts(state.get("types"))
        self._dead: set[str] = set()

    def topics(self) -> list[str]:
        """Return the topics with a remembered publisher."""
        with self._lock:
            return [topic for topic, nodes in self._uris.items() if nodes]

    def type_of(self, topic: str) -> str:
        """Return the type that a topic had; empty if it is not known."""
        with self._lock:
            return self._types.get(topic, "")

    def nodes(self, topic: str) -> dict[str, str]:
        """Return the remembered publishers of a topic: addresses by node."""
        with self._lock:
            return dict(self._uris.get(topic, {}))

    def uris(self, topic: str) -> list[str]:
        """Return the addresses of the remembered publishers of a topic."""
        with self._lock:
            return list(self._uris.get(topic, {}).values())

    def knows(self, topic: str, node: str, uri: str) -> bool:
        """Return whether this process of a node has been connected before."""
        with self._lock:
            return self._uris.get(topic, {}).get(node) == uri

    def remember(self, topic: str, node: str, uri: str, kind: str) -> None:
        """Remember the address of a node, and the type of its topic."""
        with self._lock:
            if self._types.get(topic) != kind:
                self._types[topic] = kind
                self._touch()
            nodes = self._uris.setdefault(topic, {})
            if nodes.pop(node, None) != uri or uri in self._dead:
                self._touch()
            self._dead.discard(uri)
            nodes[node] = uri
            for oldest in list(nodes)[:-MOST_PER_TOPIC]:
                del nodes[oldest]
                self._latched.get(topic, {}).pop(oldest, None)
            for long_ago in list(self._uris)[:-MOST_TOPICS]:
                del self._uris[long_ago]
                self._types.pop(long_ago, None)

    def mark_dead(self, uri: str) -> None:
        """Leave an address where no process listens out of the saved state."""
        with self._lock:
            if uri not in self._dead:
                self._dead.add(uri)
                self._touch()

    def forget(self, topic: str, uri: str) -> None:
        """Remove an address that does not publish the topic any more."""
        with self._lock:
            nodes = self._uris.get(topic, {})
            for node in [node for node, at in nodes.items() if at == uri]:
                del nodes[node]
                self._latched.get(topic, {}).pop(node, None)
                self._touch()

    def latched(self, topic: str, node: str) -> str | None:
        """Return the digest of a node's last latched message."""
        with self._lock:
            return self._latched.get(topic, {}).get(node)

    def latch(self, topic: str, node: str, digest: str) -> None:
        """Remember the digest of a node's latched message."""
        with self._lock:
            self._latched.setdefault(topic, {})[node] = digest
            self._touch()

    def use_port(self, port: int) -> None:
        """Remember the node server's port, to use the same one after a restart."""
        with self._lock:
            if port != self.port:
                self.port = port
                self._touch()

    def keep_saving(self) -> None:
        """Save changes until ``end_saving``, every ``SAVE_EVERY_S`` at most; in an own thread.

        Saving may block; the threads that read from sockets do not wait for it.
        """
        while self._news.wait() and not self._ended.is_set():
            self._news.clear()
            self.save()
            self._ended.wait(SAVE_EVERY_S)

    def end_saving(self) -> None:
        """Make ``keep_saving`` return."""
        self._ended.set()
        self._news.set()

    def _touch(self) -> None:
        self._changed = True
        self._news.set()

    def save(self) -> None:
        """Save the state if it has changed."""
        with self._saving:
            state = self._changed_state()
            if state is not None:
                self._sink.save_state(state)

    def _changed_state(self) -> dict[str, Any] | None:
        with self._lock:
            if not self._changed:
                return None
            self._changed = False
            publishers = {
                topic: {node: uri for node, uri in nodes.items() if uri not in self._dead}
                for topic, nodes in self._uris.items()
            }
            latched = {topic: dict(nodes) for topic, nodes in self._latched.items()}
            return {
                "port": self.port,
                "publishers": publishers,
                "latched": latched,
                "types": dict(self._types),
            }


def _table(saved: Any) -> Table:
    if not isinstance(saved, dict):
        return {}
    return {str(topic): _texts(nodes) for topic, nodes in saved.items()}


def _texts(saved: Any) -> dict[str, str]:
    return {str(k): str(v) for k, v in saved.items()} if isinstance(saved, dict) else {}


Deliver = Callable[[bytes, int], None]

MOST_BYTES = 64 << 20


class HeldDelivery:
    """Buffers messages until ``release`` is called with their destination."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: list[tuple[bytes, int]] = []
        self._bytes = 0
        self._released = threading.Event()
        self._deliver: Deliver | None = None

    def __call__(self, data: bytes, received_ns: int) -> None:
        if self._deliver is None and self._hold(data, received_ns):
            return
        assert self._deliver is not None
        self._deliver(data, received_ns)

    def _hold(self, data: bytes, received_ns: int) -> bool:
        """Buffer a message; block when the buffer is full; return False once released."""
        with self._lock:
            if self._deliver is not None:
                return False
            if self._bytes + len(data) <= MOST_BYTES:
                self._bytes += len(data)
                self._held.append((data, received_ns))
                return True
        self._released.wait()
        return False

    def release(self, deliver: Deliver) -> None:
        """Deliver the buffered messages in order, and all later ones directly."""
        with self._lock:
            try:
                for data, received_ns in self._held:
                    deliver(data, received_ns)
            finally:
                self._held.clear()
                self._deliver = deliver
                self._released.set()

    def wait(self, timeout_s: float) -> None:
        """Wait until the messages are released."""
        self._released.wait(timeout_s)


_FIRST_MOMENT_NS = 1_000_000_000


def digest(data: bytes, has_header: bool) -> str:
    """Return a digest of a message without ``header.seq``, which rospy counts up each time."""
    return hashlib.blake2b(data[4:] if has_header else data, digest_size=16).hexdigest()


@dataclass
class LatchedFilter:
    """Delivers the messages of one connection, except a repeated latched one.

    A publisher sends its latched message to each new subscriber; rospy does so even while it
    publishes it to all, so that it comes twice within the first second of a connection. Only the
    process that delivered a message before can repeat it (``known`` is empty for another one):
    messages of a restarted publisher are recorded, even if they are equal.
    """

    topic: str
    node: str
    has_header: bool
    known: frozenset[str]
    memory: PublisherHistory
    deliver: Deliver
    repeated: Callable[[], None]
    _last: str = field(default="", init=False)
    _first_ns: int | None = field(default=None, init=False)

    def __call__(self, data: bytes, received_ns: int) -> None:
        content = digest(data, self.has_header)
        if self._first_ns is None:
            is_repeated = content in self.known
            self._first_ns = received_ns
        else:
            is_new_link = received_ns - self._first_ns < _FIRST_MOMENT_NS
            is_repeated = is_new_link and self.has_header and content == self._last
        self._last = content
        if is_repeated:
            self.repeated()
        else:
            self.deliver(data, received_ns)
        self.memory.latch(self.topic, self.node, content)


class PublisherAbsence:
    """When each node on one topic was last known not to publish it.

    A master's answer is valid for the moment of the request, so ``asked_ns`` counts, not its
    arrival. Notifications are not used: they may come late.
    """

    def __init__(self, start_ns: int) -> None:
        self._queried_ns = start_ns
        self._absent_ns: dict[str, int] = {}

    def polled(self, asked_ns: int, nodes: Collection[str]) -> None:
        """Update with the publishers that the master listed."""
        self._absent_ns = {node: self.absent_until_ns(node) for node in nodes}
        self._queried_ns = asked_ns

    def absent_until_ns(self, node: str) -> int:
        """Return the last moment at which a node is known not to have published."""
        return self._absent_ns.get(node, self._queried_ns)


PATIENCE = 4  # failed attempts before a publisher that does not answer is worth an event
MOST_NAMES = 12
LONGEST_TEXT = 500


class RosEvents:
    """Emits the events of one run, each once where it repeats; safe to call from any thread."""

    def __init__(self, sink: Sink, selection: TopicSelection) -> None:
        self.failure: Exception | None = None
        self._sink = sink
        self._selection = selection
        self._lock = threading.Lock()
        self._reported: set[tuple[str, ...]] = set()
        self._md5sums: dict[str, str] = {}

    def _emit(self, kind: str, text: str, **details: Any) -> None:
        """Emit an event; text from the network is reduced to one line."""
        self._sink.event(kind, " ".join(text.split())[:LONGEST_TEXT], **details)

    def once(self, key: tuple[str, ...], kind: str, text: str, **details: Any) -> None:
        """Emit an event unless ``key`` has been reported and not been cleared."""
        with self._lock:
            is_news = key not in self._reported
            self._reported.add(key)
        if is_news:
            self._emit(kind, text, **details)

    def clear(self, *key: str) -> bool:
        """Allow troubles with this prefix of keys to be reported again; return whether any was."""
        with self._lock:
            old = {reported for reported in self._reported if reported[: len(key)] == key}
            self._reported -= old
        return bool(old)

    def crashed(self, error: Exception) -> None:
        """Keep the first internal error."""
        self.failure = self.failure or error

    def master_lost(self, uri: str, error: RosError) -> None:
        """Report that the master does not answer."""
        text = f"the ROS master does not answer ({error.what}); open connections go on"
        self.once(("master",), "ros_master_unreachable", text, uri=uri)

    def master_found(self, uri: str) -> None:
        """Report that the master answers again."""
        if self.clear("master"):
            self._emit("ros_master_back", f"the ROS master answers again: {uri}", uri=uri)

    def forgotten(self, topics: Collection[str]) -> None:
        """Report that the master lost the registration because it was restarted."""
        text = f"the ROS master had forgotten the box (restarted?), {len(topics)} topics again"
        self._emit("ros_registered_again", text, topics=sorted(topics))

    def shutdown_requested(self, reason: str) -> None:
        """Report a request to shut the node down."""
        text = f"a ROS node asked the box to shut down, which it does not: {reason}"
        self._emit("ros_shutdown_refused", text, reason=reason)

    def unknown_topic(self, topic: str, known: Collection[str]) -> None:
        """Report that a topic has no publisher."""
        names = sorted(known)
        more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        listing = ", ".join(names[:MOST_NAMES]) + more if names else "no topics"
        suggestion = did_you_mean(topic, names)
        text = f"no publisher of {topic}{suggestion}; the master knows {listing}"
        self.once(("unknown", topic), "ros_no_publisher", text, topic=topic)

    def connected(self, topic: str, uri: str) -> None:
        """Clear the trouble of a connection that is open."""
        self.clear("link", topic, uri)
        self.clear("unknown", topic)

    def failed(self, topic: str, uri: str, failures: int, error: RosError) -> None:
        """Report a failed attempt to connect: a refusal at once, silence after ``PATIENCE``."""
        is_unknown_host = isinstance(error.__cause__, socket.gaierror)
        is_refusal = isinstance(error, RosRefusedError)
        if failures < PATIENCE and not is_refusal and not is_unknown_host:
            return
        kind = "ros_publisher_refused" if is_refusal else "ros_publisher_silent"
        text = f"{topic}: the publisher at {uri} cannot be heard, tried again: {error.what}"
        hint = f"; give the address of '{host_of(uri)}' under 'hosts:'" if is_unknown_host else ""
        self.once(("link", topic, uri, kind), kind, text + hint, topic=topic, uri=uri)

    def malformed(self, topic: str, uri: str, error: RosError) -> None:
        """Report data that is not TCPROS."""
        hint = f" ({error.hint})" if error.hint else ""
        text = f"{topic}: {uri} sent malformed data: {error.what}{hint}; connecting again"
        self.once(("malformed", topic, uri), "ros_malformed", text, topic=topic, uri=uri)

    def repeated(self, topic: str, node: str) -> None:
        """Report a latched message that was delivered again."""
        text = f"{topic}: {node} delivered its latched message again; recorded once"
        self._emit("ros_latched_repeat", text, topic=topic, node=node)

    def definition(self, topic: str, publisher: PublisherInfo) -> None:
        """Report a type that differs from the configured or the last one, or has no definition."""
        options = self._selection.options(topic)
        wanted = short_type(options.type) if options is not None else ""
        if wanted not in ("", "*", publisher.type):
            text = f"{topic} is of type {publisher.type}, configured is {wanted}; recorded as it is"
            self.once(("type", topic, publisher.type), "ros_type_differs", text, topic=topic)
        if not publisher.definition:
            text = f"{topic}: {publisher.node} sends no message definition; recorded as bytes"
            self.once(("definition", topic, publisher.node), "ros_no_definition", text, topic=topic)
        self._compare(topic, publisher)

    def _compare(self, topic: str, publisher: PublisherInfo) -> None:
        with self._lock:
            before = self._md5sums.get(topic, publisher.md5sum)
            self._md5sums[topic] = publisher.md5sum
        if before != publisher.md5sum:
            text = f"{topic}: the message definition of {publisher.type} has changed"
            details = {"topic": topic, "before": before, "now": publisher.md5sum}
            self._emit("ros_type_changed", text, **details)


UNREGISTER_WAIT_S = 0.2  # a clean exit unregisters first, the notice may come second
REPLACED = "replaced by a newer connection"
GONE = "publisher gone"


class TopicSubscription:
    """Manages the links of one topic; called by the poller, by notices and by the links."""

    def __init__(
        self,
        topic: str,
        sink: Sink,
        memory: PublisherHistory,
        settings: SubscriberSettings,
        reports: RosEvents,
        building: threading.Lock,
        since_ns: int,
    ) -> None:
        """``since_ns`` is when the topic may have been published first without a connection."""
        self.topic = topic
        self.absence = PublisherAbsence(since_ns)
        self._since_ns = since_ns
        self._nodes = {uri: node for node, uri in memory.nodes(topic).items()}
        self._silent = set(self._nodes.values())
        self._missing: set[str] = set()
        self._sink = sink
        self._memory = memory
        self._settings = settings
        self._reports = reports
        self._building = building
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._links: dict[str, PublisherLink] = {}
        self._open: dict[str, PublisherLink] = {}
        self._listed: frozenset[str] = frozenset()
        self._is_closed = False
        self._topics: set[Topic] = set()
        self._waiting: dict[PublisherLink, HeldDelivery] = {}

    def connect_remembered(self) -> None:
        """Connect to the publishers of the last run: the master may not know them."""
        self._reconcile()

    def listed(self, uris: Sequence[str]) -> None:
        """Add the publishers' addresses from the master's answer to a registration."""
        with self._lock:
            self._listed |= frozenset(uris)
        self._reconcile()

    def noticed(self, uris: Sequence[str]) -> None:
        """Handle a notification of the master that the publishers have changed.

        A publisher missing in it has unregistered, one in it may just have come back.
        """
        with self._lock:
            before, self._listed = self._listed, frozenset(uris)
            for uri in (before - self._listed) & self._links.keys():
                self._links[uri].was_unregistered.set()
        self._reconcile()
        self._retry_now(frozenset(uris))

    def master_restarted(self) -> None:
        """Drop the list of the old master."""
        with self._lock:
            self._listed = frozenset()

    def polled(self, asked_ns: int, nodes: Collection[str], node_uri: Callable[[str], str]) -> None:
        """Update the publishers from the master's list; look up those that are not connected.

        An address from a notice received meanwhile is newer than this answer, so it is kept until
        ``PATIENCE`` attempts have failed.
        """
        self.absence.polled(asked_ns, nodes)
        found = {}
        for node in sorted(set(nodes) - self.peers()):
            try:
                found[node_uri(node)] = node
            except RosRefusedError:
                continue  # it left between the two questions
        with self._lock:
            self._nodes.update(found)
            fresh = {uri for uri in self._listed if self._is_fresh(uri)}
            self._listed = frozenset(found.keys() | fresh)
            failed = [link for uri, link in self._links.items() if uri in found and link.error]
        for link in failed:
            self._open_gap(link)
        self._reconcile()

    def peers(self) -> set[str]:
        """Return the nodes that are connected now."""
        with self._lock:
            return set(self._open)

    def unlisted(self, nodes: Collection[str]) -> set[str]:
        """Return the addresses of connected nodes that the master does not name."""
        with self._lock:
            return {link.uri for peer, link in self._open.items() if peer not in nodes}

    def close(self, reason: str) -> None:
        """Close all links; data already received is still delivered."""
        with self._lock:
            self._is_closed = True
            for link in self._links.values():
                link.close(reason)

    def join(self, end_s: float) -> None:
        """Wait for the open links to end, until a moment of the monotonic clock."""
        with self._lock:
            still_open = list(self._open.values())
        for link in still_open:
            link.join(max(0.0, end_s - time.monotonic()))

    def _is_fresh(self, uri: str) -> bool:
        link = self._links.get(uri)
        return link is not None and link.failures < PATIENCE

    def _retry_now(self, uris: frozenset[str]) -> None:
        with self._lock:
            busy = {link.uri for link in self._open.values()}
            for uri in (self._links.keys() & uris) - busy:
                self._links[uri].retry_now()

    def _retry_parked(self) -> None:
        with self._lock:
            parked = frozenset(uri for uri, link in self._links.items() if link.is_parked)
        self._retry_now(parked)

    def _reconcile(self) -> None:
        """Open and close links so that there is one for every listed or remembered address."""
        with self._lock:
            if self._is_closed:
                return
            wanted = self._listed | set(self._memory.uris(self.topic))
            for uri in wanted - self._links.keys():
                self._links[uri] = PublisherLink(
                    self.topic, uri, self, self._settings, self._sink.now_ns
                )
                self._links[uri].start()
            kept = {link.uri for link in self._open.values()} | wanted
            for uri in self._links.keys() - kept:
                self._links.pop(uri).close("not listed any more")

    # Callbacks of the links, from their threads.

    def opened(self, link: PublisherLink, publisher: PublisherInfo) -> Deliver | None:
        """Register a new connection; None if the same process is connected already."""
        with self._opening:
            rival = self._open.get(link.peer)
            if rival is not None and rival.endpoint == link.endpoint:
                return None
            if rival is not None:
                # finish a connection whose node is back elsewhere, so that the order is kept
                rival.close(REPLACED)
                rival.join(self._settings.timeout_s)
                self._take_down(rival, REPLACED, None)
            try:
                return self._take_up(link, publisher)
            except Exception:
                self._take_down(link, FAILED, None)
                raise

    def _take_up(self, link: PublisherLink, publisher: PublisherInfo) -> Deliver | None:
        """Report the link as up before anything slow: messages arrive from now on."""
        link.was_unregistered.clear()
        with self._lock:
            if link.is_closing:
                return None
            self._open[link.peer] = link
            self._nodes[link.uri] = link.peer
            since_ns = self._absent_until_ns(link.peer)
            self._missing.discard(link.peer)
            self._silent.discard(link.peer)
            self._sink.link_up(self.topic, link.peer, since_ns)
        is_known = self._memory.knows(self.topic, link.peer, link.uri)
        self._memory.remember(self.topic, link.peer, link.uri, publisher.type)
        self._reports.connected(self.topic, link.uri)
        self._reports.definition(self.topic, publisher)
        topic = publisher.topic(self.topic)
        delivery = partial(self._delivery, topic, link, publisher.has_header(), is_known)
        return delivery() if topic in self._topics else self._held(link, delivery)

    def _held(self, link: PublisherLink, delivery: Callable[[], Deliver]) -> HeldDelivery:
        """Return a buffer for messages while a thread registers a new topic."""
        held = self._waiting[link] = HeldDelivery()
        name = f"ros-type{self.topic}"
        arguments = (held, delivery)
        threading.Thread(target=self._release, args=arguments, name=name, daemon=True).start()
        return held

    def _release(self, held: HeldDelivery, delivery: Callable[[], Deliver]) -> None:
        try:
            with self._building:  # one at a time, so that readers get to run in between
                held.release(delivery())
        except Exception as error:
            self._reports.crashed(error)
            held.release(lambda data, received_ns: None)  # the run is over, with this error

    def _delivery(
        self, topic: Topic, link: PublisherLink, has_header: bool, is_known: bool
    ) -> Deliver:
        stream = self._sink.topic(topic)
        self._topics.add(topic)
        deliver = partial(self._sink.message, stream)
        if not topic.latched:
            return deliver
        repeated = partial(self._reports.repeated, self.topic, link.peer)
        known = self._known(link.peer, has_header) if is_known else frozenset()
        return LatchedFilter(
            self.topic, link.peer, has_header, known, self._memory, deliver, repeated
        )

    def _known(self, node: str, has_header: bool) -> frozenset[str]:
        """Return the digests of the last message of a process, from the state and the store."""
        known = {self._memory.latched(self.topic, node)}
        last = self._sink.last_latched(self.topic)
        known.add(None if last is None else digest(last, has_header))
        return frozenset(content for content in known if content is not None)

    def closed(self, link: PublisherLink, reason: str, since_ns: int | None) -> None:
        """Handle the end of a connection."""
        held = self._waiting.pop(link, None)
        if held is not None:
            held.wait(self._settings.timeout_s)
        is_registered = not self._settings.invisible
        if reason == ENDED and is_registered and link.was_unregistered.wait(UNREGISTER_WAIT_S):
            reason = GONE
            self._memory.forget(self.topic, link.uri)
        self._take_down(link, reason, since_ns)
        self._reconcile()
        self._retry_parked()

    def _take_down(self, link: PublisherLink, reason: str, since_ns: int | None) -> None:
        with self._lock:
            if self._open.get(link.peer) is link:
                del self._open[link.peer]
                self._missing.add(link.peer)
                self._sink.link_down(self.topic, link.peer, reason, since_ns)

    def _absent_until_ns(self, node: str) -> int:
        """Return since when a node may have published without a connection."""
        if node in self._silent:
            return self._since_ns
        return self.absence.absent_until_ns(node)

    def _is_wanted(self, link: PublisherLink) -> bool:
        """Return whether the master lists a publisher, or it is remembered as one."""
        with self._lock:
            return link.uri in self._listed or link.uri in self._memory.uris(self.topic)

    def _open_gap(self, link: PublisherLink) -> None:
        """Open the gap of a publisher that cannot be connected."""
        with self._lock:
            node = self._nodes.get(link.uri)
            if node is None or node in self._missing or node in self._open or self._is_closed:
                return
            self._missing.add(node)
            reason = f"publisher not connected: {link.error}"
            self._sink.link_down(self.topic, node, reason, self._absent_until_ns(node))

    def failed(self, link: PublisherLink, error: RosError) -> None:
        """Handle a failed attempt to connect; an address that is listed no more is given up."""
        if link.is_closing:
            return
        self._reports.failed(self.topic, link.uri, link.failures, error)
        if isinstance(error, RosRefusedError):
            self._memory.forget(self.topic, link.uri)
        if self._is_wanted(link):
            self._open_gap(link)
        if isinstance(error.__cause__, ConnectionRefusedError):
            self._memory.mark_dead(link.uri)
        self._reconcile()

    def malformed(self, link: PublisherLink, error: RosError) -> None:
        """Report data that is not TCPROS."""
        self._reports.malformed(self.topic, link.uri, error)

    def retry_limit_s(self, link: PublisherLink) -> float:
        """Return the longest wait between attempts: shorter for addresses that the master lists."""
        with self._lock:
            is_listed = link.uri in self._listed
        return self._settings.listed_retry_s if is_listed else self._settings.unlisted_retry_s

    def crashed(self, error: Exception) -> None:
        """Pass an internal error to the thread that runs the source."""
        self._reports.crashed(error)
