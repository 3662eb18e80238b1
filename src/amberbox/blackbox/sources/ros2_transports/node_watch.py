"""Which nodes of a ROS 2 robot are there, followed by a process of its own.

A native library may crash: then only that process ends, and is started again when somebody asks.
``python -m amberbox.blackbox.sources.ros2_transports.node_watch OPTIONS`` prints lines of JSON: a
list of nodes, or a text that says why they are not known. It ends with its standard input.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.sources.ros2_transports.options import Ros2Options
from amberbox.blackbox.sources.ros2_transports.transport import transport
from amberbox.core.errors import AmberboxError

# after which a node that was not found is not there: a bridge says at once which there are
SETTLE_S: Mapping[str, float] = {"dds": 6.0, "zenoh": 2.0, "bridge": 0.0}
IDLE_S = 60.0  # the process ends when nobody has asked for that long
SILENT_S = 5.0  # it prints each second
AGAIN_S = 10.0  # between two starts: a robot that is off costs little
STUCK_S = 60.0  # a process that has printed nothing for that long is ended
_EVERY_S = 1.0
_LEAVE_S = 3.0  # to leave in order, so that the robot need not wait for a lease
_LONGEST_LINE = 64_000_000
_MOST_NODES = 50_000


@dataclass(frozen=True, slots=True)
class Sighting:
    """Whether a node is there: None if unknown, with the reason. ``age_s`` since it was last."""

    is_there: bool | None
    age_s: float | None = None
    why: str = ""


class NodeWatch:
    """Follows the nodes at one address. Safe from any thread."""

    def __init__(self, keys: Mapping[str, Any]) -> None:
        self._keys = keys
        self._changed = threading.Condition()
        self._process: subprocess.Popen[str] | None = None
        self._since_s: float | None = None  # the robot has been heard since
        self._heard_s = 0.0
        self._asked_s = 0.0
        self._started_s = -AGAIN_S
        self._nodes: set[str] = set()
        self._seen_s: dict[str, float] = {}
        self._why = ""

    def ask(self, node: str, wait_s: float) -> Sighting:
        """Return whether a node is there; waits at first until that can be known."""
        end_s = time.monotonic() + wait_s
        with self._changed:
            self._asked_s = time.monotonic()
            if self._process is None:
                if self._asked_s - self._started_s >= AGAIN_S:
                    self._start()
            elif self._asked_s - max(self._heard_s, self._started_s) > STUCK_S:
                self._process.kill()
            while True:
                found = self._sighting(node)
                left_s = end_s - time.monotonic()
                if found.is_there is not None or self._why or left_s <= 0:
                    return found
                self._changed.wait(min(left_s, 0.5))

    def close(self) -> None:
        """Let the process leave the robot and end."""
        with self._changed:
            process = self._process
        if process is not None and process.stdin is not None:
            process.stdin.close()

    def _sighting(self, node: str) -> Sighting:
        now_s = time.monotonic()
        last_s = self._seen_s.get(node)
        age_s = None if last_s is None else now_s - last_s
        if self._why or self._since_s is None:
            return Sighting(None, age_s, self._why or "the robot has not been heard yet")
        if now_s - self._heard_s > SILENT_S:
            return Sighting(None, age_s, "the process that follows the nodes stands still")
        if node in self._nodes:
            return Sighting(True, 0.0)
        was_found = last_s is not None and last_s >= self._since_s
        if not was_found and now_s - self._since_s < SETTLE_S[self._keys["via"]]:
            return Sighting(None, age_s, "not found yet")
        return Sighting(False, age_s)

    def _start(self) -> None:
        words = [sys.executable, "-m", __name__, json.dumps(self._keys)]
        self._process = subprocess.Popen(
            words, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, process_group=0,
        )  # fmt: skip
        self._why, self._since_s, self._started_s = "", None, time.monotonic()
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def _read(self, process: subprocess.Popen[str]) -> None:
        """Take what the process prints, until it ends."""
        assert process.stdout is not None and process.stdin is not None
        while line := process.stdout.readline(_LONGEST_LINE):
            with suppress(ValueError):  # what a library prints
                self._take(json.loads(line))
            if time.monotonic() - self._asked_s > IDLE_S:
                break
        process.stdin.close()
        try:
            process.wait(2 * _LEAVE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()
        with self._changed:
            self._process = None
            self._nodes = set()
            self._why = (
                self._why or f"the process that follows the nodes ended: {process.returncode}"
            )
            self._changed.notify_all()

    def _take(self, said: Any) -> None:
        now_s = time.monotonic()
        with self._changed:
            if isinstance(said, str):
                self._why = said
            elif isinstance(said, list):
                self._heard_s, self._since_s = now_s, self._since_s or now_s
                self._nodes = set(said[:_MOST_NODES])
                self._seen_s |= dict.fromkeys(self._nodes, now_s)
                if len(self._seen_s) > 2 * _MOST_NODES:  # the oldest are forgotten
                    newest = sorted(self._seen_s, key=self._seen_s.__getitem__)[-_MOST_NODES:]
                    self._seen_s = {name: self._seen_s[name] for name in newest}
            self._changed.notify_all()


def main(options: str) -> None:
    """Print which nodes there are: each change, and all of them each second."""
    stop = threading.Event()
    threading.Thread(target=_end_with_input, args=(stop,), daemon=True).start()
    last: tuple[float, set[str] | None] = 0.0, None

    def tell(nodes: Collection[str]) -> None:
        nonlocal last
        now_s, known = time.monotonic(), set(nodes)
        if known != last[1] or now_s - last[0] >= _EVERY_S:
            last = now_s, known
            print(json.dumps(sorted(known)), flush=True)

    try:
        way = transport(Ros2Options(**json.loads(options), all_topics=True))
        way.follow_nodes(tell, stop)
    except AmberboxError as error:
        print(json.dumps(error.what), flush=True)
    os._exit(0)  # native libraries may have threads that would keep the process


def _end_with_input(stop: threading.Event) -> None:
    sys.stdin.buffer.read()
    stop.set()
    time.sleep(_LEAVE_S)
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
