"""Robots of ROS 2 that tests start, order about, kill and freeze; and what they really sent."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from amberbox.blackbox.sources import ros2
from amberbox.core.source import TopicOptions
from amberbox.testing.contract import ObservedSink, observe, observe_in_process
from tests.peers.ros2.dds_robots import PROGRAM, SOURCE
from tests.support.processes import free_port

Way = Literal["bridge", "zenoh", "cyclone", "fastdds"]
OVER_DDS: tuple[Way, ...] = ("cyclone", "fastdds")


class Ros2Robot:
    """A process of ``tests.peers.ros2.robot``; a new one at the same port can follow.

    Over DDS the port is the number of its domain.
    """

    def __init__(self, way: Way, folder: Path, port: int, **environment: str) -> None:
        self.way = way
        self.port = port
        self.truth = folder / "truth"
        words = [sys.executable, "-m", "tests.peers.ros2.robot", way, self.port, self.truth]
        if "NAMESPACE" in environment:
            words[:0] = ["ip", "netns", "exec", environment["NAMESPACE"]]
        self.process = subprocess.Popen(
            [str(word) for word in words], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, **environment}, start_new_session=True,
        )  # fmt: skip
        assert self._answer() == "ready"

    def order(self, do: str, **more: Any) -> Any:
        """Have the robot do something, and wait until it has."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, **more}) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"the robot has ended with {self.process.wait()}"
        return json.loads(line)

    def offer(self, topic: str, type_name: str, **more: Any) -> None:
        """Advertise a topic."""
        self.order("advertise", topic=topic, type=type_name, **more)

    def publish(self, topics: str | Sequence[str], count: int, **more: Any) -> int:
        """Publish messages; return how many were published on each so far."""
        names = [topics] if isinstance(topics, str) else list(topics)
        return int(self.order("publish", topics=names, count=count, **more))

    def publish_heard(self, topic: str, count: int, **more: Any) -> int:
        """Publish messages once somebody listens."""
        self.order("wait", topics=[topic])
        return self.publish(topic, count, **more)

    def freeze(self) -> None:
        """Stop the process without ending it."""
        os.killpg(self.process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let the process go on."""
        os.killpg(self.process.pid, signal.SIGCONT)

    def kill(self) -> None:
        """End the process at once, as a crash does."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()

    def sent(self, topic: str) -> list[str]:
        """Return the digests of all messages sent on a topic."""
        lines = (line.split(" ") for line in self.truth.read_text().splitlines())
        return [digest for name, _, digest in lines if name == topic]

    def block(self, **more: Any) -> dict[str, Any]:
        """Return the configuration that reaches this robot, or what stands before it."""
        return reach(self.way, self.port, **more)


def reach(way: Way, port: int, **more: Any) -> dict[str, Any]:
    """Return the keys of a block for a robot at a port of this computer."""
    at: dict[str, Any] = {"url": f"ws://127.0.0.1:{port}"} if way == "bridge" else {}
    at |= {"endpoint": f"tcp/127.0.0.1:{port}"} if way == "zenoh" else {}
    if way in OVER_DDS:
        at = {"domain": port, "interface": "lo", "multicast": False}
        return {"via": "dds", **at, **more}
    return {"via": way, **at, **more}


@contextmanager
def robot_of(way: Way, folder: Path, port: int = 0, **environment: str) -> Iterator[Ros2Robot]:
    """Run a robot; it ends with the block."""
    with ExitStack() as stack:
        if not port and way in OVER_DDS:
            port, reserved = own_domain()
            stack.enter_context(reserved)
        robot = Ros2Robot(way, folder, port or free_port(), **environment)
        stack.callback(robot.kill)
        yield robot


def own_domain() -> tuple[int, socket.socket]:
    """Reserve a domain of DDS among all tests of this computer, until the socket is closed."""
    domains = range(1, 101)  # those above have ports that the kernel gives to others
    for domain in random.sample(domains, len(domains)):
        reserved = socket.socket(socket.AF_UNIX)
        try:
            reserved.bind(f"\0amberbox tests: DDS domain {domain}")
        except OSError:
            reserved.close()
        else:
            return domain, reserved
    raise RuntimeError("all domains of DDS are taken")


def recorded(robot: Ros2Robot, *names: str, **more: Any) -> AbstractContextManager[ObservedSink]:
    """Run the source on some topics of a robot, or all, as the recorder does it."""
    block = robot.block(topics=[{"name": name} for name in names], all_topics=not names) | more
    if robot.way == "bridge":
        topics = [TopicOptions(name=name) for name in names]
        return observe(ros2.Source(ros2.Config(**block | {"topics": topics}), "ros2"))
    return observe_in_process(ros2, f"- ros2: {json.dumps(block)}")


def process_of_source() -> int:
    """Return the process that this one has started for a source."""
    found = child_process("source_child")
    assert found, "no source runs in a process of its own"
    return found


def child_process(word: str) -> int:
    """Return a process that this one has started with a word in its command; 0 if there is none."""
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (place / "cmdline").read_bytes()
            parent = (place / "stat").read_text().rpartition(")")[2].split()[1]
            if int(parent) == os.getpid() and word.encode() in words:
                return int(place.name)
    return 0


def missing_fast_dds() -> str:
    """Return why no Fast DDS robot can be built here; empty if one can."""
    if shutil.which("g++") is None:
        return "there is no g++"
    return "" if Path("/usr/include/fastdds").is_dir() else "there is no libfastrtps-dev"


def build_fast_dds(folder: Path) -> None:
    """Compile the Fast DDS robot, which takes some seconds, for the robots started from now on."""
    program = folder / "fastdds_robot"
    words = ["g++", "-std=c++17", "-O1", "-o", str(program), str(SOURCE)]
    words += ["-lfastrtps", "-lfastcdr"]
    subprocess.run(words, check=True, capture_output=True)
    os.environ[PROGRAM] = str(program)


def digests(messages: Sequence[bytes]) -> list[str]:
    """Return the digests of messages as truth files have them."""
    return [hashlib.blake2b(data, digest_size=8).hexdigest() for data in messages]
