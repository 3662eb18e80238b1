"""A robot behind a ZeroMQ socket (REP): it drives and stops by JSON requests, and counts them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import zmq

from tests.support.processes import free_port, wait_for

ACTIONS = """\
drive:
  description: Drive straight ahead
  kind: zmq_request
  endpoint: ENDPOINT
  connect_within: 60 s
  answer_within: 60 s
  request: {do: linear, distance_m: "{distance_m}"}
  poll: {do: state}
  until: {moving: false}
  poll_every: 0.05 s
  safe_stop: {do: stop}
  simulated: {at: "{distance_m}"}
  simulated_for: 0 s
  parameters:
    distance_m: {unit: m, min: -2, max: 2}
  risk: moves
  timeout: 60 s
light:
  kind: zmq_request
  endpoint: ENDPOINT
  connect_within: 60 s
  answer_within: 60 s
  request: {do: light}
  risk: state
"""


def boot_s() -> float:
    """Return seconds since boot, suspend included."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class ZmqRobot:
    """Answers every request at once; ``hears`` keeps them with the time since boot in seconds.

    What it has heard and whether it moves change as one.
    """

    def __init__(self, socket: zmq.Socket[bytes], endpoint: str) -> None:
        self.endpoint = endpoint
        self.hears: list[tuple[float, Any]] = []
        self.answers: dict[str, bytes] = {}
        """Instead of the usual answer to what is to be done; empty for none."""
        self._moving = False
        self._hearing = threading.Lock()
        self._socket = socket

    @property
    def moving(self) -> bool:
        with self._hearing:
            return self._moving

    @moving.setter
    def moving(self, is_so: bool) -> None:
        with self._hearing:
            self._moving = is_so

    def heard(self, what: str) -> list[float]:
        """Return when it was told to do something."""
        return [at_s for at_s, said in list(self.hears) if said["do"] == what]

    def wait_until(self, what: str, count: int = 1) -> list[float]:
        """Wait until it was told so often to do something; return when."""
        return wait_for(
            lambda: found if len(found := self.heard(what)) >= count else None, f"'{what}'"
        )

    def serve(self, end: threading.Event) -> None:
        """Answer until the end."""
        while not end.is_set():
            if not self._socket.poll(20):
                continue
            request = msgspec.json.decode(self._socket.recv())
            done = request["do"]
            with self._hearing:
                self._moving = (self._moving or done == "linear") and done != "stop"
                self.hears.append((boot_s(), request))
            usual = msgspec.json.encode({"ok": True, "moving": self.moving})
            answer = self.answers.get(done, usual)
            if not answer:  # hangs: a REP socket that does not answer takes no more requests
                end.wait()
                return
            self._socket.send(answer)


@contextmanager
def zmq_robot(endpoint: str = "") -> Iterator[ZmqRobot]:
    """Run a robot at a free port of this computer."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.REP)
    socket.linger = 0
    address = endpoint or f"tcp://127.0.0.1:{free_port()}"
    socket.bind(address)
    robot, end = ZmqRobot(socket, address), threading.Event()
    thread = threading.Thread(target=robot.serve, args=(end,))
    thread.start()
    try:
        yield robot
    finally:
        end.set()
        thread.join()
        socket.close()
        context.term()
