"""Says what goes wrong on the ROS network, each thing once until it is right again."""

from __future__ import annotations

import socket
import threading
from collections.abc import Collection, Mapping
from typing import Any

from amberbox.blackbox.ros1.settings import RefusedError, RosError
from amberbox.blackbox.ros1.tcpros import Publisher
from amberbox.blackbox.ros1.xmlrpc import host_of
from amberbox.core.config import did_you_mean
from amberbox.core.source import Sink

PATIENCE = 4  # failed attempts before a publisher that does not answer is worth an event
MOST_NAMES = 12
LONGEST_TEXT = 500


class Reports:
    """Events of one run; safe to call from any thread."""

    def __init__(self, sink: Sink, configured_types: Mapping[str, str]) -> None:
        self.failure: Exception | None = None
        self._sink = sink
        self._configured_types = configured_types
        self._lock = threading.Lock()
        self._said: set[tuple[str, ...]] = set()
        self._md5sums: dict[str, str] = {}

    def _say(self, kind: str, text: str, **details: Any) -> None:
        """Record an event; what others on the network wrote is kept to one line."""
        self._sink.event(kind, " ".join(text.split())[:LONGEST_TEXT], **details)

    def once(self, key: tuple[str, ...], kind: str, text: str, **details: Any) -> None:
        """Record an event unless ``key`` has been reported and not been cleared."""
        with self._lock:
            is_news = key not in self._said
            self._said.add(key)
        if is_news:
            self._say(kind, text, **details)

    def clear(self, *key: str) -> bool:
        """Let what starts with ``key`` be reported again; tell whether it had been."""
        with self._lock:
            old = {said for said in self._said if said[: len(key)] == key}
            self._said -= old
        return bool(old)

    def crashed(self, error: Exception) -> None:
        """Keep the first error of ours."""
        self.failure = self.failure or error

    def master_lost(self, uri: str, error: RosError) -> None:
        """The master does not answer."""
        text = f"the ROS master does not answer ({error.what}); open connections go on"
        self.once(("master",), "ros_master_unreachable", text, uri=uri)

    def master_found(self, uri: str) -> None:
        """The master answers."""
        if self.clear("master"):
            self._say("ros_master_back", f"the ROS master answers again: {uri}", uri=uri)

    def forgotten(self, topics: Collection[str]) -> None:
        """The master has lost the registration: another one runs there now."""
        text = f"the ROS master had forgotten the box (restarted?), {len(topics)} topics again"
        self._say("ros_registered_again", text, topics=sorted(topics))

    def told_to_stop(self, reason: str) -> None:
        """Somebody on the network asked the node to shut down."""
        text = f"a ROS node asked the box to shut down, which it does not: {reason}"
        self._say("ros_shutdown_refused", text, reason=reason)

    def unknown_topic(self, topic: str, known: Collection[str]) -> None:
        """Nobody publishes a topic."""
        names = sorted(known)
        more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        listing = ", ".join(names[:MOST_NAMES]) + more if names else "no topics"
        suggestion = did_you_mean(topic, names)
        text = f"no publisher of {topic}{suggestion}; the master knows {listing}"
        self.once(("unknown", topic), "ros_no_publisher", text, topic=topic)

    def connected(self, topic: str, uri: str) -> None:
        """A connection is open: what was wrong with it is right."""
        self.clear("link", topic, uri)
        self.clear("unknown", topic)

    def failed(self, topic: str, uri: str, failures: int, error: RosError) -> None:
        """An attempt to connect failed: a refusal counts at once, silence after a while."""
        is_unknown_host = isinstance(error.__cause__, socket.gaierror)
        is_refusal = isinstance(error, RefusedError)
        if failures < PATIENCE and not is_refusal and not is_unknown_host:
            return
        kind = "ros_publisher_refused" if is_refusal else "ros_publisher_silent"
        text = f"{topic}: the publisher at {uri} cannot be heard, tried again: {error.what}"
        hint = f"; give the address of '{host_of(uri)}' under 'hosts:'" if is_unknown_host else ""
        self.once(("link", topic, uri, kind), kind, text + hint, topic=topic, uri=uri)

    def malformed(self, topic: str, uri: str, error: RosError) -> None:
        """A publisher sent what is not TCPROS."""
        hint = f" ({error.hint})" if error.hint else ""
        text = f"{topic}: {uri} sent malformed data: {error.what}{hint}; connecting again"
        self.once(("malformed", topic, uri), "ros_malformed", text, topic=topic, uri=uri)

    def repeated(self, topic: str, node: str) -> None:
        """A latched message was delivered again."""
        text = f"{topic}: {node} delivered its latched message again; recorded once"
        self._say("ros_latched_repeat", text, topic=topic, node=node)

    def definition(self, topic: str, publisher: Publisher) -> None:
        """A publisher told its type: compare with the configured and the last one."""
        wanted = self._configured_types.get(topic, "")
        if wanted not in ("", "*", publisher.type):
            text = f"{topic} is of type {publisher.type}, configured is {wanted}; recorded as it is"
            self.once(("type", topic, publisher.type), "ros_type_differs", text, topic=topic)
        if not publisher.definition:
            text = f"{topic}: {publisher.node} sends no message definition; recorded as bytes"
            self.once(("definition", topic, publisher.node), "ros_no_definition", text, topic=topic)
        self._compare(topic, publisher)

    def _compare(self, topic: str, publisher: Publisher) -> None:
        with self._lock:
            before = self._md5sums.get(topic, publisher.md5sum)
            self._md5sums[topic] = publisher.md5sum
        if before != publisher.md5sum:
            text = f"{topic}: the message definition of {publisher.type} has changed"
            details = {"topic": topic, "before": before, "now": publisher.md5sum}
            self._say("ros_type_changed", text, **details)
