"""Whether a node of a ROS 2 robot is there, as its graph says."""

from __future__ import annotations

import threading

from amberbox.blackbox.sources.ros2_transports.names import is_topic_name
from amberbox.blackbox.sources.ros2_transports.node_watch import NodeWatch
from amberbox.blackbox.sources.ros2_transports.options import (
    Ros2Options,
    keys_of_address,
    missing_package,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "age_s": (
        "float",
        "s",
        "since it was last there, as far as this probe has seen; 0 while it is",
    ),
}
SUBJECT = "the node, such as /talker@dds:0, or /talker for a bridge on this computer"
PERIOD_S = 2.0
TIMEOUT_S = 12.0

_WAIT_S = 10.0
_lock = threading.Lock()
_watches: dict[str, NodeWatch] = {}


def measure(subject: str) -> Measured:
    """Look into the graph, which one process for all nodes at an address follows."""
    name, _, address = subject.strip().partition("@")
    node = name if name.startswith("/") else f"/{name}"
    if not is_topic_name(node):
        raise UsageError(f"'{subject}' is no node of ROS 2", "such as /talker@dds:0")
    found = _watch(address).ask(node, _WAIT_S)
    measured: Measured = {"ok": found.is_there, "age_s": found.age_s}
    return {**measured, "error": found.why} if found.why else measured


def close() -> None:
    """End the processes that follow nodes; a further measurement starts them again."""
    with _lock:
        for watch in _watches.values():
            watch.close()
        _watches.clear()


def _watch(address: str) -> NodeWatch:
    with _lock:
        if address not in _watches:
            _watches[address] = _new_watch(address)
        return _watches[address]


def _new_watch(address: str) -> NodeWatch:
    keys = keys_of_address(address)
    options = Ros2Options(**keys, all_topics=True)
    for key, problem in options.check():
        raise UsageError(f"'{address}': {key}: {problem}", "such as /talker@dds:0")
    missing = missing_package(options.via)
    if missing:
        raise AmberboxError(f"ros2 via {options.via} cannot run", missing)
    return NodeWatch(keys)
