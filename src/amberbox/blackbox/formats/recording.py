"""A recording made by others: its topics, its messages in the order of time, what is broken."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

from amberbox.core.types import Schema, Topic

_topic_index, _log_time = itemgetter(0), itemgetter(1)
_offset, _end = itemgetter(0), itemgetter(1)


class RecordedMessage(NamedTuple):
    """One message as it stands in the file; ``topic_index`` points into the topics."""

    topic_index: int
    log_time_ns: int
    publish_time_ns: int | None
    data: bytes


class Stretch(NamedTuple):
    """A piece of a file that can be read, and the times of its messages."""

    offset: int
    end: int
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class Damage:
    """A range of a file that could not be read, and why.

    ``span_ns`` are the times that its messages may be of; None if they may be of any.
    """

    file: str
    offset: int
    length: int
    reason: str
    span_ns: tuple[int, int] | None = field(default=None, compare=False)

    def between(self, places: Sequence[Stretch]) -> Damage:
        """Return the same with its times: from what is read before it to what is read after it.

        ``places`` come in the order of the file; one that is damaged itself counts whole.
        """
        first = bisect_right(places, self.offset, key=_end)
        after = bisect_left(places, self.offset + self.length, lo=first, key=_offset)
        edges = [place.end_ns for place in places[max(first - 1, 0) : first]]
        edges += [ns for place in places[first:after] for ns in (place.start_ns, place.end_ns)]
        edges += [place.start_ns for place in places[after : after + 1]]
        return replace(self, span_ns=(min(edges), max(edges)) if edges else None)

    def __str__(self) -> str:
        where = f"{self.file}: {self.length} bytes at byte {self.offset}"
        return f"{where}: {self.reason}"


@dataclass(frozen=True, slots=True)
class RecordedGap:
    """A time in which the recording itself says that it heard nothing."""

    from_ns: int
    to_ns: int
    reason: str


@dataclass
class Account:
    """What became of the pieces of one file: each is a message of these topics, or refused."""

    name: str
    pieces: str
    total: int = 0
    topics: tuple[int, ...] = ()
    refused: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class Origin:
    """What a format knows of a topic beside its definition.

    ``source`` is the first word of the item name, empty if the topic's name is all of it;
    ``stamp`` as in the options of a topic; ``kind`` says where the columns come from.
    """

    source: str = "ros"
    stamp: str | None = None
    kind: str = ""


_LIVE = Origin()


@dataclass
class Report:
    """What was found in a recording; the counts grow while its messages are read.

    ``notes`` say what was assumed, such as the ROS distribution that definitions are taken from.
    """

    format: str
    start_ns: int | None = None
    end_ns: int | None = None
    messages: int = 0
    per_topic: list[int] = field(default_factory=list)
    damage: list[Damage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    accounts: list[Account] = field(default_factory=list)
    gaps: list[RecordedGap] = field(default_factory=list)

    def add_damage(self, damage: Damage) -> None:
        """Note a damaged range once, however often it is read."""
        if damage not in self.damage:
            self.damage.append(damage)

    def add_note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    def lines(self, topics: Sequence[Topic]) -> list[str]:
        """Write the report for a person, one line per fact."""
        counts = [f"  {t.name}: {n}" for t, n in zip(topics, self.per_topic, strict=False)]
        damage = [f"damaged: {d}" for d in self.damage]
        return [f"{self.format}: {self.messages} messages", *counts, *damage, *self.notes]


class TopicTable:
    """The topics of a recording; the same topic of several connections or files is one."""

    def __init__(self) -> None:
        self.topics: list[Topic] = []
        self.origins: list[Origin] = []
        self._places: dict[tuple[str, str, Schema | None, Origin], int] = {}

    def add(self, topic: Topic, origin: Origin = _LIVE) -> int:
        """Return the index of a topic; it is latched if any of its connections is."""
        key = (topic.name, topic.message_encoding, topic.schema, origin)
        place = self._places.setdefault(key, len(self.topics))
        if place == len(self.topics):
            self.topics.append(topic)
            self.origins.append(origin)
        elif topic.latched:
            self.topics[place] = topic
        return place


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A stretch of a recording that is read at once, such as a chunk.

    ``load`` gives its messages in the order of the file; ``size`` is what it counts for in the
    progress.
    """

    start_ns: int
    end_ns: int
    size: int
    load: Callable[[], list[RecordedMessage]]


class Recording:
    """A recording that is open for reading; a context manager.

    Every format is a function that finds topics and parts and gives them to this class.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[Topic],
        parts: Sequence[Part],
        report: Report,
        close: Callable[[], None] = lambda: None,
        origins: Sequence[Origin] = (),
    ) -> None:
        self.path = path
        self.topics = tuple(topics)
        self.origins = tuple(origins) or (_LIVE,) * len(self.topics)
        self.report = report
        self.progress = 0.0
        """Fraction of the recording that ``messages`` has given out."""
        self.close = close
        self._parts = sorted(parts, key=lambda part: part.start_ns)
        if parts:
            report.start_ns = min(part.start_ns for part in parts)
            report.end_ns = max(part.end_ns for part in parts)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def messages(
        self, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Give the messages in the order of log time, those of ``[from_ns, to_ns)`` if given.

        Only parts that overlap in time are held in memory together. The order of messages of the
        same time is that of the file. Counts and damage go to ``report``.
        """
        return chain.from_iterable(self._blocks(from_ns, to_ns))

    def _blocks(self, from_ns: int | None, to_ns: int | None) -> Iterator[list[RecordedMessage]]:
        self.report.messages, self.report.per_topic = 0, [0] * len(self.topics)
        parts = [part for part in self._parts if _overlaps(part, from_ns, to_ns)]
        total, done = max(1, sum(part.size for part in parts)), 0
        for block, size in _in_time_order(parts, self._load):
            done += size
            self.progress = done / total
            inside = _between(block, from_ns, to_ns)
            self._count(inside)
            yield inside
        self.progress = 1.0

    def _load(self, part: Part) -> list[RecordedMessage]:
        """Load a part; damage that is found on the way lies in its time."""
        known = len(self.report.damage)
        messages = part.load()
        self.report.damage[known:] = [
            replace(damage, span_ns=damage.span_ns or (part.start_ns, part.end_ns))
            for damage in self.report.damage[known:]
        ]
        return messages

    def _count(self, block: Sequence[RecordedMessage]) -> None:
        self.report.messages += len(block)
        for topic_index, count in Counter(map(_topic_index, block)).items():
            self.report.per_topic[topic_index] += count


def _in_time_order(
    parts: Sequence[Part], load: Callable[[Part], list[RecordedMessage]]
) -> Iterator[tuple[list[RecordedMessage], int]]:
    """Merge parts sorted by their start; each block comes with the size of the part read for it."""
    pending: list[RecordedMessage] = []
    for number, part in enumerate(parts):
        pending += load(part)
        pending.sort(key=_log_time)
        if number + 1 < len(parts):
            cut = bisect_left(pending, parts[number + 1].start_ns, key=_log_time)
            yield pending[:cut], part.size
            del pending[:cut]
        else:
            yield pending, part.size


def _overlaps(part: Part, from_ns: int | None, to_ns: int | None) -> bool:
    before_end = to_ns is None or part.start_ns < to_ns
    return before_end and (from_ns is None or part.end_ns >= from_ns)


def _between(
    block: list[RecordedMessage], from_ns: int | None, to_ns: int | None
) -> list[RecordedMessage]:
    low = 0 if from_ns is None else bisect_left(block, from_ns, key=_log_time)
    high = len(block) if to_ns is None else bisect_left(block, to_ns, key=_log_time)
    return block if high - low == len(block) else block[low:high]
