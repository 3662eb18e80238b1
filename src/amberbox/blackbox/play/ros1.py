"""Plays ROS 1 messages into a ROS network, as a node that publishes their topics."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from struct import Struct

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosNoAnswerError,
    chosen_master,
    global_name,
    is_global_name,
)
from amberbox.blackbox.sources.ros1.message_type import MessageType, message_type
from amberbox.blackbox.sources.ros1.node import RosNode
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic, Patience
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Topic

CLOCK = "/clock"
QUEUE = 1000  # messages that wait for a slow subscriber; their size is limited as well
_CONNECTIONS = 800  # one for each topic and subscriber; a process may have 1024 files
_CALL_S = 5.0
_CONNECT_S = 3.0  # longest wait for subscribers that the master lists
_PATIENCE_S = 5.0  # a subscriber that takes nothing for so long is not waited for
_TIME = Struct("<II")
_MOST_NAMED = 8


@dataclass
class RosTarget:
    """A node on the network of one master; ``uri`` is empty for that of ROS_MASTER_URI."""

    uri: str = ""
    with_clock: bool = False
    force: bool = False
    stop: threading.Event = field(default_factory=threading.Event)
    _node: RosNode | None = None
    _kinds: dict[str, MessageType] = field(default_factory=dict)
    _names: dict[Topic, str] = field(default_factory=dict)

    @property
    def node(self) -> RosNode:
        """Return the node that was opened."""
        assert self._node is not None
        return self._node

    def refused(self, topic: Topic) -> str:
        """Return why a topic cannot be played into ROS 1; empty if it can."""
        if topic.message_encoding == "cdr":
            return "messages of ROS 2 (export to a bag converts those that ROS 1 has, too)"
        if topic.message_encoding != "ros1" or topic.schema is None:
            return f"its messages ({topic.message_encoding or 'raw'}) are none of ROS 1"
        name = global_name(topic.name)
        if not is_global_name(name):
            return f"'{name}' is not a name that ROS allows"
        if self.with_clock and name == CLOCK:
            return "--clock publishes the time"
        try:
            kind = message_type(topic.schema.name, topic.schema.data.decode("utf-8", "replace"))
        except AmberboxError as error:
            return error.what
        if self._kinds.setdefault(name, kind).md5sum != kind.md5sum:
            return f"another type or definition than that of the same topic before, {kind.name}"
        return ""

    def open(self, topics: Sequence[Topic]) -> None:
        """Register as the publisher of the topics, and wait for the subscribers that are there.

        Raises UsageError where other nodes publish one of them, unless it is forced.
        """
        settings = NodeSettings(
            chosen_master(self.uri, os.environ), f"/amberbox_play_{os.getpid()}", timeout_s=_CALL_S
        )
        self._names = {topic: global_name(topic.name) for topic in topics}
        latched = {self._names[topic] for topic in topics if topic.latched}
        names = list(dict.fromkeys(self._names.values()))
        offers = [
            OfferedTopic(name, self._kinds[name].name, self._kinds[name], name in latched, QUEUE)
            for name in names
        ]
        if self.with_clock:
            kind = message_type("rosgraph_msgs/Clock")
            offers.append(OfferedTopic(CLOCK, kind.name, kind, queue=QUEUE))
        node = self._node = RosNode(settings, self._within(_CALL_S), _CONNECTIONS)
        try:
            graph = node.graph(self._within(_CALL_S))
        except RosNoAnswerError as error:
            what = f"no ROS master answers: {error.what}"
            raise RosNoAnswerError(what, "start one, or name it: --to ros=http://HOST:11311") from (
                error
            )
        offered = {offer.name for offer in offers}
        taken = {name: nodes for name, nodes in graph.publishers.items() if name in offered}
        if taken and not self.force:
            raise UsageError(_conflict(settings.master_uri, taken), _CONFLICT_HINT)
        for offer in offers:
            node.advertise(offer, self._within(_CALL_S))
        self._wait_for_listed()

    def _wait_for_listed(self) -> None:
        """Wait until the subscribers that the master lists are connected, within limits."""
        within = self._within(_CONNECT_S)
        graph = self.node.graph(self._within(_CALL_S))
        for name in (*dict.fromkeys(self._names.values()), *((CLOCK,) if self.with_clock else ())):
            self.node.wait_for(name, set(graph.subscribers.get(name, ())), 0, within)

    def _within(self, seconds: float) -> Deadline:
        return Deadline.within(seconds, self.stop.is_set)

    @property
    def _patience(self) -> Patience:
        return Patience(_PATIENCE_S, self.stop.is_set)

    def is_heard(self) -> bool:
        """Return whether a node is connected to any topic."""
        if not any(self.node.connected(name) for name in set(self._names.values())):
            return False
        self._wait_for_listed()
        return True

    def send(self, topic: Topic, data: bytes, *, patient: bool) -> int:
        """Send a message to the subscribers; return how many there are."""
        name = self._names[topic]
        if patient:
            self.node.wait_for_room(name, len(data), self._patience)
        return self.node.publish(name, data)

    def set_clock(self, at_ns: int) -> None:
        """Publish the time of the record, if that is wanted."""
        if self.with_clock:
            self.node.publish(CLOCK, _TIME.pack(*divmod(at_ns, NS)))

    def dropped(self) -> int:
        """Return how many messages slow subscribers have lost."""
        return 0 if self._node is None else self._node.dropped

    def close(self) -> None:
        """Wait until the subscribers have taken everything, and unregister."""
        if self._node is None:
            return
        if not self.stop.is_set():
            self._node.finish(self._patience)
        self._node.close()


_CONFLICT_HINT = (
    "stop those nodes, play under other names with --prefix /replay, or, if nothing can move, "
    "use --force"
)


def _conflict(uri: str, taken: dict[str, Sequence[str]]) -> str:
    named = [
        f"{topic[:100]} ({', '.join(node[:100] for node in nodes[:3])})"
        for topic, nodes in taken.items()
    ]
    more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return f"nodes at {uri} publish these topics themselves: {', '.join(named[:_MOST_NAMED])}{more}"
