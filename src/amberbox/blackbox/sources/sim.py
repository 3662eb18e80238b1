"""A simulated robot as a source: deterministic by seed, at any speed, with faults on demand."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.timestamps import parse_time
from amberbox.core.types import Topic
from amberbox.sim.command_socket import CommandSocket
from amberbox.sim.disturbances import Disturbance, Disturber, address_problems
from amberbox.sim.faults import catalogue
from amberbox.sim.live import apply_order
from amberbox.sim.missions import SCENARIOS
from amberbox.sim.robot import START_NS, Robot
from amberbox.sim.topics import TOPIC_BY_NAME, TOPICS, TopicSpec

SAMPLE = """\
- sim:
    seed: 7
    speed: 1
    faults:
      - {id: wheel_front_left_motor_weak, at_s: 60, magnitude: 0.6}
    topics:
      - topic: {name: odom, max_frequency: 10}
      - topic: {name: wheels}
"""
# text that ``amberbox new`` writes for it: a block that records everything, and its monitors
FOLDER = Path(__file__).parents[2] / "sim" / "folder"
PASSIVE = "simulated in this process: there is no robot that could be disturbed"
_NOT_WORTH_WAITING_NS = 500_000
_HURRY = 1.4  # how much faster than real time a delayed robot may run to catch up
# how far messages may be ahead of that rate, as this machine is not always on time
_AT_ONCE_NS = 60_000_000
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FaultOptions:
    """One fault to inject; ``python -m amberbox.sim --list-faults`` shows all."""

    id: str = option(doc="fault of the catalogue")
    at_s: float = option(0.0, "when it begins, after the robot's start", unit="s")
    until_s: float | None = option(None, "when it ends; never when absent", unit="s")
    magnitude: float | None = option(None, "how strong; the catalogue's default when absent")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option that does not fit the catalogue, and why."""
        faults = catalogue()
        if self.id not in faults:
            yield "id", f"there is no fault '{self.id}'{did_you_mean(self.id, faults)}"
            return
        size = faults[self.id].magnitude
        if self.magnitude is not None and not size.low <= self.magnitude <= size.high:
            yield "magnitude", f"must lie from {size.low:g} to {size.high:g} {size.unit}"
        if self.at_s < 0:
            yield "at_s", "must not be negative"
        if self.until_s is not None and self.until_s <= self.at_s:
            yield "until_s", "must be later than at_s"


@dataclass(frozen=True)
class SimOptions:
    """The ``sim`` block."""

    robot: str = option("ropod_001", "name of the simulated robot")
    seed: int = option(1, "the same seed gives the same messages, byte for byte")
    scenario: str = option(
        "transport",
        "transport, charging, standing, shift or shuttle: these two stand at first",
    )
    speed: float | Literal["max"] = option(1.0, "times real time, or max for no waiting")
    start: str | None = option(None, "virtual start (RFC 3339); see times")
    times: Literal["now", "virtual"] | None = option(
        None, "time of receipt: the box's clock, or the robot's; virtual only if speed is max"
    )
    duration_s: float | None = option(None, "end after this much robot time", unit="s")
    faults: Sequence[FaultOptions] = option((), "faults to inject")
    disturbances: Sequence[Disturbance] = option((), "what happens to messages on their way")
    orders: str = option("", "file whose new lines are obeyed: fault ID [magnitude], or heal ID")
    commands: str = option(
        "", "ZeroMQ address where the robot takes requests to move; off if empty"
    )
    topics: Sequence[TopicOptions] = option((), "topics to publish; all when absent")

    @property
    def is_virtual(self) -> bool:
        """Return whether messages are stamped with the robot's virtual time."""
        return self.times == "virtual" if self.times else self.speed == "max"

    @property
    def state_files(self) -> Sequence[str]:
        """Return the files that are no configuration: new orders do not change that."""
        return (self.orders,) if self.orders else ()

    def start_ns(self) -> int:
        """Return the virtual start: as configured, else now, or a fixed day in virtual time."""
        if self.start is not None:
            return parse_time(self.start, time.time_ns, lambda: None)
        return START_NS if self.is_virtual else time.time_ns()

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if self.speed != "max" and not 0 < self.speed < float("inf"):
            yield "speed", "must be above 0, or max"
        if self.scenario not in SCENARIOS:
            names = ", ".join(SCENARIOS)
            yield "scenario", f"must be one of {names}{did_you_mean(self.scenario, SCENARIOS)}"
        if self.times == "virtual" and self.speed != "max":
            yield "times", "virtual goes with speed max only: other speeds follow the box's clock"
        if self.duration_s is not None and self.duration_s <= 0:
            yield "duration_s", "must be above 0"
        if self.commands and not self.commands.startswith(("tcp://", "ipc://")):
            yield "commands", "must be an address to bind, such as tcp://127.0.0.1:5557"
        yield from self._wrong_disturbances()
        for topic in self.topics:
            if topic.name not in TOPIC_BY_NAME:
                near = did_you_mean(topic.name, TOPIC_BY_NAME)
                yield "topics", f"the simulated robot has no topic '{topic.name}'{near}"
        try:
            self.start_ns()
        except UsageError as error:
            yield "start", error.what

    def _wrong_disturbances(self) -> Iterator[tuple[str, str]]:
        for number, disturbance in enumerate(self.disturbances):
            for key, what in address_problems(disturbance):
                yield "disturbances", f"{key} of number {number + 1}: {what}"


Config = SimOptions


def known_topics(config: SimOptions) -> Sequence[Topic]:
    """Return the topics that will be announced, which are known without running the robot."""
    return [spec.topic() for spec in _chosen(config)]


def beside_recorder(config: SimOptions) -> SimOptions:
    """Return a simulation of its own that takes no requests to move."""
    return replace(config, commands="")


class SimSource:
    """Runs one simulated robot and passes on its messages."""

    def __init__(self, config: SimOptions, name: str) -> None:
        self.config = config
        self.name = name
        self.progress = 0.0  # fraction of ``duration_s`` that is over

    @property
    def lossless(self) -> bool:
        """Return whether the robot waits for the recorder; a live one (speed 1) does not."""
        return self.config.speed != 1

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Run the robot until ``stop`` is set or its time is over."""
        config = self.config
        robot = make_robot(config)
        streams = {spec.name: sink.topic(spec.topic()) for spec in _chosen(config)}
        for name in streams:
            sink.link_up(name, config.robot)
        commands = CommandSocket(config.commands) if config.commands else None
        try:
            for topic, sent_ns, data in self._messages(robot, stop, commands):
                if topic in streams:
                    received_ns = sent_ns if config.is_virtual else sink.now_ns()
                    sink.message(streams[topic], data, received_ns)
        finally:
            if commands is not None:
                commands.close("the simulation has ended")
        reason = "stopped" if stop.is_set() else "end of simulation"
        for topic in streams:
            sink.link_down(topic, config.robot, reason)

    def _messages(
        self, robot: Robot, stop: threading.Event, commands: CommandSocket | None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield messages when they are due."""
        speed, end_s = self.config.speed, self.config.duration_s
        pace = None if speed == "max" else RealTimePacer(speed, robot.start_ns, stop)
        encode = msgspec.json.Encoder().encode
        orders = OrdersFile(Path(self.config.orders)) if self.config.orders else None
        disturber = Disturber(self.config.disturbances, robot.start_ns, self.config.seed)
        said = robot.step_until(float("inf") if end_s is None else end_s)
        for topic, sent_ns, message in disturber.feed(said):
            if pace is not None:
                pace.wait(sent_ns)
            if stop.is_set():
                return
            for line in orders.new() if orders else ():
                _log.info("%s", apply_order(robot, line))
            if commands is not None:
                commands.serve(robot)
            if end_s is not None:
                self.progress = robot.now_s / end_s
            yield topic, sent_ns, encode(message)


Source = SimSource


class RealTimePacer:
    """Waits until messages are due; after a delay it catches up at ``_HURRY`` times the speed."""

    def __init__(self, speed: float, start_ns: int, stop: threading.Event) -> None:
        self._speed, self._start_ns, self._stop = speed, start_ns, stop
        self._began_ns = self._earliest_ns = time.monotonic_ns()
        self._last_sent_ns = start_ns

    def wait(self, sent_ns: int) -> None:
        """Wait until a message that the robot sends at this virtual time is due."""
        due_ns = self._began_ns + (sent_ns - self._start_ns) / self._speed
        since_ns = (sent_ns - self._last_sent_ns) / (self._speed * _HURRY)
        now_ns = time.monotonic_ns()
        self._earliest_ns = max(self._earliest_ns, now_ns) + round(since_ns)
        wait_ns = max(due_ns, self._earliest_ns - _AT_ONCE_NS) - now_ns
        if wait_ns > _NOT_WORTH_WAITING_NS:
            self._stop.wait(wait_ns / NS)
        self._last_sent_ns = sent_ns


class OrdersFile:
    """Reads the lines that are added to a file while the robot runs, the first ones included."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0

    def new(self) -> list[str]:
        """Return the complete lines that were added since; none while there is no file."""
        try:
            if self._path.stat().st_size <= self._read:
                return []
            with self._path.open("rb") as file:
                file.seek(self._read)
                whole = file.read().rpartition(b"\n")[0]
        except OSError:
            return []
        self._read += len(whole) + 1 if whole else 0
        return whole.decode("utf-8", "replace").splitlines()


def _chosen(config: SimOptions) -> Sequence[TopicSpec]:
    wanted = {topic.name for topic in config.topics}
    return [spec for spec in TOPICS if not wanted or spec.name in wanted]


def make_robot(config: SimOptions) -> Robot:
    """Return the robot of a configuration with its faults scheduled."""
    catalogue()  # before the robot's time begins: at the first order it would stand still for it
    robot = Robot(config.seed, config.robot, config.scenario, config.start_ns())
    for fault in config.faults:
        robot.inject(fault.id, fault.at_s, fault.magnitude, fault.until_s)
    return robot
