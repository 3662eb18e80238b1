"""A sink that keeps in memory what a source says, for tests of sources."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from amberbox.core.source import Power
from amberbox.core.types import Topic
from amberbox.testing.patience import PATIENCE_S


@dataclass
class MemorySink:
    """Keeps topics, messages, links and events in the order they came."""

    topics: list[Topic] = field(default_factory=list)
    messages: list[tuple[int, bytes, int]] = field(default_factory=list)
    links: list[tuple[str, str, str, str, int]] = field(default_factory=list)
    """(``up`` or ``down``, topic, peer, reason, time in ns)"""
    events: list[tuple[str, str, Mapping[str, Any]]] = field(default_factory=list)
    latched: dict[str, bytes] = field(default_factory=dict)
    saved: dict[str, Any] = field(default_factory=dict)
    powers: list[tuple[Power, str]] = field(default_factory=list)
    longest_bytes: int = 64_000_000
    losses: list[tuple[str, str, int, int, int, str]] = field(default_factory=list)
    """(topic, peer, from and to in ns, how many, reason)"""

    def __post_init__(self) -> None:
        self._lock = threading.Condition(threading.RLock())

    def now_ns(self) -> int:
        return time.time_ns()

    def topic(self, topic: Topic) -> int:
        with self._lock:
            if topic not in self.topics:
                self.topics.append(topic)
            return self.topics.index(topic)

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        with self._lock:
            self.messages.append((stream, data, received_ns))
            if self.topics[stream].latched:
                self.latched[self.topics[stream].name] = data
            self._lock.notify_all()

    def longest_message(self) -> int:
        return self.longest_bytes

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        self._note_link("up", topic, peer, "", since_ns or self.now_ns())

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        self._note_link("down", topic, peer, reason, since_ns or self.now_ns())

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        with self._lock:
            self.losses.append((topic, peer, from_ns, to_ns, count, reason))
            self._lock.notify_all()

    def event(self, kind: str, text: str, **details: Any) -> None:
        with self._lock:
            self.events.append((kind, text, details))
            self._lock.notify_all()

    def power(self, state: Power, text: str) -> None:
        with self._lock:
            self.powers.append((state, text))
            self._lock.notify_all()

    def last_latched(self, topic: str) -> bytes | None:
        return self.latched.get(topic)

    def state(self) -> dict[str, Any]:
        return dict(self.saved)

    def save_state(self, state: Mapping[str, Any]) -> None:
        self.saved = dict(state)

    def of(self, topic: str) -> list[bytes]:
        """Return the messages of one topic in order."""
        with self._lock:
            return [data for s, data, _ in self.messages if self.topics[s].name == topic]

    def wait_for(self, topic: str, count: int, timeout_s: float = PATIENCE_S) -> list[bytes]:
        """Wait until a topic has that many messages; raise TimeoutError if it never does."""
        with self._lock:
            if not self._lock.wait_for(lambda: len(self._of(topic)) >= count, timeout_s):
                raise TimeoutError(f"{topic}: {len(self._of(topic))} of {count} messages")
        return self.of(topic)

    def _of(self, topic: str) -> list[bytes]:
        return [data for s, data, _ in self.messages if self.topics[s].name == topic]

    def _note_link(self, way: str, topic: str, peer: str, reason: str, at_ns: int) -> None:
        with self._lock:
            self.links.append((way, topic, peer, reason, at_ns))
            self._lock.notify_all()
