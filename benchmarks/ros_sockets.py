"""ROS 1 sockets: publishers in another process speak TCPROS to the box over several connections.

No ROS is needed: ``tests.support.ros_network`` has a master and publishers. Recording to disk is
not part of it; the sink only counts. Some are also received in a process of its own, as sources
with a native library are; the CPU time is then that of both processes.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from amberbox.blackbox.recorder.source_process import SourceProcess
from amberbox.blackbox.sources.ros1.client import RosSubscriber
from amberbox.blackbox.sources.ros1.master import SubscriberSettings
from amberbox.blackbox.sources.ros1.tcpros import Framer
from amberbox.core.source import Power, TopicOptions
from amberbox.core.topic_selection import TopicSelection
from amberbox.core.types import Topic
from amberbox.core.yaml_nodes import parse_yaml
from benchmarks.common import Row, cpu_s
from tests.support.ros_network import RosMaster, RosPublisher, RosTopic

ODOMETRY_BYTES = 704
IMAGE_BYTES = 920_000
SECONDS = 3.0


Run: TypeAlias = Callable[[str, list[str], "CountingSink", threading.Event], None]


class CountingSink:
    """Takes messages and only counts them, per stream."""

    def __init__(self) -> None:
        self.counts: dict[int, int] = {}
        self.missing = 0  # as the source, or the pipe of its process, counts them
        self._topics: list[Topic] = []

    def now_ns(self) -> int:
        return time.time_ns()

    def topic(self, topic: Topic) -> int:
        self._topics.append(topic)
        self.counts[len(self._topics)] = 0
        return len(self._topics)

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        self.counts[stream] += 1

    def longest_message(self) -> int:
        return 64_000_000

    def complete(self, until_ns: int) -> None:
        pass

    def dropped(self, stream: int, from_ns: int, to_ns: int, count: int) -> None:
        self.missing += count

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        self.missing += count

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        pass

    def link_up_at(self, topic: str, peer: str, at_ns: int, since_ns: int | None) -> None:
        pass

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        pass

    def event(self, kind: str, text: str, **details: Any) -> None:
        pass

    def power(self, state: Power, text: str) -> None:
        pass

    def last_latched(self, topic: str) -> bytes | None:
        return None

    def state(self) -> dict[str, Any]:
        return {}

    def save_state(self, state: Mapping[str, Any]) -> None:
        pass

    @property
    def total(self) -> int:
        return sum(self.counts.values())


@contextmanager
def publishing(sockets: int, rate_hz: float, size: int, burst: int = 1) -> Iterator[str]:
    """Run publishers in a process of their own; give the address of their master.

    Each socket sends ``burst`` messages per ``send``, ``rate_hz`` messages per second in all;
    0 is as fast as it goes.
    """
    options = [str(sockets), str(rate_hz), str(size), str(burst)]
    command = [sys.executable, "-m", "benchmarks.ros_sockets", *options]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None and process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.stdin.close()
        process.terminate()  # a flood may be waiting in a send that nobody reads any more
        process.wait(10)


def topics(sockets: int) -> list[str]:
    """Name one topic per socket."""
    return [f"/bench/{number}" for number in range(sockets)]


def measure() -> list[Row]:
    """Measure framing alone, then sockets: flooded, at a robot's pace, with images."""
    rows = [_framing()]
    rows += _sockets("flooded over 8 sockets", 8, 0, ODOMETRY_BYTES, burst=50)
    rows += _sockets("20,000 messages/s over 8 sockets", 8, 20_000, ODOMETRY_BYTES)
    rows += _sockets("camera images, 0.92 MB at 100/s", 1, 100, IMAGE_BYTES)
    for run in (_run_here, _run_in_process):
        where = "" if run is _run_here else ", in a process of its own"
        rows += _sockets(f"5,000 messages/s{where}", 8, 5000, ODOMETRY_BYTES, run=run)
        rows += _sockets(f"images, 5 MB at 10/s{where}", 1, 10, 5_000_000, run=run)
    return rows


def _framing() -> Row:
    frame = struct.pack("<I", ODOMETRY_BYTES) + bytes(ODOMETRY_BYTES)
    count, data = 90, frame * 90

    def cut() -> None:
        framer = Framer(1 << 30)
        for _ in range(500):
            framer.room()[: len(data)] = data
            framer.received(len(data))

    value = cpu_s(cut) / (500 * count) * 1e6
    return Row("framing in memory, 704 B", value, "us/message CPU")


def _run_here(uri: str, wanted: list[str], sink: CountingSink, stop: threading.Event) -> None:
    chosen = TopicSelection(map(TopicOptions, wanted))
    RosSubscriber(SubscriberSettings(master_uri=uri), chosen, sink).run(stop)


def _run_in_process(uri: str, wanted: list[str], sink: CountingSink, stop: threading.Event) -> None:
    listed = ", ".join(f"{{name: {topic}}}" for topic in wanted)
    node = parse_yaml(f"{{ros_master_uri: '{uri}', topics: [{listed}]}}", "bench", [])
    assert node is not None
    SourceProcess("amberbox.blackbox.sources.ros", "ros", "ros", node, Path()).run(sink, stop)


def _sockets(
    name: str, sockets: int, rate_hz: float, size: int, burst: int = 1, run: Run = _run_here
) -> list[Row]:
    with publishing(sockets, rate_hz, size, burst) as uri:
        sink, stop = CountingSink(), threading.Event()
        thread = threading.Thread(target=run, args=(uri, topics(sockets), sink, stop))
        thread.start()
        while len([count for count in sink.counts.values() if count]) < sockets:
            time.sleep(0.01)
        rate, cpu = _watch(sink)
        stop.set()
        thread.join()
    return [
        Row(f"{name}: received", rate, "messages/s"),
        Row(f"{name}: CPU", cpu / rate * 1e6, "us/message CPU"),
    ]


def _watch(sink: CountingSink) -> tuple[float, float]:
    """Return messages per second, and CPU seconds per second."""
    count, wall_s, used_s = sink.total, time.perf_counter(), _used_s()
    time.sleep(SECONDS)
    took_s = time.perf_counter() - wall_s
    return (sink.total - count) / took_s, (_used_s() - used_s) / took_s


def _used_s() -> float:
    """Return the CPU time of this process, and of those of sources that it runs."""
    used_s = time.process_time()
    for children in Path("/proc/self/task").glob("*/children"):
        for pid in children.read_text().split():
            if "source_child" in Path(f"/proc/{pid}/cmdline").read_text():
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                used_s += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return used_s


def _wait_for_end(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


def publish(sockets: int, rate_hz: float, size: int, burst: int) -> None:
    """Publish until standard input ends; print the master's address first."""
    master = RosMaster()
    offered = {topic: RosTopic() for topic in topics(sockets)}
    publisher = RosPublisher("/bench", offered, master)
    print(master.uri, flush=True)
    ended = threading.Event()
    threading.Thread(target=_wait_for_end, args=(ended,), daemon=True).start()
    for topic in offered:
        publisher.wait_for_subscribers(topic)
    data = (struct.pack("<I", size) + bytes(size)) * burst
    per_send_s = burst / rate_hz if rate_hz else 0.0
    due_s = time.perf_counter()
    while not ended.is_set():
        for topic in offered:
            due_s += per_send_s
            if per_send_s and due_s > time.perf_counter():
                time.sleep(max(0.0, due_s - time.perf_counter()))
            try:
                publisher.send(topic, data)
            except OSError:
                return


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Publish to the box over TCPROS.")
    parser.add_argument("sockets", type=int)
    parser.add_argument("rate_hz", type=float)
    parser.add_argument("size", type=int)
    parser.add_argument("burst", type=int)
    publish(**vars(parser.parse_args()))
