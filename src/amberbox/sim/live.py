"""A simulated robot that publishes in real time on its buses, and takes faults from a keyboard."""

from __future__ import annotations

import contextlib
import json
import queue
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, Protocol

import msgspec

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.sim.buses import RobotBus
from amberbox.sim.command_socket import CommandSocket
from amberbox.sim.disturbances import Disturber
from amberbox.sim.robot import TICK_NS, Message, Robot


class PublishingSocket(Protocol):
    """The output of messages: a ZeroMQ socket, or a list in a test."""

    def send_multipart(self, msg_parts: list[bytes]) -> Any:
        """Send topic and payload."""


@dataclass(frozen=True, slots=True)
class LiveRun:
    """Options of a live run: speed, end (seconds of robot time), file of the truth."""

    speed: float | Literal["max"] = 1.0
    for_s: float = float("inf")
    truth: Path | None = None


def open_publisher(endpoint: str) -> Any:
    """Bind a publishing socket and print the address it is bound to.

    Raises AmberboxError if pyzmq is missing or the address cannot be bound.
    """
    try:
        import zmq
    except ImportError as error:
        raise AmberboxError("pyzmq is not installed", "pip install 'amberbox[zmq]'") from error
    socket: Any = zmq.Context.instance().socket(zmq.XPUB)
    socket.setsockopt(zmq.SNDHWM, 0)  # no limit: nothing is dropped here
    socket.setsockopt(zmq.LINGER, 2000)
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        socket.close()
        raise AmberboxError(f"cannot bind {endpoint}: {error}", "tcp://127.0.0.1:5556") from error
    bound = socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
    print(f"publishing on {bound}", flush=True)
    return socket


def wait_for_subscriber(socket: Any, stop: threading.Event) -> None:
    """Wait until a subscriber has connected, or ``stop`` is set."""
    while not stop.is_set() and not socket.poll(100):
        pass


def publish(
    robot: Robot,
    publisher: PublishingSocket | None,
    plan: LiveRun,
    orders: queue.SimpleQueue[str],
    stop: threading.Event,
    commands: CommandSocket | None = None,
    buses: Sequence[RobotBus] = (),
    disturber: Disturber | None = None,
) -> int:
    """Publish until the plan's end or ``stop``; return how many messages were sent.

    ``publisher`` is a ZeroMQ socket; ``buses`` are further ones, which get the same messages: those
    of the robot, or what ``disturber`` makes of them.

    The truth (topic, seq, stamp in ns) of each batch is written and flushed before the batch is
    sent, so that it contains every message sent. Requests of ``commands`` are answered between
    two ticks.
    """
    encode = msgspec.json.Encoder().encode
    sent = 0
    file = (
        contextlib.nullcontext() if plan.truth is None else plan.truth.open("w", encoding="utf-8")
    )
    with file as truth:
        for batch in _batches(robot, plan, orders, stop, commands, buses, disturber):
            if truth is not None:
                truth.write("".join(truth_line(topic, message) for topic, _, message in batch))
                truth.flush()
            for topic, _, message in batch:
                if publisher is not None:
                    publisher.send_multipart([topic.encode(), encode(message)])
                for bus in buses:
                    bus.send(topic, message)
            sent += len(batch)
    return sent


def truth_line(topic: str, message: dict[str, Any]) -> str:
    """Write one line of the truth about a published message."""
    header = message["header"]
    stamp_ns = header["stamp"]["sec"] * NS + header["stamp"]["nanosec"]
    return json.dumps({"topic": topic, "seq": header["seq"], "stamp_ns": stamp_ns}) + "\n"


def apply_order(robot: Robot, order: str) -> str:
    """Carry out one line: ``fault ID [magnitude]`` or ``heal ID``; return the answer."""
    words = order.split()
    try:
        if len(words) in (2, 3) and words[0] == "fault":
            robot.inject(words[1], magnitude=float(words[2]) if len(words) == 3 else None)
            return f"{words[1]} acts from {robot.now_s:.2f} s on"
        if len(words) == 2 and words[0] == "heal":
            robot.heal(words[1])
            return f"{words[1]} healed at {robot.now_s:.2f} s"
    except (UsageError, ValueError) as error:
        return f"error: {error}"
    return f"error: cannot read {order!r}\nhint: fault ID [magnitude], or heal ID"


def listen(lines: IO[str], orders: queue.SimpleQueue[str]) -> None:
    """Put lines into the queue until their end (run it in a thread of its own)."""
    for line in lines:
        if line.strip():
            orders.put(line.strip())


def _batches(
    robot: Robot,
    plan: LiveRun,
    orders: queue.SimpleQueue[str],
    stop: threading.Event,
    commands: CommandSocket | None,
    buses: Sequence[RobotBus],
    disturber: Disturber | None,
) -> Iterator[list[Message]]:
    """Yield the messages of each tick when they are due."""
    began_ns, began_s = time.monotonic_ns(), robot.now_s
    while robot.now_s < plan.for_s and not stop.is_set():
        while not orders.empty():
            print(apply_order(robot, orders.get()), file=sys.stderr, flush=True)
        if commands is not None:
            commands.serve(robot)
        messages = robot.step_until(robot.now_s + TICK_NS / NS)
        if disturber is not None:
            messages = disturber.feed(messages, robot.now_ns + TICK_NS)
        batch = list(messages)
        due_ns = time.monotonic_ns()
        if plan.speed != "max":
            due_ns = began_ns + round((robot.now_s - began_s) * NS / plan.speed)
            stop.wait(max(0.0, (due_ns - time.monotonic_ns()) / NS))
        for bus in buses:
            bus.tick(robot, due_ns)
        if batch:
            yield batch
