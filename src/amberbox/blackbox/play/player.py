"""Plays the original messages of a record to peers, at the pace of the record or another one."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from amberbox.blackbox.query.foxglove import Frames, ViewerMessage
from amberbox.core.clock import NS
from amberbox.core.types import Topic

LATE_S = 0.1  # a message that is sent later than this after it was due counts as late
CLOCK_S = 0.01  # time between two messages of the clock
_MOST_SHOWN = 20

_COMMAND_TYPES = frozenset({
    "ackermann_msgs/AckermannDrive", "ackermann_msgs/AckermannDriveStamped",
    "actionlib_msgs/GoalID", "geometry_msgs/Twist", "geometry_msgs/TwistStamped", "sensor_msgs/Joy",
    "trajectory_msgs/JointTrajectory",
})  # fmt: skip
_COMMAND_SUFFIXES = ("ActionGoal", "Command", "Cmd")
_COMMAND_NAME = re.compile(
    r"(^|[/_])(cmd|command|teleop|goal|cancel|setpoint|target|stop|estop|reset|initialpose)s?([/_]|$)",
    re.IGNORECASE,
)


def is_command(topic: Topic) -> bool:
    """Return whether messages of a topic may move a robot, by its type and its name."""
    kind = topic.schema.name.replace("/msg/", "/") if topic.schema is not None else ""
    of_type = kind in _COMMAND_TYPES or kind.endswith(_COMMAND_SUFFIXES)
    return of_type or _COMMAND_NAME.search(topic.name) is not None


@dataclass
class RenamedMessages:
    """The messages of a source below other names: ``/odom`` becomes ``/replay/odom``."""

    source: Frames
    prefix: str
    _names: dict[Topic, Topic] = field(default_factory=dict)

    @property
    def topics(self) -> Sequence[Topic]:
        """Return all topics by their new names."""
        return [self._renamed(topic) for topic in self.source.topics]

    def _renamed(self, topic: Topic) -> Topic:
        if topic not in self._names:
            name = f"{self.prefix.rstrip('/')}/{topic.name.lstrip('/')}"
            self._names[topic] = replace(topic, name=name)
        return self._names[topic]

    def latched(self, at_ns: int) -> Sequence[ViewerMessage]:
        """Return the last messages of latched topics before a moment."""
        return [m._replace(topic=self._renamed(m.topic)) for m in self.source.latched(at_ns)]

    def read(self, from_ns: int) -> Iterator[ViewerMessage]:
        """Yield the messages from a moment on."""
        return (m._replace(topic=self._renamed(m.topic)) for m in self.source.read(from_ns))


class PlayTarget(Protocol):
    """Where messages are played to."""

    def refused(self, topic: Topic) -> str:
        """Return why the peer cannot get a topic; empty if it can."""

    def open(self, topics: Sequence[Topic]) -> None:
        """Announce topics; raises AmberboxError when that is not possible."""

    def is_heard(self) -> bool:
        """Return whether anybody has subscribed."""

    def send(self, topic: Topic, data: bytes, *, patient: bool) -> int:
        """Send a message; return how many subscribers get it.

        ``patient``: wait for subscribers that have no room for it, within limits.
        """

    def set_clock(self, at_ns: int) -> None:
        """Announce the time of the record, if the peer is to follow it."""

    def dropped(self) -> int:
        """Return how many messages slow subscribers have lost."""

    def close(self) -> None:
        """Wait until what was sent is taken, within limits, and end."""


@dataclass
class PlayReport:
    """What was played, what came late or was lost, and which topics were left out and why."""

    counts: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    unheard: int = 0
    late: int = 0
    latest_s: float = 0.0
    dropped: int = 0
    duration_s: float = 0.0

    @property
    def total(self) -> int:
        """Return the number of messages altogether."""
        return sum(self.counts.values())

    def lines(self) -> list[str]:
        """Return the report as text."""
        topics = f"{len(self.counts)} topic{'' if len(self.counts) == 1 else 's'}"
        lines = [f"played {self.total} messages of {topics} in {self.duration_s:.1f} s"]
        if self.unheard:
            lines.append(f"  nobody had subscribed to {self.unheard} of them")
        if self.late:
            lines.append(f"  late: {self.late}, by at most {self.latest_s:.2f} s")
        if self.dropped:
            lines.append(f"  dropped: {self.dropped}, subscribers were too slow")
        return [*lines, *left_out_lines(self.left_out)]

    def to_json(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return {
            "total": self.total, "counts": self.counts, "unheard": self.unheard, "late": self.late,
            "latest_s": round(self.latest_s, 3), "dropped": self.dropped,
            "duration_s": round(self.duration_s, 3), "left_out": self.left_out,
        }  # fmt: skip


def left_out_lines(left_out: Mapping[str, str]) -> list[str]:
    """Return a line for each topic that is left out, the first of many only."""
    lines = [f"  left out: {name}: {why}" for name, why in list(left_out.items())[:_MOST_SHOWN]]
    more = len(left_out) - len(lines)
    return [*lines, f"  left out: {more} more"] if more else lines


@dataclass
class Player:
    """Sends messages when they are due; without ``speed`` as fast as subscribers take them.

    Due times are counted from the start, so that delays do not add up.
    """

    messages: Frames
    span: tuple[int, int]
    target: PlayTarget
    topics: frozenset[Topic]
    speed: float | None = 1.0
    loop: bool = False
    report: PlayReport = field(default_factory=PlayReport)
    clock_s: Callable[[], float] = time.monotonic
    _began_s: float = 0.0
    _clock_due_s: float = 0.0

    def run(self, stop: threading.Event) -> None:
        """Play to the end, or until stopped; the report is complete afterwards."""
        began_s = self.clock_s()
        try:
            while self._play(stop) and self.loop:
                pass
        finally:
            self.target.close()
            self.report.dropped = self.target.dropped()
            self.report.duration_s = self.clock_s() - began_s

    def _play(self, stop: threading.Event) -> bool:
        """Play the range once; return whether it was played to its end."""
        self._began_s = self._clock_due_s = self.clock_s()
        for message in self.messages.latched(self.span[0]):
            self._send(message)
        at_ns = self.span[0]
        for message in self.messages.read(self.span[0]):
            if message.topic in self.topics:
                at_ns = message.received_ns
                if not self._wait_until_due(at_ns, stop):
                    return False
                self._send(message)
        self.target.set_clock(at_ns)  # a player that is late sends the last ones at once
        return not stop.is_set()

    def _wait_until_due(self, at_ns: int, stop: threading.Event) -> bool:
        """Wait until a message is due, and keep the clock going; False when stopped."""
        if self.speed is None:
            if self.clock_s() >= self._clock_due_s:
                self._clock_due_s = self.clock_s() + CLOCK_S
                self.target.set_clock(at_ns)
            return not stop.is_set()
        due_s = self._began_s + (at_ns - self.span[0]) / NS / self.speed
        while not stop.is_set():
            now_s = self.clock_s()
            if now_s >= self._clock_due_s:
                self._clock_due_s = now_s + CLOCK_S
                passed_ns = round((min(now_s, due_s) - self._began_s) * self.speed * NS)
                self.target.set_clock(self.span[0] + passed_ns)
            if now_s >= due_s:
                if now_s - due_s > LATE_S:
                    self.report.late += 1
                    self.report.latest_s = max(self.report.latest_s, now_s - due_s)
                return True
            stop.wait(min(due_s, self._clock_due_s) - now_s)
        return False

    def _send(self, message: ViewerMessage) -> None:
        if message.topic not in self.topics:
            return
        taken = self.target.send(message.topic, message.data, patient=self.speed is None)
        name = message.topic.name
        self.report.counts[name] = self.report.counts.get(name, 0) + 1
        self.report.unheard += not taken
