"""A source that reports everything a source can report, with hostile names, and ends."""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

from amberbox.core.clock import NS
from amberbox.core.options import option
from amberbox.core.robot_graph import GraphTopic, RobotGraph
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Schema, Topic

SAMPLE = "- talkative: {}\n"
PASSIVE = "says hello as {config.name}"
STAMPED = Schema("test/Stamped", "ros1msg", b"time stamp\n")
HOSTILE = "/evil\n\x1b[2J"


@dataclass(frozen=True)
class Config:
    """The ``talkative`` block."""

    name: str = option("box", "its name on the bus")
    fails: str = option("", "the error with which it ends")
    topics: Sequence[TopicOptions] = option((), "topics")


def beside_recorder(config: Config) -> Config:
    """Return the configuration under another name."""
    return replace(config, name=f"{config.name}_2")


def read_graph(config: Config, wait_s: float) -> RobotGraph:
    """Return topics that are not sent, one that only has a subscriber, and one that is heard."""
    return RobotGraph(
        topics=(
            GraphTopic("/advertised"),
            GraphTopic("/idle", "a/B", ("/n",)),
            GraphTopic("/odom", "a/C", ()),
            GraphTopic("/wanted", "a/B", (), ("/n",)),
        )
    )


class Source:
    """Reports and ends."""

    lossless = False

    def __init__(self, config: Config, name: str) -> None:
        self._config = config

    def topics(self) -> Sequence[TopicOptions]:
        """Return what is configured."""
        return self._config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Send 5 stamped messages in 2 s of its own time, and two that are no messages."""
        stream = sink.topic(Topic("/odom", "ros1", STAMPED))
        sink.link_up("/odom", "/robot")
        sink.link_down("/odom", "/gone", "it left")
        for number in range(5):
            received_ns = 1000 * NS + number * NS // 2
            sink.message(stream, struct.pack("<II", 999, 500_000_000), received_ns)
        sink.lost("/odom", "/robot", 0, 1, 7, "holes")
        sink.message(sink.topic(Topic(HOSTILE, "json")), b"\xff{", 1000 * NS)
        sink.event("sent", "3 greetings")
        for number in range(60):
            sink.event("noise", f"noise {number}\n{HOSTILE}")
        assert sink.state() == {} and sink.last_latched("/odom") is None
        if self._config.fails:
            raise RuntimeError(self._config.fails)
