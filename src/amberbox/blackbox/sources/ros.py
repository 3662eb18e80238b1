"""ROS 1: topics of a robot with a ROS master, message definitions taken from the wire."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.blackbox.sources.ros1.client import RosSubscriber
from amberbox.blackbox.sources.ros1.master import (
    SubscriberSettings,
    chosen_master,
    global_name,
    is_global_name,
    master_uri,
)
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions

SAMPLE = """\
- ros:
    ros_master_uri: http://localhost:11311
    topics:
      - topic:
          name: /odom
          variable_names: [pose/pose/position/x, pose/pose/position/y]
          max_frequency: 10
      - topic: {name: /scan}
"""
PASSIVE = "subscribes only, {config.seen_as}; no publisher, no service, no parameter is written"


@dataclass(frozen=True)
class RosOptions:
    """The ``ros`` block."""

    ros_master_uri: str = option("", "the master; ROS_MASTER_URI, else localhost when absent")
    topics: Sequence[TopicOptions] = option((), "topics to record, of any type")
    all_topics: bool = option(False, "record every topic the master knows, /rosout excepted")
    invisible: bool = option(False, "find publishers by asking only, never register as a node")
    poll_s: float = option(1.0, "how often the master is asked who publishes", unit="s")
    hosts: Mapping[str, str] = option({}, "addresses of host names that do not resolve here")
    caller_id: str = option("/amberbox", "name of the box as a ROS node; one per box and master")
    advertise: str = option("", "own address for the master; ROS_HOSTNAME, ROS_IP when absent")
    tcp_nodelay: bool = option(True, "ask publishers to send small messages without delay")
    max_message_mb: float | None = option(
        None, "longer messages are taken for garbage; store.queue when absent", unit="MB"
    )
    dead_after_s: float = option(40.0, "a silent peer is probed and given up after", unit="s")

    @property
    def seen_as(self) -> str:
        """Return how the box appears in the robot's ROS."""
        if self.invisible:
            return "not registered at the master"
        return f"registered at the master as node {global_name(self.caller_id)}"

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if self.ros_master_uri:
            try:
                master_uri(self.ros_master_uri)
            except ValueError as error:
                yield "ros_master_uri", f"{error}; write http://HOST:11311"
        if not is_global_name(global_name(self.caller_id)):
            yield "caller_id", f"'{self.caller_id}' is not a name ROS allows for a node"
        yield from self._check_topics()
        if not 0.05 <= self.poll_s <= 3600:
            yield "poll_s", "must be between 0.05 and 3600 seconds"
        if self.max_message_mb is not None and not 0 < self.max_message_mb <= 4095:
            yield "max_message_mb", "must be above 0, and TCPROS allows 4095 at most"
        if not 4 <= self.dead_after_s <= 86400:
            yield "dead_after_s", "must be between 4 seconds and a day"

    def _check_topics(self) -> Iterator[tuple[str, str]]:
        if not self.topics and not self.all_topics:
            yield "topics", "names no topic; list them, or write 'all_topics: true'"
        seen: dict[str, str] = {}
        for name in (topic.name for topic in self.topics):
            whole = global_name(name)
            if not is_global_name(whole):
                yield "topics", f"'{name}' is not a name ROS allows for a topic"
            elif seen.setdefault(whole, name) != name:
                yield "topics", f"'{seen[whole]}' and '{name}' are the same topic"


Config = RosOptions


class RosSource:
    """A ROS 1 subscriber in pure Python; records message bytes unchanged."""

    lossless = False

    def __init__(self, config: RosOptions, name: str) -> None:
        self._config = config
        self._name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the topics configured, with the leading slash that ROS gives them."""
        return [replace(topic, name=global_name(topic.name)) for topic in self._config.topics]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; master and publishers may start, stop and restart."""
        types = {topic.name: topic.type for topic in self.topics()}
        RosSubscriber(settings(self._config, sink.longest_message()), types, sink).run(stop)


Source = RosSource


def settings(config: RosOptions, longest_message: int) -> SubscriberSettings:
    """Complete a configuration from the environment; raise UsageError for a bad master URI.

    ``longest_message`` is the recorder's limit in bytes, used where the configuration sets none.
    """
    limit_mb = config.max_message_mb
    return SubscriberSettings(
        master_uri=chosen_master(config.ros_master_uri, os.environ),
        caller_id=global_name(config.caller_id),
        hosts=config.hosts,
        advertise=config.advertise,
        invisible=config.invisible,
        all_topics=config.all_topics,
        poll_s=config.poll_s,
        tcp_nodelay=config.tcp_nodelay,
        message_limit=longest_message if limit_mb is None else round(limit_mb * 1_000_000),
        dead_after_s=config.dead_after_s,
    )
