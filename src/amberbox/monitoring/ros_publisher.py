"""Publishes statuses as a ROS 1 node: registered at the master, one topic of diagnostics."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import NodeSettings, RosError, chosen_master
from amberbox.blackbox.sources.ros1.message_type import message_type
from amberbox.blackbox.sources.ros1.node import RosNode
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic
from amberbox.monitoring.background_sender import Message

TYPE = "diagnostic_msgs/DiagnosticArray"
_CALL_S = 3.0
_QUEUE = 10


class RosPublisher:
    """One connection to a master; ``uri`` is as in ``publish:``, empty for ROS_MASTER_URI."""

    def __init__(self, uri: str, topic: str, robot: str, stopped: Callable[[], bool]) -> None:
        self._topic = topic
        self._kind = message_type(TYPE)
        self._stopped = stopped
        self._sent = 0
        name = f"/amberbox_status_{re.sub('[^A-Za-z0-9_]', '_', robot)}"
        settings = NodeSettings(
            chosen_master(uri.removeprefix("ros://"), os.environ), name, timeout_s=_CALL_S
        )
        self._node = RosNode(settings, self._deadline())
        try:
            self._node.advertise(
                OfferedTopic(topic, TYPE, self._kind, queue=_QUEUE), self._deadline()
            )
        except BaseException:
            self._node.close()
            raise

    def _deadline(self) -> Deadline:
        return Deadline.within(_CALL_S, self._stopped)

    def send(self, message: Message) -> None:
        """Queue an array for every subscriber; raises RosError if the node was shut down."""
        self._sent += 1
        header = {**message["header"], "seq": self._sent}
        data = self._kind.encode({**message, "header": header}, time.time_ns())
        self._node.publish(self._topic, data)

    def check(self) -> None:
        """Raise RosError when the master does not answer, or no longer lists the node."""
        graph = self._node.graph(self._deadline())
        if self._node.settings.caller_id not in graph.publishers.get(self._topic, ()):
            raise RosError("the master has forgotten the node: it was started anew")

    def dropped(self) -> int:
        """Return how many messages slow subscribers have lost."""
        return self._node.dropped

    def close(self) -> None:
        """Unregister."""
        self._node.close()
