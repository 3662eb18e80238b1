"""The contract of a way to a ROS 2 robot."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Collection
from typing import Any, Protocol

from amberbox.blackbox.sources.ros2_transports.options import Ros2Options, missing_package
from amberbox.core.errors import AmberboxError
from amberbox.core.robot_graph import RobotGraph
from amberbox.core.source import Sink


class Transport(Protocol):
    """One way to a robot; made for one run. Nothing is opened before ``run``."""

    def __init__(self, options: Ros2Options) -> None: ...

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set; as ``core.source.Source.run``."""

    def read_graph(self, wait_s: float) -> RobotGraph:
        """Return what runs on the robot, collected for at most ``wait_s`` seconds.

        Raises AmberboxError if the robot cannot be reached.
        """

    def follow_nodes(self, tell: Callable[[Collection[str]], None], stop: threading.Event) -> None:
        """Call ``tell`` with the nodes that run, at least once a second, until ``stop`` is set.

        Raises AmberboxError if the robot cannot be reached, or not any more.
        """


def transport(options: Ros2Options) -> Transport:
    """Make the way that a block names; raises AmberboxError where its package is missing."""
    missing = missing_package(options.via)
    if missing:
        raise AmberboxError(f"ros2 via {options.via} cannot run", missing)
    module: Any = importlib.import_module(f"{__package__}.{options.via}")
    made: Transport = module.Transport(options)
    return made
