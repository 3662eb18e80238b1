"""What the box remembers of publishers across its own restarts.

A master that was restarted does not know the publishers that are still alive; their last known
addresses do. The digest of what each one latched tells a repeated delivery from a new message.
"""

from __future__ import annotations

import threading
from typing import Any

from amberbox.core.source import Sink

MOST_PER_TOPIC = 8
MOST_TOPICS = 4096
SAVE_EVERY_S = 0.2

Table = dict[str, dict[str, str]]


class Memory:
    """Node addresses and latched digests per topic and node, and the node server's port."""

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
        self._dead: set[str] = set()

    def topics(self) -> list[str]:
        """Return the topics that had a publisher when they were last heard."""
        with self._lock:
            return [topic for topic, nodes in self._uris.items() if nodes]

    def nodes(self, topic: str) -> dict[str, str]:
        """Return the nodes that published a topic, and where each one was."""
        with self._lock:
            return dict(self._uris.get(topic, {}))

    def uris(self, topic: str) -> list[str]:
        """Return the addresses at which a topic was published when it was last heard."""
        with self._lock:
            return list(self._uris.get(topic, {}).values())

    def knows(self, topic: str, node: str, uri: str) -> bool:
        """Tell whether this very process of a node has been connected before."""
        with self._lock:
            return self._uris.get(topic, {}).get(node) == uri

    def remember(self, topic: str, node: str, uri: str) -> None:
        """Keep where a node is."""
        with self._lock:
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

    def bury(self, uri: str) -> None:
        """Leave an address at which no process listens out of what the next run is told."""
        with self._lock:
            if uri not in self._dead:
                self._dead.add(uri)
                self._touch()

    def forget(self, topic: str, uri: str) -> None:
        """Drop an address that is known to publish the topic no more."""
        with self._lock:
            nodes = self._uris.get(topic, {})
            for node in [node for node, at in nodes.items() if at == uri]:
                del nodes[node]
                self._latched.get(topic, {}).pop(node, None)
                self._touch()

    def latched(self, topic: str, node: str) -> str | None:
        """Return the digest of what a node latched last."""
        with self._lock:
            return self._latched.get(topic, {}).get(node)

    def latch(self, topic: str, node: str, digest: str) -> None:
        """Keep the digest of what a node latched."""
        with self._lock:
            self._latched.setdefault(topic, {})[node] = digest
            self._touch()

    def use_port(self, port: int) -> None:
        """Keep the node server's port, for the same address after a restart."""
        with self._lock:
            if port != self.port:
                self.port = port
                self._touch()

    def keep_saving(self) -> None:
        """Save what changed at once, then again after a while; for a thread of its own.

        The store may make it wait; nobody who reads from a socket does.
        """
        while self._news.wait() and not self._ended.is_set():
            self._news.clear()
            self.save()
            self._ended.wait(SAVE_EVERY_S)

    def end_saving(self) -> None:
        """Let ``keep_saving`` return."""
        self._ended.set()
        self._news.set()

    def _touch(self) -> None:
        self._changed = True
        self._news.set()

    def save(self) -> None:
        """Hand what changed to the store."""
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
            return {"port": self.port, "publishers": publishers, "latched": latched}


def _table(saved: Any) -> Table:
    if not isinstance(saved, dict):
        return {}
    return {str(t): {str(n): str(v) for n, v in nodes.items()} for t, nodes in saved.items()}
