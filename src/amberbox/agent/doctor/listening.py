"""Listen to all sources of a robot folder for a while and count; nothing is recorded.

The sources run as in the recorder, and may run beside it. What they hear is compared with the graph
of the robot, where the source can read it, and with the topics that are configured.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from amberbox.agent.doctor.checkup import missing_library
from amberbox.blackbox.recorder.queue import DataItem, TopicStream, change_filtered
from amberbox.blackbox.recorder.supervisor import INFERRED, run_source
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock
from amberbox.blackbox.robot_folder.folder import SOURCES, RobotFolder
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, nearest_word
from amberbox.core.plugins import get
from amberbox.core.robot_graph import GraphTopic, RobotGraph
from amberbox.core.source import Power, TopicOptions
from amberbox.core.topic_selection import SelectionOptions, TopicSelection
from amberbox.core.types import Topic

SENT = "sent"  # kind of the events by which a source states what it sent
MOST_EVENTS = 50
_LEAST_SPAN_NS = NS // 5
_GRAPH_S = 5.0  # the longest time for reading the graph of a robot
_STOP_S = 3.0


@dataclass(frozen=True, slots=True)
class HeardTopic:
    """What came on one topic; ``stamp_age_s`` is from the first message's stamp to its receipt.

    ``rate_hz`` is None where the messages span less than 0.2 s, ``stamp_age_s`` without a stamp.
    ``peers`` are connected, ``down`` are those that are not, each with the reason.
    """

    name: str
    type: str
    messages: int
    rate_hz: float | None
    bytes: int
    mean_bytes: int
    stamp_age_s: float | None
    peers: tuple[str, ...]
    down: tuple[str, ...]
    lost: int


@dataclass(frozen=True, slots=True)
class MissingTopic:
    """A configured topic or pattern without a publisher, and a topic with a similar name."""

    name: str
    near: str


@dataclass(frozen=True, slots=True)
class UnrecordedTopic:
    """A topic that has a publisher and is not recorded."""

    name: str
    type: str
    publishers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SourceReport:
    """What one source heard; ``trouble`` is why it heard nothing or failed, else empty.

    ``passive`` describes what its configuration makes it send, ``sent`` what it counted.
    """

    name: str
    plugin: str
    connected: bool
    trouble: str
    passive: str
    sent: tuple[str, ...]
    topics: tuple[HeardTopic, ...]
    not_recorded: tuple[UnrecordedTopic, ...]
    not_published: tuple[MissingTopic, ...]
    events: tuple[tuple[str, str], ...]
    more_events: int

    @property
    def is_fine(self) -> bool:
        """Return whether it heard something, without failure, and misses no configured topic."""
        return self.connected and not self.trouble and not self.not_published


def listen(folder: RobotFolder, seconds: float, stop: threading.Event) -> list[SourceReport]:
    """Run all sources for so many seconds, or until ``stop`` is set or all have ended.

    Raises UsageError for a folder without sources.
    """
    if not folder.blocks:
        raise UsageError(
            f"{folder.path} names no source to listen to",
            f"amberbox check {folder.path} tells what its black_box.yaml holds",
        )
    listeners = [_Listener(block, folder.robot.store.queue) for block in folder.blocks]
    for listener in listeners:
        listener.start()
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and any(listener.is_running() for listener in listeners):
        if stop.wait(min(0.1, max(0.0, end_s - time.monotonic()))):
            break
    for listener in listeners:
        listener.end()
    end_s = time.monotonic() + _STOP_S
    return [listener.report(end_s) for listener in listeners]


@dataclass
class _Count:
    """What came on one topic so far."""

    type: str
    stream: TopicStream
    messages: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    stamp_ns: int | None = None


@dataclass
class CountingSink:
    """A sink that counts; it decodes no more than the stamp of the first message of a topic.

    Once ``ended`` is set it ignores all calls: what a source reports while it stops is no finding.
    """

    name: str
    selection: TopicSelection
    longest_bytes: int
    ended: bool = False
    counts: list[_Count] = field(default_factory=list)
    links: dict[tuple[str, str], str] = field(default_factory=dict)
    """Topic and peer to the reason why the link is down; empty while it is up."""
    losses: dict[str, int] = field(default_factory=dict)
    events: list[tuple[str, str]] = field(default_factory=list)
    more_events: int = 0
    sent: list[str] = field(default_factory=list)
    _numbers: dict[Topic, int] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock)

    def now_ns(self) -> int:
        return time.time_ns()

    def topic(self, topic: Topic) -> int:
        with self._lock:
            if topic not in self._numbers:
                self._numbers[topic] = len(self.counts)
                self.counts.append(self._new_count(topic))
            return self._numbers[topic]

    def _new_count(self, topic: Topic) -> _Count:
        infers = topic.message_encoding in INFERRED
        kind = topic.schema.name if topic.schema is not None else topic.message_encoding
        options = self.selection.options(topic.name) or TopicOptions(topic.name)
        item = DataItem(topic.name, self.name, topic.name, replace(options, change=None))
        own = replace(topic, schema=None) if infers else topic
        stream = TopicStream(item, own, infers=infers)
        wrong = "" if infers else stream.compile()
        if wrong:
            self.event("undecodable", f"{topic.name}: {wrong}")
        return _Count(kind, stream)

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        if self.ended:
            return
        with self._lock:
            count = self.counts[stream]
            if not count.messages:
                count.first_ns = received_ns
                count.stamp_ns = self._stamp_ns(count.stream, data, received_ns)
            count.messages += 1
            count.bytes += len(data)
            count.last_ns = max(count.last_ns, received_ns)

    def _stamp_ns(self, stream: TopicStream, data: bytes, received_ns: int) -> int | None:
        """Return the stamp of a first message; its schema is inferred if it brings none."""
        try:
            change_filtered([(stream, data, received_ns)], self.event)
            return stream.stamp_ns(data)
        except Exception as error:  # whatever it holds: the others are counted
            self.event("undecodable", f"{stream.topic.name}: {error!r}")
            return None

    def longest_message(self) -> int:
        return self.longest_bytes

    def complete(self, until_ns: int) -> None:
        pass

    def dropped(self, stream: int, from_ns: int, to_ns: int, count: int) -> None:
        with self._lock:
            name = self.counts[stream].stream.topic.name
        self.lost(name, "", from_ns, to_ns, count, "no room in the process of the source")

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        self._note_link(topic, peer, "")

    def link_up_at(self, topic: str, peer: str, at_ns: int, since_ns: int | None) -> None:
        self._note_link(topic, peer, "")

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        self._note_link(topic, peer, reason)

    def _note_link(self, topic: str, peer: str, reason: str) -> None:
        with self._lock:
            if not self.ended:
                self.links[topic, peer] = reason

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        with self._lock:
            if not self.ended:
                self.losses[topic] = self.losses.get(topic, 0) + count

    def event(self, kind: str, text: str, source: str = "", **details: Any) -> None:
        with self._lock:
            if self.ended:
                return
            if kind == SENT and len(self.sent) < MOST_EVENTS:
                self.sent.append(text)
            elif len(self.events) < MOST_EVENTS:
                self.events.append((kind, text))
            else:
                self.more_events += 1

    def power(self, state: Power, text: str) -> None:
        self.event(f"power_{state}", text)

    def last_latched(self, topic: str) -> bytes | None:
        return None

    def state(self) -> dict[str, Any]:
        return {}

    def save_state(self, state: Mapping[str, Any]) -> None:
        pass

    def end(self) -> None:
        """Take no more calls."""
        with self._lock:
            self.ended = True

    def heard(self) -> Iterator[HeardTopic]:
        """Yield the topics by name; a topic with a link and without a message is among them."""
        by_topic: dict[tuple[str, str], list[_Count]] = {}
        for count in self.counts:
            by_topic.setdefault((count.stream.topic.name, count.type), []).append(count)
        for name in {topic for topic, _ in self.links} - {name for name, _ in by_topic}:
            by_topic[name, ""] = []
        for (name, kind), counts in sorted(by_topic.items()):
            links = {p: reason for (topic, p), reason in self.links.items() if topic == name}
            yield _heard(
                name, kind, [c for c in counts if c.messages], links, self.losses.get(name, 0)
            )


def _heard(
    name: str, kind: str, counts: Sequence[_Count], links: Mapping[str, str], lost: int
) -> HeardTopic:
    messages, size = sum(c.messages for c in counts), sum(c.bytes for c in counts)
    span_ns = max((c.last_ns for c in counts), default=0) - min(
        (c.first_ns for c in counts), default=0
    )
    ages = [(c.first_ns - c.stamp_ns) / NS for c in counts if c.stamp_ns is not None]
    return HeardTopic(
        name,
        kind,
        messages,
        rate_hz=(messages - 1) * NS / span_ns if span_ns >= _LEAST_SPAN_NS else None,
        bytes=size,
        mean_bytes=size // messages if messages else 0,
        stamp_age_s=ages[0] if ages else None,
        peers=tuple(sorted(peer for peer, reason in links.items() if not reason)),
        down=tuple(sorted(f"{peer}: {reason}" for peer, reason in links.items() if reason)),
        lost=lost,
    )


class _Listener:
    """One source, its sink, and the graph of its robot."""

    def __init__(self, block: SourceBlock, longest_bytes: int) -> None:
        self._plugin = get(SOURCES, block.plugin)
        self._module: Any = self._plugin.load()
        beside: Callable[[Any], Any] = getattr(self._module, "beside_recorder", lambda same: same)
        self._block = replace(block, config=beside(block.config))
        self._topics: Sequence[TopicOptions] = ()
        self._sink = CountingSink(block.name, TopicSelection(()), longest_bytes)
        self._stop = threading.Event()
        self._trouble = ""
        self._graph: RobotGraph | None = None
        self._threads = [
            threading.Thread(target=work, name=f"{block.name} {number}", daemon=True)
            for number, work in enumerate((self._run, self._read_graph))
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def is_running(self) -> bool:
        return any(thread.is_alive() for thread in self._threads)

    def end(self) -> None:
        self._sink.end()
        self._stop.set()

    def _run(self) -> None:
        try:
            source = self._module.Source(self._block.config, self._block.name)
            self._topics = source.topics()
            self._sink.selection = TopicSelection(self._topics)
            run_source(source, self._block, self._sink, self._stop)
        except Exception as error:  # whatever it is: the other sources are heard
            lacking = missing_library(self._plugin) if isinstance(error, ImportError) else None
            text = str(error).replace("\n", "; ") if lacking is None else "; ".join(lacking)
            if not self._sink.ended:
                self._trouble = text or repr(error)

    def _read_graph(self) -> None:
        read = getattr(self._module, "read_graph", None)
        if read is None:
            return
        try:
            self._graph = read(self._block.config, _GRAPH_S)
        except Exception as error:  # as above
            self._sink.event("no_graph", f"the topics that are there cannot be read: {error}")

    def report(self, end_s: float) -> SourceReport:
        """Wait for the source until a moment of the monotonic clock; return what it heard."""
        for thread in self._threads:
            thread.join(max(0.0, end_s - time.monotonic()))
        sink = self._sink
        heard = tuple(sink.heard())
        is_up = "" in sink.links.values() or any(topic.messages for topic in heard)
        trouble = self._trouble
        if not trouble and not is_up:
            reasons = [reason for reason in sink.links.values() if reason]
            texts = [text for kind, text in sink.events if kind != "no_graph"]
            trouble = next(iter([*texts, *reasons]), "nothing was heard")
        passive = str(getattr(self._module, "PASSIVE", "")).format(config=self._block.config)
        return SourceReport(
            name=self._block.name,
            plugin=self._block.plugin,
            connected=is_up,
            trouble=trouble,
            passive=passive,
            sent=tuple(sink.sent),
            topics=heard,
            not_recorded=tuple(self._not_recorded()),
            not_published=tuple(self._not_published(heard)),
            events=tuple(sink.events),
            more_events=sink.more_events,
        )

    def _published(self) -> Iterator[GraphTopic]:
        """Yield the topics of the graph with a publisher, also if the bus does not tell which."""
        for topic in self._graph.topics if self._graph is not None else ():
            if topic.publishers or not topic.subscribers:
                yield topic

    def _not_recorded(self) -> Iterator[UnrecordedTopic]:
        """Yield the topics that are published and that the configuration does not choose."""
        config = self._block.config
        selection = TopicSelection(self._topics, all_topics=not self._topics)
        if isinstance(config, SelectionOptions):
            selection = config.selection()
        for topic in self._published():
            if not selection.chooses(topic.name, topic.type):
                yield UnrecordedTopic(topic.name, topic.type, topic.publishers)

    def _not_published(self, heard: Sequence[HeardTopic]) -> Iterator[MissingTopic]:
        """Yield the configured names and patterns that no topic fits, by the graph or as heard."""
        is_there = [topic.name for topic in heard if topic.messages or topic.peers]
        is_there += [topic.name for topic in self._published()]
        selection = TopicSelection(self._topics)
        for name in selection.named:
            # a bus that subscribes by prefix has other names below a configured one
            if not any(known.startswith(name) if self._graph is None else known == name
                       for known in is_there):  # fmt: skip
                yield MissingTopic(name, nearest_word(name, is_there) or "")
        for pattern, _ in selection.patterns:
            if not any(map(pattern.fits, is_there)):
                yield MissingTopic(pattern.text, "")
