"""Whether somebody publishes a ROS 1 topic, as the master knows it."""

from __future__ import annotations

from amberbox.core.probe import Measured
from amberbox.monitoring.probes._ros import master_of, name_and_settings

MEASURES = {
    "publishers": ("int", "", "nodes that publish it"),
    "subscribers": ("int", "", "nodes that listen to it"),
}
SUBJECT = "the topic, such as /scan_front, or /scan_front@HOST:PORT for another master"
PERIOD_S = 2.0


def measure(subject: str) -> Measured:
    """Query the master; a node that was killed counts until its name is taken again."""
    topic, settings = name_and_settings(subject)
    with master_of(settings) as master:
        graph = master.graph()
    publishers = len(graph.publishers.get(topic, ()))
    subscribers = len(graph.subscribers.get(topic, ()))
    return {"ok": publishers > 0, "publishers": publishers, "subscribers": subscribers}
