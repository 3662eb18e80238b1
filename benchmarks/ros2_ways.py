"""ROS 2 by each way: robots in another process publish to the box; beside them the ROS 1 source.

Recording to disk is not part of it; the sink only counts. A source with a native library runs in a
process of its own, as under the recorder: both processes count.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from pathlib import Path

from amberbox.blackbox.recorder.source_process import SourceProcess
from amberbox.blackbox.sources import ros2
from amberbox.core.config import build
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import wait_until
from benchmarks.common import Row
from benchmarks.recorder import TICKS, cpu_ticks, rss_bytes
from benchmarks.ros_sockets import ODOMETRY_BYTES, SECONDS, CountingSink, _sockets
from tests.peers.ros2.robot import IMAGE, message
from tests.support.ros2_robots import (
    Ros2Robot,
    Way,
    build_fast_dds,
    missing_fast_dds,
    process_of_source,
    robot_of,
)

RATE_HZ = 5000
QUIET_S = 2.0  # after which nothing more is expected
WAYS: tuple[Way, ...] = ("bridge", "zenoh", "cyclone", "fastdds")
# the picture that makes the whole message as long as those of the ROS 1 source
_PICTURE_BYTES = ODOMETRY_BYTES - len(message(IMAGE, 1, 0))


def measure() -> list[Row]:
    """Measure CPU per message and loss at 5,000 messages/s of 704 B on one topic."""
    rows = _sockets(f"ROS 1: {RATE_HZ} messages/s", 1, RATE_HZ, ODOMETRY_BYTES)
    with tempfile.TemporaryDirectory() as folder:
        has_fast_dds = not missing_fast_dds()
        if has_fast_dds:
            build_fast_dds(Path(folder))
        for way in WAYS:
            if way != "fastdds" or has_fast_dds:
                rows += _way(way)
    return rows


def _way(way: Way) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder, robot_of(way, Path(folder)) as robot:
        robot.offer("/bench", IMAGE)
        sink, stop = CountingSink(), threading.Event()
        source = _source(robot)
        listener = threading.Thread(target=source.run, args=(sink, stop))
        listener.start()
        robot.publish_heard("/bench", 100, size=_PICTURE_BYTES)
        wait_until(lambda: sink.total, f"the first message via {way}")
        before = _until_quiet(sink)
        child = process_of_source() if isinstance(source, SourceProcess) else None
        wall_s, used_s = time.perf_counter(), _used_s(child)
        count = round(RATE_HZ * SECONDS)
        robot.publish("/bench", count, rate_hz=RATE_HZ, size=_PICTURE_BYTES)
        took_s = time.perf_counter() - wall_s
        received = _until_quiet(sink) - before
        used_s = _used_s(child) - used_s
        memory = [] if child is None else [rss_bytes(child)]
        stop.set()
        listener.join()
    name = f"ROS 2 via {way}: {RATE_HZ} messages/s"
    return [
        Row(f"{name}: received", received / took_s, "messages/s"),
        Row(
            f"{name}: lost",
            count - received,
            "messages",
            note=f"of {count}; {sink.missing} counted",
        ),
        *([Row(f"{name}: CPU", used_s / received * 1e6, "us/message CPU")] if received else []),
        *(Row(f"{name}: memory of its process", size / 1e6, "MB RSS") for size in memory),
    ]


def _until_quiet(sink: CountingSink) -> int:
    """Return how many messages there are when no more come."""
    total, since_s = sink.total, time.monotonic()
    while time.monotonic() - since_s < QUIET_S:
        time.sleep(0.05)
        if sink.total != total:
            total, since_s = sink.total, time.monotonic()
    return total


def _source(robot: Ros2Robot) -> ros2.Source | SourceProcess:
    """Return the source as the recorder runs it."""
    block = robot.block(topics=[{"name": "/bench"}])
    node = parse_yaml(json.dumps(block), "black_box.yaml", [])
    assert node is not None
    config = build(ros2.Config, node, [], "ros2")
    assert config is not None
    if not ros2.needs_process(config):
        return ros2.Source(config, "ros2")
    return SourceProcess(ros2.__name__, "ros2", "ros2", node, Path())


def _used_s(child: int | None) -> float:
    """Return the processor time of this process and of that of the source, in seconds."""
    return time.process_time() + (0.0 if child is None else cpu_ticks(child) / TICKS)
