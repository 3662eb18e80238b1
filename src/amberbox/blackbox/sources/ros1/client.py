"""The ROS 1 subscriber as a node: polls the master and hands publishers to the subscriptions.

The list of publishers is requested from the master every ``poll_s``, in both modes. A registered
node is also notified of new publishers. Polling in addition costs little and covers cases in which
notifications fail: a master that was restarted, or one whose three notification workers hang.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from queue import SimpleQueue

from amberbox.blackbox.sources.ros1.master import (
    RosError,
    RosMaster,
    SubscriberSettings,
    SystemState,
    global_name,
    host_and_port,
    own_host,
    publications,
)
from amberbox.blackbox.sources.ros1.node_server import NodeServer
from amberbox.blackbox.sources.ros1.subscription import (
    PublisherHistory,
    RosEvents,
    TopicSubscription,
)
from amberbox.core.source import Sink
from amberbox.core.tls import is_loopback
from amberbox.core.topic_selection import TopicSelection

LONGEST_WAIT_S = 2.0
FAILURE_CHECK_S = 0.2
STOP_S = 0.3
NEVER_NS = 1  # time of the last request to the master before the first one: gaps begin with the run
STOPPED = "the recorder stopped listening"

Update = tuple[str, Sequence[str]]


class RosSubscriber:
    """Subscribes to the topics that a selection chooses until stopped."""

    def __init__(self, settings: SubscriberSettings, selection: TopicSelection, sink: Sink) -> None:
        self._settings = settings
        self._selection = selection
        self._sink = sink
        self._memory = PublisherHistory(sink)
        self._reports = RosEvents(sink, selection)
        self._master = RosMaster(settings)
        self._subscriptions: dict[str, TopicSubscription] = {}
        self._registered: set[str] = set()
        self._silent_since: dict[str, float] = {}
        self._types: Mapping[str, str] = {}
        self._unmatched = [pattern for pattern, _ in selection.patterns]
        self._updates: SimpleQueue[Update | None] = SimpleQueue()
        self._node: NodeServer | None = None
        self._own_uri = ""
        self._failures = 0
        self._ending = threading.Event()
        self._changing = threading.Lock()
        self._building = threading.Lock()
        self._queried_ns = NEVER_NS
        self._queried_nodes: set[str] = set()
        memory = self._memory
        remembered = {t for t in memory.topics() if selection.chooses(t, memory.type_of(t))}
        for topic in selection.named.keys() | remembered:
            self._subscribe(topic)

    def run(self, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; raises only errors of ours."""
        threads = [
            threading.Thread(target=work, name=f"ros-{name}", daemon=True)
            for name, work in (
                ("notices", self._take_updates),
                ("memory", self._memory.keep_saving),
                ("master", self._watch),
            )
        ]
        try:
            self._start_node()
            for subscription in self._subscriptions.values():
                subscription.connect_remembered()
            for thread in threads:
                thread.start()
            while not stop.wait(FAILURE_CHECK_S):
                self._raise_failure()
        finally:
            self._close(threads)
        self._raise_failure()

    def _watch(self) -> None:
        """Poll the master until the end."""
        try:
            while not self._ending.is_set():
                self._watch_master()
                self._ending.wait(self._delay_s())
        except Exception as error:
            self._reports.crashed(error)
        finally:
            self._master.close()

    def _start_node(self) -> None:
        if self._settings.invisible:
            return
        host, _ = host_and_port(self._settings.master_uri)
        bind_host = "127.0.0.1" if is_loopback(host) else ""
        self._node = NodeServer(
            bind_host,
            self._memory.port,
            self._settings.master_uri,
            lambda topic, uris: self._updates.put((topic, uris)),
            self._reports.shutdown_requested,
        )
        self._memory.use_port(self._node.port)
        self._node.start()

    def _take_updates(self) -> None:
        """Handle the master's notices one by one, in a thread apart from the node server."""
        while (update := self._updates.get()) is not None:
            topic, uris = update
            subscription = self._subscriptions.get(global_name(topic))
            if subscription is not None:
                try:
                    subscription.noticed(uris)
                except Exception as error:
                    self._reports.crashed(error)

    def _watch_master(self) -> None:
        """Poll the master once; failed requests are repeated with the next poll."""
        asked_ns = self._sink.now_ns()
        try:
            graph = self._master.graph()
            self._reports.master_found(self._settings.master_uri)
            self._failures = 0
            if self._selection.finds_topics:
                self._subscribe_found(graph.publishers.keys() - self._subscriptions.keys())
            self._register(graph)
            self._poll(asked_ns, graph)
            self._queried_ns = asked_ns
            if self._selection.finds_topics:
                self._query_forgotten_nodes(graph)
        except RosError as error:
            self._failures += 1
            if not self._ending.is_set():
                self._reports.master_lost(self._settings.master_uri, error)

    def _subscribe_found(self, published: Set[str]) -> None:
        """Subscribe to those published topics that the selection chooses."""
        if self._selection.needs_types and published - self._types.keys():
            known = self._master.topic_types()
            self._types = {topic: known[topic] for topic in published & known.keys()}
        for topic in published:
            if self._selection.chooses(topic, self._types.get(topic, "")):
                with self._changing:
                    if not self._ending.is_set():
                        self._subscribe(topic)

    def _query_forgotten_nodes(self, graph: SystemState) -> None:
        """Request the other topics of connected nodes that the master does not list, once each."""
        found: dict[str, set[str]] = {}
        types: dict[str, str] = {}
        for topic, subscription in list(self._subscriptions.items()):
            for uri in subscription.unlisted(graph.publishers.get(topic, ())) - self._queried_nodes:
                self._queried_nodes.add(uri)
                with suppress(RosError):  # its open connections go on
                    published = publications(uri, self._settings)
                    types |= published
                    for other in published:
                        found.setdefault(other, set()).add(uri)
        for topic in found.keys() - graph.publishers.keys():
            if not self._selection.chooses(topic, types[topic]):
                continue
            with self._changing:
                if topic not in self._subscriptions and not self._ending.is_set():
                    self._subscribe(topic)
                    self._subscriptions[topic].listed(sorted(found[topic]))

    def _subscribe(self, topic: str) -> None:
        self._subscriptions[topic] = TopicSubscription(
            topic, self._sink, self._memory, self._settings, self._reports, self._building,
            self._queried_ns,
        )  # fmt: skip

    def _register(self, graph: SystemState) -> None:
        """Register for topics where the master does not list the box."""
        if self._node is None:
            return
        own = self._settings.caller_id
        forgotten = {t for t in self._registered if own not in graph.subscribers.get(t, ())}
        if forgotten:
            self._reports.forgotten(forgotten)
        for topic in forgotten:
            self._registered.discard(topic)
            self._subscriptions[topic].master_restarted()
        for topic in [t for t in self._subscriptions if t not in self._registered]:
            uris = self._master.subscribe(topic, self._node_uri(self._node))
            self._registered.add(topic)
            self._subscriptions[topic].listed(uris)

    def _node_uri(self, node: NodeServer) -> str:
        if not self._own_uri:
            host = own_host(self._settings.advertise, os.environ, self._settings.master_uri)
            self._own_uri = f"http://{host}:{node.port}/"
        return self._own_uri

    def _poll(self, asked_ns: int, graph: SystemState) -> None:
        for topic, subscription in self._subscriptions.items():
            nodes = graph.publishers.get(topic, ())
            subscription.polled(asked_ns, nodes, self._master.node_uri)
            now_s = time.monotonic()
            since_s = self._silent_since.setdefault(topic, now_s)
            if nodes or subscription.peers():
                del self._silent_since[topic]
            elif now_s - since_s >= self._settings.unknown_after_s:
                self._reports.unknown_topic(topic, graph.publishers.keys() - {topic})
        self._unmatched = [p for p in self._unmatched if not any(map(p.fits, self._subscriptions))]
        for pattern in self._unmatched:
            since_s = self._silent_since.setdefault(pattern.text, time.monotonic())
            if time.monotonic() - since_s >= self._settings.unknown_after_s:
                self._reports.unknown_topic(pattern.text, graph.publishers.keys())

    def _delay_s(self) -> float:
        if not self._failures:
            return self._settings.poll_s
        longest_s = max(LONGEST_WAIT_S, self._settings.poll_s)
        return min(self._settings.poll_s * 2.0 ** min(self._failures - 1, 16), longest_s)

    def _raise_failure(self) -> None:
        if self._reports.failure is not None:
            raise self._reports.failure

    def _close(self, threads: Sequence[threading.Thread]) -> None:
        """Close the links first, so that gaps are recorded, then threads and node server."""
        with self._changing:
            self._ending.set()
        self._updates.put(None)
        self._memory.end_saving()
        for subscription in self._subscriptions.values():
            subscription.close(STOPPED)
        end_s = time.monotonic() + STOP_S
        for subscription in self._subscriptions.values():
            subscription.join(end_s)
        for thread in threads:
            if thread.ident is not None:
                thread.join(max(0.0, end_s - time.monotonic()))
        self._memory.save()
        if self._node is not None:
            if not self._failures and not any(thread.is_alive() for thread in threads):
                self._unregister(time.monotonic() + STOP_S)
            self._node.close()

    def _unregister(self, end_s: float) -> None:
        """Unregister all topics, unless the master is slow to answer."""
        master = RosMaster(replace(self._settings, timeout_s=STOP_S))
        with suppress(RosError):  # a registration that stays does no harm, the next run uses it
            for topic in sorted(self._registered):
                if time.monotonic() < end_s:
                    master.unsubscribe(topic, self._own_uri)
        master.close()
