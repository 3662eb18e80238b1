"""ROS 1: topics of a robot with a ROS master, message definitions taken from the wire."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.blackbox.sources.ros1.client import RosSubscriber
from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosError,
    RosMaster,
    SubscriberSettings,
    SystemState,
    chosen_master,
    global_name,
    host_and_port,
    is_global_name,
    master_uri,
)
from amberbox.blackbox.sources.ros1.service_client import probe_service
from amberbox.core.options import option
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import SelectionOptions

SAMPLE = """\
- ros:
    ros_master_uri: http://localhost:11311
    topics:
      - topic:
          name: /odom
          variable_names: [pose/pose/position/x, pose/pose/position/y]
          max_frequency: 10
      - topic: {name: /scan}
      - topic: {name: /cam/**, max_frequency: 2}
    exclude: [/cam/**/raw]
"""
PASSIVE = "subscribes only, {config.seen_as}; no publisher, no service, no parameter is written"


@dataclass(frozen=True)
class RosOptions(SelectionOptions):
    """The ``ros`` block."""

    ros_master_uri: str = option("", "the master; ROS_MASTER_URI, else localhost when absent")
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

    @staticmethod
    def is_name(name: str) -> bool:
        """Return whether ROS 1 allows a name."""
        return is_global_name(name)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        yield from super().check()
        if self.ros_master_uri:
            try:
                master_uri(self.ros_master_uri)
            except ValueError as error:
                yield "ros_master_uri", f"{error}; write http://HOST:11311"
        if not is_global_name(global_name(self.caller_id)):
            yield "caller_id", f"'{self.caller_id}' is not a name ROS allows for a node"
        if not 0.05 <= self.poll_s <= 3600:
            yield "poll_s", "must be between 0.05 and 3600 seconds"
        if self.max_message_mb is not None and not 0 < self.max_message_mb <= 4095:
            yield "max_message_mb", "must be above 0, and TCPROS allows 4095 at most"
        if not 4 <= self.dead_after_s <= 86400:
            yield "dead_after_s", "must be between 4 seconds and a day"


Config = RosOptions


class RosSource:
    """A ROS 1 subscriber in pure Python; records message bytes unchanged."""

    lossless = False

    def __init__(self, config: RosOptions, name: str) -> None:
        self._config = config
        self._name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the topics and patterns configured, with the leading slash of ROS."""
        return self._config.announced_topics()

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; master and publishers may start, stop and restart."""
        chosen = settings(self._config, sink.longest_message())
        RosSubscriber(chosen, self._config.selection(), sink).run(stop)


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
        poll_s=config.poll_s,
        tcp_nodelay=config.tcp_nodelay,
        message_limit=longest_message if limit_mb is None else round(limit_mb * 1_000_000),
        dead_after_s=config.dead_after_s,
    )


def keys_of(address: str) -> dict[str, str]:
    """Return the keys of a block for a master: the given one, or that of the environment.

    Raises UsageError if it cannot be one.
    """
    return {"ros_master_uri": chosen_master(address, os.environ)}


def service_of(config: RosOptions, node: str) -> tuple[str, str]:
    """Return the kind and the input of a ``service`` that asks a node, or the master."""
    host, port = host_and_port(chosen_master(config.ros_master_uri, os.environ))
    place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    return ("ros_node", f"{node}@{place}") if node else ("ros_master", place)


def beside_recorder(config: RosOptions) -> RosOptions:
    """Return the configuration of another node: a second one of the same name ends the first."""
    return replace(config, caller_id=f"{global_name(config.caller_id)}_doctor")


_CALL_S = 3.0  # for one call of the master
_SERVICE_S = 1.0  # for one service to answer; then its node is not asked again


def read_graph(config: RosOptions, wait_s: float) -> RobotGraph:
    """Return what the master knows; nodes are asked for the types of their services in turn.

    A service that does not answer within ``wait_s`` has no type; names that ROS does not allow are
    left out. Registers nothing. Raises AmberboxError when the master does not answer.
    """
    deadline = Deadline.within(wait_s)
    asked = replace(settings(config, 0), timeout_s=max(0.1, min(wait_s, _CALL_S)))
    master = RosMaster(asked)
    what = f"the ROS master {asked.master_uri} does not answer"
    state, types = deadline.call(lambda: (master.graph(), master.topic_types()), what)
    master.close()
    state = SystemState(*map(_valid, (state.publishers, state.subscribers, state.services)))
    pairs = (*state.publishers.values(), *state.subscribers.values(), *state.services.values())
    return RobotGraph(
        nodes=tuple(sorted({node for nodes in pairs for node in nodes})),
        topics=tuple(_topics_of(state, types)),
        services=tuple(_services_of(state, asked, deadline)),
    )


def _valid(nodes_by_name: Mapping[str, Sequence[str]]) -> Mapping[str, Sequence[str]]:
    """Return the names and nodes that ROS allows; others come from no ROS node."""
    return {
        name: list(filter(is_global_name, nodes))
        for name, nodes in nodes_by_name.items()
        if is_global_name(name)
    }


def _topics_of(state: SystemState, types: Mapping[str, str]) -> Iterator[GraphTopic]:
    for name in sorted(state.publishers.keys() | state.subscribers.keys()):
        yield GraphTopic(
            name,
            _full_type(types.get(name, ""), "msg"),
            tuple(sorted(state.publishers.get(name, ()))),
            tuple(sorted(state.subscribers.get(name, ()))),
        )


def _services_of(
    state: SystemState, asked: NodeSettings, deadline: Deadline
) -> Iterator[GraphService]:
    silent: set[str] = set()
    for name, nodes in sorted(state.services.items()):
        node, found = next(iter(nodes), ""), ""
        if node not in silent:
            try:
                found = probe_service(
                    name, asked, Deadline.within(min(_SERVICE_S, deadline.left_s()))
                ).type
            except RosError:
                silent.add(node)
        yield GraphService(name, _full_type(found, "srv"), node)


def _full_type(name: str, kind: str) -> str:
    """Return ``nav_msgs/msg/Odometry`` for the type ``nav_msgs/Odometry``; empty if unknown."""
    package, _, own = name.partition("/")
    return f"{package}/{kind}/{own}" if own else ""
