"""Whether a ROS 1 master answers, and how fast."""

from __future__ import annotations

import time

from amberbox.blackbox.sources.ros1.master import RosNoAnswerError
from amberbox.core.probe import Measured
from amberbox.monitoring.probes._ros import master_of, settings_for

MEASURES = {
    "latency_ms": ("float", "ms", "until the answer was there"),
    "topics": ("int", "", "topics that somebody publishes"),
}
SUBJECT = "HOST or HOST:PORT of the master, such as robot:11311; default: what ROS_MASTER_URI says"
PERIOD_S = 2.0


def measure(subject: str) -> Measured:
    """Request the state of the system from the master."""
    settings = settings_for("" if subject == "default" else subject)
    begin_s = time.monotonic()
    try:
        with master_of(settings) as master:
            graph = master.graph()
    except RosNoAnswerError as error:
        return {"ok": False, "error": error.what}
    latency_ms = (time.monotonic() - begin_s) * 1e3
    return {"ok": True, "latency_ms": latency_ms, "topics": len(graph.publishers)}
