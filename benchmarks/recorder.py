"""The whole recorder: sockets to disk, its share of the machine, and how soon a follower hears."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.store import is_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.types import Batch
from benchmarks.common import Row, percentile
from benchmarks.ros_sockets import ODOMETRY_BYTES, publishing, topics

SECONDS = 10.0
SOCKETS = 8
TICKS = os.sysconf("SC_CLK_TCK")


def measure() -> list[Row]:
    """Measure with the ROS source at a robot's pace and beyond, then the latency over ZMQ."""
    rows = _share("400 messages/s", 400)
    rows += _share("20,000 messages/s", 20_000)
    rows += _share("40,000 messages/s, ten to a packet", 40_000, burst=10)
    return rows + _latency()


def _share(name: str, rate_hz: float, burst: int = 1) -> list[Row]:
    publishers = publishing(SOCKETS, rate_hz, ODOMETRY_BYTES, burst)
    with tempfile.TemporaryDirectory() as folder, publishers as u:
        listed = "".join(f"\n    - topic: {{name: {topic}}}" for topic in topics(SOCKETS))
        robot = robot_folder(
            Path(folder), f"- ros:\n    ros_master_uri: {u}\n    topics:{listed}\n"
        )
        with recording(robot) as process:
            time.sleep(2.0)
            before, start = cpu_ticks(process.pid), time.monotonic()
            time.sleep(SECONDS)
            used_s = (cpu_ticks(process.pid) - before) / TICKS
            share = used_s / (time.monotonic() - start)
            memory = rss_bytes(process.pid)
        kept, dropped = totals(robot / "store")
    return [
        Row(f"{name}: recorded", kept / (SECONDS + 2.0), "messages/s", note=f"{dropped} dropped"),
        Row(f"{name}: CPU", 100 * share, "% of a core"),
        Row(f"{name}: memory", memory / 1e6, "MB RSS"),
    ]


def _latency() -> list[Row]:
    """Time from a publisher's send to a follower's hands, both in this process."""
    import zmq

    with tempfile.TemporaryDirectory() as folder:
        context = zmq.Context()
        socket = context.socket(zmq.PUB)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        robot = robot_folder(
            Path(folder),
            f"- zmq:\n    endpoint: tcp://127.0.0.1:{port}\n    topics: [{{name: t}}]\n",
        )
        stop = threading.Event()
        sender = threading.Thread(target=_send, args=(socket, stop))
        with recording(robot):
            sender.start()
            delays = _delays_ms(robot, stop)
        sender.join()
        socket.close()
        context.term()
    note = "write_s 0.1, 100 messages/s"
    return [
        Row("bus to follow, median", percentile(delays, 50), "ms", note=note),
        Row("bus to follow, p95", percentile(delays, 95), "ms", note=note),
    ]


def _send(socket: object, stop: threading.Event) -> None:
    while not stop.wait(0.01):
        socket.send_multipart([b"t", b'{"t":%d}' % time.time_ns()])  # type: ignore[attr-defined]  # zmq is imported late


def _delays_ms(robot: Path, stop: threading.Event) -> list[float]:
    delays: list[float] = []
    end = time.monotonic() + SECONDS
    for delivery in follow(robot / "store", ["zmq_t"], stop=stop):
        now_ns = time.time_ns()
        if isinstance(delivery, Batch):
            delays += [(now_ns - sent) / 1e6 for sent in np.asarray(delivery.columns["t"]).tolist()]
        if time.monotonic() > end:
            stop.set()
    return delays[50:]


def robot_folder(place: Path, blocks: str) -> Path:
    """Write a robot folder."""
    (place / "robot.yaml").write_text("id: bench\n")
    (place / "black_box.yaml").write_text(blocks)
    return place


@contextmanager
def recording(robot: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``amberbox record`` as a user does, until the block is left."""
    process = subprocess.Popen([sys.executable, "-m", "amberbox", "record", str(robot), "--quiet"])
    while not (is_store(robot / "store") and list((robot / "store" / "journal").glob("*.mcap"))):
        time.sleep(0.02)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def cpu_ticks(pid: int) -> int:
    """CPU time of a process, user and system, in clock ticks."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def rss_bytes(pid: int) -> int:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def totals(store: Path) -> tuple[int, int]:
    """Count what was kept and what was dropped, by the last counters of each item."""
    kept: dict[str, int] = {}
    dropped: dict[str, int] = {}
    for batch in journal_reader.batches(store, ["amberbox_counters"]):
        rows = batch.children["items"].columns
        names = np.asarray(rows["item"]).tolist()
        kept.update(zip(names, np.asarray(rows["kept"]).tolist(), strict=True))
        dropped.update(zip(names, np.asarray(rows["dropped"]).tolist(), strict=True))
    return sum(kept.values()), sum(dropped.values())
