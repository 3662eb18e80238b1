"""What runs on a robot at one moment: nodes, and who publishes, subscribes and serves what."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GraphTopic:
    """A topic, its type (``nav_msgs/msg/Odometry``; empty if unknown) and the nodes at its ends."""

    name: str
    type: str = ""
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class GraphService:
    """A service, its type and the node that offers it; both may be unknown and empty."""

    name: str
    type: str = ""
    node: str = ""


@dataclass(frozen=True, slots=True)
class RobotGraph:
    """The nodes, topics and services that were there, sorted by name.

    A node is named in full, with its namespace; where a bus has no nodes it is the name of the
    process or of the connection, and may be missing. Actions are the topics and services that their
    protocol consists of.
    """

    nodes: tuple[str, ...] = ()
    topics: tuple[GraphTopic, ...] = ()
    services: tuple[GraphService, ...] = ()
