"""A peer of a Zyre network, as a process: pyre, told what to do by lines of JSON."""

from __future__ import annotations

import importlib
import json
import logging
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.support.processes import wait_for

_MARK = "event: "


class ZyrePeer:
    """A running peer; ``events`` are those of pyre, with texts in place of bytes."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.events: list[list[Any]] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(_MARK):
                self.events.append(json.loads(line.removeprefix(_MARK)))

    def order(self, *words: object) -> None:
        """Make it join, leave, shout (group, text, times, rate), whisper (peer, text) or stop."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()

    def sees(self, kind: str, name: str, *more: str) -> str:
        """Wait for an event of a peer; return the peer's UUID."""

        def found() -> str | None:
            for event in self.events:
                if event[0] == kind and event[2] == name and event[3 : 3 + len(more)] == [*more]:
                    return str(event[1])
            return None

        return wait_for(found, f"{kind} of {name} in {self.events}")

    def kill(self) -> None:
        """End it as ``kill -9`` does."""
        self.process.kill()
        self.process.wait()


@contextmanager
def zyre_peer(namespace: str, name: str, *groups: str) -> Iterator[ZyrePeer]:
    """Run a peer in a namespace."""
    words = ["ip", "netns", "exec", namespace, sys.executable, "-m", __name__, name, *groups]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield ZyrePeer(process)
        finally:
            process.kill()


def main(name: str, groups: list[str]) -> None:
    """Be a peer until told to stop."""
    import zmq

    pyre: Any = importlib.import_module("pyre")  # it has no types

    logging.disable()
    node = pyre.Pyre(name)
    for group in groups:
        node.join(group)
    node.start()
    orders: list[list[Any]] = []

    def listen() -> None:
        for line in sys.stdin:
            orders.append(json.loads(line))

    threading.Thread(target=listen, daemon=True).start()
    poller = zmq.Poller()
    poller.register(node.socket(), zmq.POLLIN)
    while True:
        while poller.poll(10):
            kind, peer, *rest = node.recv()
            texts = [part.decode(errors="replace") for part in rest]
            print(
                _MARK + json.dumps([kind.decode(), uuid.UUID(bytes=peer).hex, *texts]), flush=True
            )
        while orders:
            what, *words = orders.pop(0)
            if what == "stop":
                node.stop()
                return
            carry_out(node, what, words)


def carry_out(node: Any, what: str, words: list[Any]) -> None:
    """Do what was ordered; ``%d`` in a text is the number of the message."""
    if what == "shout":
        group, text, times, rate_hz = words
        began_s = time.monotonic()
        for number in range(times):
            node.shouts(group, text.replace("%d", str(number)))
            time.sleep(max(0.0, began_s + number / rate_hz - time.monotonic()))
    elif what == "whisper":
        node.whispers(uuid.UUID(words[0]), words[1])
    else:
        getattr(node, what)(*words)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
