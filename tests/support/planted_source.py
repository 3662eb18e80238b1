"""A source that counts, in a process of its own, and dies like a faulty native library.

``planted`` makes it known as a plugin of another package.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pytest

from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Schema, Topic

SAMPLE = "- planted: {after: 3}\n"
PASSIVE = "counts, and asks nothing"
COUNT = Topic("/count", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))

Death = Literal[
    "none", "abort", "segv", "kill", "exit", "error", "frozen", "garbage", "deaf", "children"
]


@dataclass(frozen=True)
class Config:
    """The ``planted`` block."""

    after: int = option(100, "messages of each run")
    death: Death = option("none", "how the first run ends")
    process: bool = option(True, "whether it runs in a process of its own")
    bytes: int = option(8, "length of a message")
    says: str = option("", "what it prints at first")
    every_s: float = option(0.0, "pause between messages", unit="s")
    latched: bool = option(False, "whether its topic is latched")


def needs_process(config: Config) -> bool:
    """Return what the configuration says."""
    return config.process


class Source:
    """Counts on from where its last run said that it had come."""

    lossless = False

    def __init__(self, config: Config, name: str) -> None:
        self._config = config

    def topics(self) -> Sequence[TopicOptions]:
        """Return the one topic."""
        return [TopicOptions(COUNT.name)]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Count, then die if this is the first run, else wait until the end."""
        first = int(sink.state().get("next", 0))
        if self._config.says:
            print(self._config.says, flush=True)
        stream = sink.topic(replace(COUNT, latched=self._config.latched))
        sink.link_up(COUNT.name, "counter")
        sink.save_state({"next": first, "pid": os.getpid()})
        if self._config.latched:
            sink.event("latched", f"the last one was {sink.last_latched(COUNT.name)!r}")
        padding = bytes(self._config.bytes - 8)
        for number in range(first, first + self._config.after):
            data = number.to_bytes(8, "little") + padding
            sink.message(stream, data, sink.now_ns())
            if self._config.every_s and stop.wait(self._config.every_s):
                return
        sink.save_state({"next": first + self._config.after, "pid": os.getpid()})
        if "PLANTED_DONE" in os.environ:
            Path(os.environ["PLANTED_DONE"]).touch()
        if first == 0:
            DEATHS[self._config.death]()
        stop.wait()


def _null_pointer() -> None:
    ctypes.string_at(0)


def _freeze() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def _error() -> None:
    raise OSError("the device is gone")


def _garbage() -> None:
    """Write into the pipe of the process, as a library that writes anywhere."""
    os.write(int(sys.argv[1]), b"\xff" * 40)
    time.sleep(60)


def _deaf() -> None:
    """Hold the interpreter in native code, so that no other thread runs."""
    ctypes.PyDLL(None).sleep(60)


def _children() -> None:
    """Leave a child behind that holds the pipe."""
    child = subprocess.Popen(["sleep", "600"], pass_fds=(int(sys.argv[1]),))
    Path(os.environ["PLANTED_CHILD"]).write_text(str(child.pid))
    os.abort()


DEATHS: Mapping[Death, Callable[[], Any]] = {
    "none": lambda: None,
    "abort": os.abort,
    "segv": _null_pointer,
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "exit": lambda: os._exit(3),
    "error": _error,
    "frozen": _freeze,
    "garbage": _garbage,
    "deaf": _deaf,
    "children": _children,
}


def plant(place: Path, monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    """Install the modules as sources of these names, here and in processes started from here."""
    info = place / "planted-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: planted\nVersion: 1.0\n")
    points = "".join(f"{name} = {module}\n" for name, module in modules.items())
    (info / "entry_points.txt").write_text(f"[amberbox.sources]\n{points}")
    monkeypatch.syspath_prepend(place)
    root = Path(__file__).parents[2]
    paths = [str(place), str(root), str(root / "src"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
