"""ROS 2: topics of a robot over DDS, over Zenoh, or over a Foxglove bridge that runs on it."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from amberbox.blackbox.sources.ros2_transports.options import (
    Ros2Options,
    address_of,
    keys_of_address,
)
from amberbox.blackbox.sources.ros2_transports.transport import transport
from amberbox.core.robot_graph import RobotGraph
from amberbox.core.source import Sink, TopicOptions

SAMPLE = """\
- ros2:
    via: bridge
    url: ws://localhost:8765
    topics:
      - topic:
          name: /odom
          variable_names: [pose/pose/position/x, pose/pose/position/y]
          max_frequency: 10
      - topic: {name: /scan}
"""
PASSIVE = "subscribes only, {config.seen_as}"

LATE_S = 5.0
Config = Ros2Options


class Ros2Source:
    """A subscriber of a ROS 2 robot; records message bytes unchanged."""

    lossless = False

    def __init__(self, config: Ros2Options, name: str) -> None:
        self._config = config
        self._name = name
        # after a stall, times of receipt follow from the time stamps of DDS
        self.late_s = LATE_S if config.via == "dds" else 0.0

    def topics(self) -> Sequence[TopicOptions]:
        """Return the topics configured, with the leading slash that ROS gives them."""
        return self._config.announced_topics()

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; robot and network may come and go."""
        transport(self._config).run(sink, stop)


Source = Ros2Source


def needs_process(config: Ros2Options) -> bool:
    """Return whether a native library is loaded."""
    return config.via in ("dds", "zenoh")


keys_of = keys_of_address


def service_of(config: Ros2Options, node: str) -> tuple[str, str] | None:
    """Return the kind and the input of a ``service`` that looks for a node in the graph.

    None where the address does not say all, as with a certificate; nothing knows all nodes.
    """
    address = address_of(config)
    return ("ros2_node", f"{node}@{address}") if node and address else None


def read_graph(config: Ros2Options, wait_s: float) -> RobotGraph:
    """Return the nodes, topics and services that run now, collected for at most ``wait_s``."""
    return transport(config).read_graph(wait_s)
