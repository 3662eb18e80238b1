"""Two network namespaces joined by one cable, and code that runs in one of them (root only)."""

from __future__ import annotations

import ctypes
import os
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TypeVar

from amberbox.core.source import Sink, Source, TopicOptions

T = TypeVar("T")

BOX, ROBOT = "10.213.9.1", "10.213.9.2"

_CLONE_NEWNET = 0x40000000
_numbers = count()


def ip(*words: str) -> None:
    """Run ``ip``; raise CalledProcessError if it fails."""
    subprocess.run(["ip", *words], check=True)


@dataclass(frozen=True)
class Cable:
    """The namespaces at both ends, whose interfaces are called ``near`` and ``far``."""

    box: str
    robot: str

    def plug(self, state: str) -> None:
        """Set the robot's end ``up`` or ``down``."""
        ip("-n", self.robot, "link", "set", "far", state)


@contextmanager
def cable() -> Iterator[Cable]:
    """Make a network for the box and one for a robot; they vanish behind the block."""
    number = next(_numbers)
    made = Cable(f"ambox{os.getpid()}-{number}", f"amrob{os.getpid()}-{number}")
    names = (made.box, made.robot)
    try:
        for name in names:
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip("link", "add", "near", "netns", made.box, "type", "veth",
           "peer", "name", "far", "netns", made.robot)  # fmt: skip
        for name, device, address in zip(names, ("near", "far"), (BOX, ROBOT), strict=True):
            ip("-n", name, "addr", "add", f"{address}/24", "dev", device)
            ip("-n", name, "link", "set", device, "up")
        yield made
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "del", name], check=False)


def enter(namespace: str) -> None:
    """Move this thread, and those that it starts, to a namespace."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/run/netns", namespace).open() as file:
        if libc.setns(file.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"setns {namespace}")


def within(namespace: str, function: Callable[[], T]) -> T:
    """Call a function in a namespace; return what it returns."""
    results: list[T] = []

    def call() -> None:
        enter(namespace)
        results.append(function())

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    return results[0]


@dataclass
class SourceWithin:
    """A source that runs in a namespace."""

    source: Source
    namespace: str

    def __post_init__(self) -> None:
        self.lossless = self.source.lossless

    def topics(self) -> Sequence[TopicOptions]:
        return self.source.topics()

    def run(self, sink: Sink, stop: threading.Event) -> None:
        enter(self.namespace)
        self.source.run(sink, stop)
