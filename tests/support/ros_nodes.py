"""Runs a real ROS 1 master and nodes as child processes, and compares a record with their truth
files.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import xmlrpc.client
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink

PYTHON = "/usr/bin/python3"
PACKAGES = ("rospy", "rosmaster", "nav_msgs", "sensor_msgs", "std_msgs", "rosgraph_msgs")


def missing_ros(packages: Sequence[str] = PACKAGES) -> str:
    """Return why no ROS can be run here, empty if it can."""
    code = f"import {', '.join(packages)}"
    try:
        done = subprocess.run([PYTHON, "-c", code], env=ros_environment(0), capture_output=True)
    except OSError as error:
        return f"no {PYTHON}: {error}"
    return done.stderr.decode().strip().rpartition("\n")[2]


def ros_environment(port: int) -> dict[str, str]:
    """Return a clean environment that keeps ROS on the loopback interface."""
    home = os.environ.get("HOME", "/")
    uri = f"http://127.0.0.1:{port}"
    return {"PATH": "/usr/bin:/bin", "HOME": home, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1"}


@dataclass
class Processes:
    """Child processes of a test; all are ended when the ``with`` block is left."""

    log: Path
    running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self.running:
            end(process, signal.SIGKILL)

    def start(self, command: Sequence[str], port: int) -> subprocess.Popen[bytes]:
        """Start a command that uses the master on ``port``."""
        with self.log.open("ab") as log:
            environment = {**ros_environment(port), "ROS_LOG_DIR": str(self.log.parent)}
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        self.running.append(process)
        return process

    def output(self, command: Sequence[str], port: int) -> str:
        """Run a ROS tool to its end and return its output."""
        return subprocess.run(
            command, env=ros_environment(port), capture_output=True, text=True, check=True
        ).stdout

    def master(self, port: int) -> subprocess.Popen[bytes]:
        """Start a master and wait until it answers."""
        process = self.start(["/usr/bin/rosmaster", "--core", "-p", str(port)], port)
        wait_until(lambda: answers(port), "the ROS master answers")
        return process


@dataclass
class Ros:
    """A place to run a master and robots in; every robot keeps a truth file of its own."""

    processes: Processes
    port: int
    folder: Path
    script: Path
    robots: int = 0

    @property
    def uri(self) -> str:
        """The master's address."""
        return f"http://127.0.0.1:{self.port}"

    def master(self) -> subprocess.Popen[bytes]:
        """Start a master, and wait for it."""
        return self.processes.master(self.port)

    def robot(self, *options: str) -> subprocess.Popen[bytes]:
        """Start the test robot; its options are described at the top of the script."""
        self.robots += 1
        truth = self.folder / f"truth-{self.robots}.jsonl"
        command = [PYTHON, str(self.script), "--truth", str(truth), *options]
        return self.processes.start(command, self.port)

    def truths(self) -> list[Path]:
        """Return the truth files of all robots so far."""
        return sorted(self.folder.glob("truth-*.jsonl"))

    def published(self) -> dict[str, list[Published]]:
        """Return what all robots have published, per topic and in order."""
        return published(self.truths())


def end(process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> None:
    """Send a signal and wait for the end. (A roscore in the background ignores SIGINT.)"""
    if process.poll() is None:
        process.send_signal(number)
        process.wait(PATIENCE_S)


def answers(port: int) -> bool:
    """Return whether a ROS master answers on a local port."""
    try:
        system_state(port)
    except (OSError, xmlrpc.client.Error):
        return False
    return True


def system_state(port: int) -> Any:
    """Return publishers, subscribers and services from the master."""
    proxy: Any = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{port}")
    return proxy.getSystemState("/test")[2]


@dataclass(frozen=True)
class Published:
    """One message by the publisher's own account."""

    topic: str
    n: int
    wall_ns: int
    body: str


def read_truth(path: Path) -> list[dict[str, Any]]:
    """Read a robot's truth file, without a last line that was cut by ``kill -9``."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def published(paths: Iterable[Path]) -> dict[str, list[Published]]:
    """Return the messages that robots published, per topic and in order."""
    topics: dict[str, list[Published]] = {}
    for entry in (entry for path in paths for entry in read_truth(path)):
        if entry["k"] == "pub":
            message = Published(entry["topic"], entry["n"], entry["t"], entry["body"])
            topics.setdefault(message.topic, []).append(message)
    return {topic: sorted(all_, key=lambda m: m.wall_ns) for topic, all_ in topics.items()}


def body_of(data: bytes, has_header: bool) -> str:
    """Identify a message as the truth file does: without ``header.seq``."""
    return hashlib.sha256(data[4:] if has_header else data).hexdigest()[:32]


Interval = tuple[int, int]


@dataclass
class GapSink(MemorySink):
    """A sink in memory that keeps gap intervals per topic as the recorder does."""

    gaps: dict[str, list[Interval]] = field(default_factory=dict)
    open_gaps: dict[tuple[str, str], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.run_from_ns = self.now_ns()

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        super().link_up(topic, peer, since_ns)
        first = topic not in self.gaps
        start_ns = self.open_gaps.pop((topic, peer), self._from_ns(since_ns))
        self.gaps.setdefault(topic, []).append((start_ns, self.now_ns()))
        if first:
            self.gaps[topic].append((self.run_from_ns, self.now_ns()))

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        super().link_down(topic, peer, reason, since_ns)
        self.open_gaps[topic, peer] = self._from_ns(since_ns)

    def _from_ns(self, since_ns: int | None) -> int:
        return self.now_ns() if since_ns is None else max(since_ns, self.run_from_ns)

    def all_gaps(self, topic: str, until_ns: int) -> list[Interval]:
        """Return the gaps of a topic, those still open until the end that is given."""
        still_open = [at for (name, _), at in self.open_gaps.items() if name == topic]
        whole = [] if topic in self.gaps else [self.run_from_ns]
        return self.gaps.get(topic, []) + [(at, until_ns) for at in still_open + whole]


@dataclass(frozen=True)
class Verdict:
    """How a record compares with the truth, for one topic."""

    recorded: int
    missing: int
    unexplained: list[Published]
    unknown: list[str]
    repeated: list[str]
    in_order: bool
    needless: list[Published]
    """Recorded messages that were published well inside a gap."""

    @property
    def is_right(self) -> bool:
        """Return whether all messages are recorded once and in order, or are in a gap."""
        return not (self.unexplained or self.unknown or self.repeated) and self.in_order


def judge(
    truth: Sequence[Published],
    bodies: Sequence[str],
    gaps: Sequence[Interval],
    tolerance_s: float = 0.2,
) -> Verdict:
    """Compare the recorded messages of one topic with the published ones."""
    order = {message.body: at for at, message in enumerate(truth)}
    places = [order[body] for body in bodies if body in order]
    got = set(bodies)
    lost = [message for message in truth if message.body not in got]
    tolerance_ns = round(tolerance_s * 1e9)
    return Verdict(
        recorded=len(bodies),
        missing=len(lost),
        unexplained=[m for m in lost if not _is_in(m.wall_ns, gaps, tolerance_ns)],
        unknown=[body for body in bodies if body not in order],
        repeated=[body for body, count in _counts(bodies).items() if count > 1],
        in_order=places == sorted(places),
        needless=[m for m in truth if m.body in got and _is_in(m.wall_ns, gaps, -tolerance_ns)],
    )


def _is_in(at_ns: int, gaps: Sequence[Interval], tolerance_ns: int) -> bool:
    return any(start - tolerance_ns <= at_ns <= stop + tolerance_ns for start, stop in gaps)


def _counts(bodies: Sequence[str]) -> Mapping[str, int]:
    counts: dict[str, int] = {}
    for body in bodies:
        counts[body] = counts.get(body, 0) + 1
    return counts
