"""One topic: a link to each of its publishers, and the account of when each one was heard."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial

from amberbox.blackbox.ros1.held import Deliver, HeldDelivery
from amberbox.blackbox.ros1.latched import LatchedFilter, digest
from amberbox.blackbox.ros1.link import ENDED, FAILED, Link
from amberbox.blackbox.ros1.memory import Memory
from amberbox.blackbox.ros1.reports import PATIENCE, Reports
from amberbox.blackbox.ros1.settings import RefusedError, RosError, Settings
from amberbox.blackbox.ros1.sightings import Sightings
from amberbox.blackbox.ros1.tcpros import Publisher
from amberbox.core.source import Sink
from amberbox.core.types import Topic

UNREGISTER_WAIT_S = 0.2  # a clean exit unregisters first, the notice may come second
REPLACED = "replaced by a newer connection"
GONE = "publisher gone"


class Subscription:
    """Keeps the links of one topic; called by the master's watcher, notices and the links."""

    def __init__(
        self,
        topic: str,
        sink: Sink,
        memory: Memory,
        settings: Settings,
        reports: Reports,
        building: threading.Lock,
        since_ns: int,
    ) -> None:
        """``since_ns`` is when the topic may have been published first, unheard."""
        self.topic = topic
        self.sightings = Sightings(since_ns)
        self._since_ns = since_ns
        self._nodes = {uri: node for node, uri in memory.nodes(topic).items()}
        self._unheard = set(self._nodes.values())
        self._missing: set[str] = set()
        self._sink = sink
        self._memory = memory
        self._settings = settings
        self._reports = reports
        self._building = building
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._links: dict[str, Link] = {}
        self._open: dict[str, Link] = {}
        self._listed: frozenset[str] = frozenset()
        self._is_closed = False
        self._topics: set[Topic] = set()
        self._waiting: dict[Link, HeldDelivery] = {}

    def connect_remembered(self) -> None:
        """Try the publishers of the last run: the master may have forgotten them."""
        self._reconcile()

    def listed(self, uris: Sequence[str]) -> None:
        """Take the publishers' addresses as the master answers a registration."""
        with self._lock:
            self._listed |= frozenset(uris)
        self._reconcile()

    def noticed(self, uris: Sequence[str]) -> None:
        """Take a notice of the master that the publishers have changed.

        Who is missing in it has unregistered, who is in it may just have come back.
        """
        with self._lock:
            before, self._listed = self._listed, frozenset(uris)
            for uri in (before - self._listed) & self._links.keys():
                self._links[uri].was_unregistered.set()
        self._reconcile()
        self._poke(frozenset(uris))

    def master_restarted(self) -> None:
        """Forget what the old master listed: that the new one does not means nothing."""
        with self._lock:
            self._listed = frozenset()

    def polled(self, asked_ns: int, nodes: Collection[str], node_uri: Callable[[str], str]) -> None:
        """Take the publishers' names from the master; look up those that are not connected.

        An address that a notice named meanwhile is newer than this answer, so it is kept until
        a few attempts have failed.
        """
        self.sightings.polled(asked_ns, nodes)
        found = {}
        for node in sorted(set(nodes) - self.peers()):
            try:
                found[node_uri(node)] = node
            except RefusedError:
                continue  # it left between the two questions
        with self._lock:
            self._nodes.update(found)
            fresh = {uri for uri in self._listed if self._is_fresh(uri)}
            self._listed = frozenset(found.keys() | fresh)
            failed = [link for uri, link in self._links.items() if uri in found and link.error]
        for link in failed:
            self._miss(link)
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
        """Begin to end all links; what has arrived is still delivered."""
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

    def _poke(self, uris: frozenset[str]) -> None:
        with self._lock:
            busy = {link.uri for link in self._open.values()}
            for uri in (self._links.keys() & uris) - busy:
                self._links[uri].poke()

    def _poke_parked(self) -> None:
        with self._lock:
            parked = frozenset(uri for uri, link in self._links.items() if link.is_parked)
        self._poke(parked)

    def _reconcile(self) -> None:
        """Have a link for every address worth trying, and for no other."""
        with self._lock:
            if self._is_closed:
                return
            wanted = self._listed | set(self._memory.uris(self.topic))
            for uri in wanted - self._links.keys():
                self._links[uri] = self._new_link(uri)
                self._links[uri].start()
            kept = {link.uri for link in self._open.values()} | wanted
            for uri in self._links.keys() - kept:
                self._links.pop(uri).close("not listed any more")

    def _new_link(self, uri: str) -> Link:
        return Link(self.topic, uri, self, self._settings, self._sink.now_ns)

    # What links tell, from their threads.

    def opened(self, link: Link, publisher: Publisher) -> Deliver | None:
        """Account for a new connection; None if the same process is connected already."""
        with self._opening:
            rival = self._open.get(link.peer)
            if rival is not None and rival.endpoint == link.endpoint:
                return None
            if rival is not None:
                self._replace(rival)
            try:
                return self._take_up(link, publisher)
            except Exception:
                self._take_down(link, FAILED, None)
                raise

    def _replace(self, rival: Link) -> None:
        """Finish a connection whose node is back elsewhere, so that the order is kept."""
        rival.close(REPLACED)
        rival.join(self._settings.timeout_s)
        self._take_down(rival, REPLACED, None)

    def _take_up(self, link: Link, publisher: Publisher) -> Deliver | None:
        """Say that the link is up before anything that takes time: messages arrive from now on."""
        link.was_unregistered.clear()
        with self._lock:
            if link.is_closing:
                return None
            self._open[link.peer] = link
            self._nodes[link.uri] = link.peer
            since_ns = self._absent_until_ns(link.peer)
            self._missing.discard(link.peer)
            self._unheard.discard(link.peer)
            self._sink.link_up(self.topic, link.peer, since_ns)
        is_known = self._memory.knows(self.topic, link.peer, link.uri)
        self._memory.remember(self.topic, link.peer, link.uri)
        self._reports.connected(self.topic, link.uri)
        self._reports.definition(self.topic, publisher)
        topic = publisher.topic(self.topic)
        delivery = partial(self._delivery, topic, link, publisher.has_header(), is_known)
        return delivery() if topic in self._topics else self._held(link, delivery)

    def _held(self, link: Link, delivery: Callable[[], Deliver]) -> HeldDelivery:
        """Hold messages back while a thread makes a new topic known, which may take a while."""
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

    def _delivery(self, topic: Topic, link: Link, has_header: bool, is_known: bool) -> Deliver:
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
        """Return what a process has delivered last, as the store and the state know it."""
        known = {self._memory.latched(self.topic, node)}
        last = self._sink.last_latched(self.topic)
        known.add(None if last is None else digest(last, has_header))
        return frozenset(content for content in known if content is not None)

    def closed(self, link: Link, reason: str, since_ns: int | None) -> None:
        """Account for the end of a connection."""
        held = self._waiting.pop(link, None)
        if held is not None:
            held.wait(self._settings.timeout_s)
        if reason == ENDED and self._has_unregistered(link):
            reason = GONE
            self._memory.forget(self.topic, link.uri)
        self._take_down(link, reason, since_ns)
        self._reconcile()
        self._poke_parked()

    def _has_unregistered(self, link: Link) -> bool:
        return not self._settings.invisible and link.was_unregistered.wait(UNREGISTER_WAIT_S)

    def _take_down(self, link: Link, reason: str, since_ns: int | None) -> None:
        with self._lock:
            if self._open.get(link.peer) is link:
                del self._open[link.peer]
                self._missing.add(link.peer)
                self._sink.link_down(self.topic, link.peer, reason, since_ns)

    def _absent_until_ns(self, node: str) -> int:
        """Return since when a node may have published; one of the run before, ever since then."""
        if node in self._unheard:
            return self._since_ns
        return self.sightings.absent_until_ns(node)

    def _is_wanted(self, link: Link) -> bool:
        """Tell whether the master names a publisher, or it was one and has not denied it since."""
        with self._lock:
            return link.uri in self._listed or link.uri in self._memory.uris(self.topic)

    def _miss(self, link: Link) -> None:
        """Open the gap of a publisher that is wanted and cannot be connected."""
        with self._lock:
            node = self._nodes.get(link.uri)
            if node is None or node in self._missing or node in self._open or self._is_closed:
                return
            self._missing.add(node)
            reason = f"publisher not connected: {link.error}"
            self._sink.link_down(self.topic, node, reason, self._absent_until_ns(node))

    def failed(self, link: Link, error: RosError) -> None:
        """Account for a failed attempt; an address that nobody names any more is given up."""
        if link.is_closing:
            return
        self._reports.failed(self.topic, link.uri, link.failures, error)
        if isinstance(error, RefusedError):
            self._memory.forget(self.topic, link.uri)
        if self._is_wanted(link):
            self._miss(link)
        if isinstance(error.__cause__, ConnectionRefusedError):
            self._memory.bury(link.uri)
        self._reconcile()

    def malformed(self, link: Link, error: RosError) -> None:
        """Report data that is not TCPROS."""
        self._reports.malformed(self.topic, link.uri, error)

    def retry_limit_s(self, link: Link) -> float:
        """Try what the master names more often than what it does not."""
        with self._lock:
            is_listed = link.uri in self._listed
        return self._settings.listed_retry_s if is_listed else self._settings.unlisted_retry_s

    def crashed(self, error: Exception) -> None:
        """Hand an error of ours to the thread that runs the source."""
        self._reports.crashed(error)
