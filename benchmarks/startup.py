"""How soon the recorder records: from the start of the process to the first byte on the disk.

The target is 3 s. The store is new, or holds a day's end that was cut off by ``kill -9``.
"""

from __future__ import annotations

import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from os import environ
from pathlib import Path

from amberbox.blackbox.store.store import is_locked, open_store
from benchmarks.common import Row
from benchmarks.recorder import robot_folder

REPEATS = 7
BLOCKS = {
    "sim": "- sim:\n    topics: [{name: odom}]\n",
    "zmq": "- zmq:\n    endpoint: tcp://127.0.0.1:5999\n    topics: [{name: t}]\n",
}
_PATIENCE_S = 30.0
_CUT_OFF_S = 10.0


def measure() -> list[Row]:
    """Measure new stores per source, one that was cut off, and systemd's READY."""
    note = "target: 3"
    rows = []
    for name, block in BLOCKS.items():
        seconds = [_new_store(block) for _ in range(REPEATS)]
        median = statistics.median(seconds)
        rows.append(Row(f"{name}: exec to first byte", median, "s", note=note))
        rows.append(Row(f"{name}: exec to first byte, worst", max(seconds), "s", note=note))
    seconds, ready = _after_kill()
    note = f"after kill -9 with {_CUT_OFF_S:.0f} s of a simulated robot"
    rows.append(Row("sim: exec to first byte again", statistics.median(seconds), "s", note=note))
    return [*rows, Row("sim: exec to READY=1", statistics.median(ready), "s", note=note)]


def _new_store(block: str) -> float:
    with tempfile.TemporaryDirectory() as place:
        robot = robot_folder(Path(place), block)
        with _recording(robot) as (process, began):
            first_s = _first_byte(robot, set(), process, began)
            process.send_signal(signal.SIGTERM)
        return first_s


def _after_kill() -> tuple[list[float], list[float]]:
    """Kill a recorder, start it again on what it left; again and again on the same store."""
    firsts, readies = [], []
    with tempfile.TemporaryDirectory() as place:
        robot = robot_folder(Path(place), "- sim:\n    seed: 1\n")
        with _recording(robot) as (process, _):
            time.sleep(_CUT_OFF_S)
            process.kill()
        for _ in range(REPEATS):
            first_s, ready_s = _again(robot)
            firsts.append(first_s)
            readies.append(ready_s)
        while is_locked(open_store(robot / "store"), "keeper"):  # it ends when it is alone
            time.sleep(0.1)
    return firsts, readies


def _again(robot: Path) -> tuple[float, float]:
    address = str(robot / "notify")
    known = set(_journals(robot))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(_PATIENCE_S)
        with _recording(robot, NOTIFY_SOCKET=address) as (process, began):
            first_s = _first_byte(robot, known, process, began)
            assert manager.recv(200) == b"READY=1"
            ready_s = time.monotonic() - began
            process.kill()
    Path(address).unlink()
    return first_s, ready_s


@contextmanager
def _recording(robot: Path, **more: str) -> Iterator[tuple[subprocess.Popen[bytes], float]]:
    command = [sys.executable, "-m", "amberbox", "record", str(robot), "--quiet"]
    began = time.monotonic()
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env={**environ, **more})
    try:
        yield process, began
    finally:
        process.wait(_PATIENCE_S)


def _first_byte(
    robot: Path, known: set[Path], process: subprocess.Popen[bytes], began: float
) -> float:
    while not any(_size(path) for path in _journals(robot) if path not in known):
        assert process.poll() is None, "the recorder has ended"
        assert time.monotonic() - began < _PATIENCE_S, "the recorder writes nothing"
        time.sleep(0.002)
    return time.monotonic() - began


def _journals(robot: Path) -> list[Path]:
    return list((robot / "store" / "journal").glob("*.mcap"))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:36} {row.value:8.3f} {row.unit}")
