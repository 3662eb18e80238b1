"""The recorder's queue, and the streams and items whose messages pass through it.

The queue is bounded and never blocks a live source; every drop is counted. A batch first passes the
rate limit; then schemas are inferred from the remaining messages; then unchanged messages are
dropped.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from operator import itemgetter
from typing import Any, Protocol, TypeAlias

import msgspec
import numpy as np
from msgspec import structs

from amberbox.blackbox.columns import Unroller, UnrollError
from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.columns.json_schema import ValueNotes
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.columns.variables import select_columns
from amberbox.blackbox.filters.change import ChangeFilter
from amberbox.blackbox.filters.rate import RateLimit
from amberbox.blackbox.filters.transforms import TransformFilter
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.core.types import ItemSchema, Topic

_WRITERS = {"all": "main", "bulk": "bulk"}


class ItemCounters(msgspec.Struct):
    """Counts of an item's messages since the start of the run.

    ``lost`` never reached the box, so it is no part of ``received``.
    """

    received: int = 0
    kept: int = 0
    rate_limited: int = 0
    unchanged: int = 0
    dropped: int = 0
    bytes: int = 0
    last_received_ns: int = 0
    lost: int = 0

    def record(self) -> dict[str, int]:
        """Return the counters as a record; ``lost`` is left out when it is 0.

        Servers of earlier versions do not know that counter.
        """
        values = structs.asdict(self)
        return values if self.lost else {k: v for k, v in values.items() if k != "lost"}


# first and last time and count of messages dropped since the last gap record
Drops: TypeAlias = tuple[int, int, int]

QUEUE_FULL = "queue full"


class EmitEvent(Protocol):
    """Emits an event: its kind, one line for a person, the source, details."""

    def __call__(self, kind: str, text: str, source: str = "", **details: Any) -> None:
        """Emit the event."""


@dataclass(slots=True)
class DataItem:
    """A data item: its options, and the state that all its streams share."""

    name: str
    source: str
    topic: str
    options: TopicOptions
    counters: ItemCounters = field(default_factory=ItemCounters)
    rate: RateLimit | None = None
    # drops since the last gap record, by reason
    drops: dict[str, Drops] = field(default_factory=dict)
    last_latched: bytes | None = None
    reported: ItemCounters = field(default_factory=ItemCounters)
    waits: bool = False  # whether its source waits for room in the queue, as a file does
    malformed: int = 0
    # when its schema got ``new`` or ``wider`` variables last
    widened_ns: dict[str, int] = field(default_factory=dict)
    versions: int = 0  # how many schemas have been inferred for its messages
    stamp_reported: bool = False  # whether an event about invalid stamps was emitted
    unused: tuple[str, ...] = ()  # names in the options that fit no variable, as reported last
    written_ns: int = 0  # time of the newest message recorded; later ones are not before it
    raised: int = 0  # messages later than their source may be, since the last event about them
    raised_ns: int | None = None  # when that event was

    def __post_init__(self) -> None:
        if self.options.max_frequency:
            self.rate = RateLimit(self.options.max_frequency)

    def drop(self, received_ns: int, reason: str) -> None:
        """Count a dropped message."""
        self.drop_all((received_ns, received_ns, 1), reason)

    def drop_all(self, drops: Drops, reason: str) -> None:
        """Count dropped messages."""
        self.counters.dropped += drops[2]
        first, last, count = self.drops.get(reason, (drops[0], drops[1], 0))
        self.drops[reason] = (min(first, drops[0]), max(last, drops[1]), count + drops[2])

    @property
    def writer(self) -> str:
        """Return the writer of this item's keeping class."""
        return _WRITERS.get(self.options.keep, "ring")

    def describe(self) -> dict[str, Any]:
        """Return the configuration of the item for the run record."""
        options = asdict(self.options)
        return {
            "source": self.source,
            "topic": self.topic,
            "type": self.options.type,
            "variables": list(self.options.variable_names),
            "max_frequency": self.options.max_frequency,
            "keep": self.options.keep,
            "change": options["change"],
            **{key: options[key] for key in ("image", "transforms") if options[key] is not None},
        }


@dataclass(slots=True)
class TopicStream:
    """The messages of an item with one definition; a change of type begins another stream."""

    item: DataItem
    topic: Topic
    channel: int = -1
    stamps: Unroller | None = None
    infers: bool = False
    # units and labels that its sender states, where the schema is inferred
    sender_notes: ValueNotes = field(default_factory=dict)
    # whether names of inferred variables are transliterated from other scripts
    letters: bool = False
    change: ChangeFilter | None = None
    transforms: TransformFilter | None = None
    limited: bool = False  # whether the rate limit was applied before the queue
    note: str = ""  # what was done to the messages before they were recorded

    @property
    def counters(self) -> ItemCounters:
        """Return the counters of the item."""
        return self.item.counters

    def columns(self) -> dict[str, str]:
        """Return paths and types of the variables, those of child tables included."""
        return {} if self.stamps is None else dict(_columns(self.stamps.schema))

    def drop(self, received_ns: int, reason: str = QUEUE_FULL) -> None:
        """Count a message that did not fit into the queue."""
        self.item.drop(received_ns, reason)

    def stamp_ns(self, data: bytes) -> int | None:
        """Return the message's own time stamp, if it has one."""
        return None if self.stamps is None else self.stamps.stamp_ns(data)

    def compile(self) -> str:
        """Build unroller and change filter; return the error text, empty on success."""
        options = self.item.options
        try:
            self.stamps = unroller(self.topic, options.stamp)
            if options.change is not None:
                self.change = ChangeFilter(options.change, self.stamps.schema)
            if options.transforms is not None:
                self.transforms = TransformFilter(options.transforms, self.stamps.schema)
        except AmberboxError as error:
            return error.what
        return ""


def _columns(schema: ItemSchema, above: str = "") -> Iterator[tuple[str, str]]:
    yield from ((above + column.path, column.type) for column in schema.columns)
    for path, child in schema.children.items():
        yield from _columns(child, f"{above}{path}/")


def report_bad_stamp(stream: TopicStream, data: bytes, emit: EmitEvent) -> None:
    """Emit an event, once per item, when the value of its stamp is not a time."""
    item, stamps = stream.item, stream.stamps
    if item.stamp_reported or stamps is None or not stamps.schema.stamp:
        return
    found = stamps.no_stamp(data)
    if found is not None:
        item.stamp_reported = True
        path, value = stamps.schema.stamp, str(found)[:40]
        text = f"{item.name}: {path} is {value}, which is no time; the time of receipt counts"
        emit("no_stamp", text, item.source, item=item.name, path=path)


def report_unused_names(stream: TopicStream, emit: EmitEvent) -> None:
    """Emit an event when other names in an item's options than before fit no variable."""
    if stream.stamps is None:
        return
    item = stream.item
    _, unmatched = select_columns(stream.stamps.schema, item.options.variable_names)
    unused = (*unmatched, *(stream.change.unused if stream.change else ()))
    if unused and unused != item.unused:
        text = f"{item.name} has no {' or '.join(dict.fromkeys(unused))}, as configured"
        emit("unused_names", text, item.source, item=item.name, names=unused)
    item.unused = unused


# number of schemas of an item after which new keys of its messages get no columns
OPEN_VERSIONS = 32
MOST_VERSIONS = 256  # most schemas of an item; messages that do not fit the last one stay raw
QUIET_NS = 60_000_000_000  # schema changes within this time of each other are one event

StreamMessage: TypeAlias = tuple[TopicStream, bytes, int]


RAISED_NS = 100_000_000  # a time of receipt that is moved by less is no loss of order


def rate_limited(taken: Iterable[StreamMessage], floor_ns: int, now_ns: int) -> list[StreamMessage]:
    """Return the messages that pass the rate limits, in order of time, none before ``floor_ns``.

    Those of an item are not before what was recorded of it earlier.
    """
    kept: list[StreamMessage] = []
    for message in taken:
        stream, _, received_ns = message
        item = stream.item
        if item.options.keep == "none":
            continue
        least_ns = max(floor_ns, item.written_ns)
        if not least_ns <= received_ns <= now_ns:  # stamped before the watermark or a new epoch
            item.raised += least_ns - received_ns > RAISED_NS
            message = (stream, message[1], min(max(received_ns, least_ns), now_ns))
        rate = None if stream.limited else item.rate
        if rate is not None and not rate.accept(message[2]):
            item.counters.rate_limited += 1
            continue
        kept.append(message)
    kept.sort(key=itemgetter(2))
    return kept


def change_filtered(kept: list[StreamMessage], emit: EmitEvent) -> list[StreamMessage]:
    """Infer schemas; return the messages without unchanged ones of items with a change filter."""
    places: dict[int, list[int]] = {}
    for place, (stream, _, _) in enumerate(kept):
        options = stream.item.options
        if stream.infers or options.change is not None or options.transforms is not None:
            places.setdefault(id(stream), []).append(place)
    unchanged: set[int] = set()
    earlier: dict[int, list[StreamMessage]] = {}  # messages dropped before that are kept after all
    for found in places.values():
        stream = kept[found[0]][0]
        if stream.infers:
            _infer(stream, [kept[place][1] for place in found], kept[found[-1]][2], emit)
        if stream.item.options.change is not None or stream.transforms is not None:
            unchanged.update(_unchanged(stream, kept, found, earlier))
    if not unchanged and not earlier:
        return kept
    return [
        message
        for place, last in enumerate(kept)
        if place not in unchanged
        for message in (*earlier.get(place, ()), last)
    ]


def _infer(stream: TopicStream, messages: Sequence[bytes], now_ns: int, emit: EmitEvent) -> None:
    """Widen a stream's schema so that it fits all these messages; emit an event if it is wider."""
    topic, item = stream.topic, stream.item
    if item.versions >= MOST_VERSIONS:
        return
    closes = item.versions >= OPEN_VERSIONS
    schema, bad = widen_schema(
        topic.schema,
        messages,
        topic.message_encoding,
        item.name,
        stream.sender_notes,
        closes=closes,
        letters=stream.letters,
    )
    if bad:
        _note_malformed(stream, len(bad), emit)
    if schema is topic.schema:
        return
    before = None if topic.schema is None else stream.columns()
    item.versions += 1
    if item.versions == MOST_VERSIONS:
        text = f"{item.name} had {MOST_VERSIONS} schemas; what does not fit the last one stays raw"
        emit("schema_unstable", text, item.source, item=item.name)
    stream.topic = Topic(topic.name, topic.message_encoding, schema, topic.latched)
    stream.channel = -1
    stream.compile()
    if before is not None:
        _report_widened(stream, before, now_ns, emit)
    report_unused_names(stream, emit)


def _report_widened(
    stream: TopicStream, before: Mapping[str, str], now_ns: int, emit: EmitEvent
) -> None:
    """Emit an event about a changed schema, once for changes that follow each other."""
    item, after = stream.item, stream.columns()
    new = [path for path in after if path not in before]
    is_wider = any(after.get(path, kind) != kind for path, kind in before.items())
    change = "wider" if is_wider and not new else "new"
    last_ns = item.widened_ns.get(change)
    item.widened_ns[change] = now_ns
    if last_ns is not None and now_ns - last_ns < QUIET_NS:
        return
    text = f"{item.name} has wider variables"
    if new:
        more = f" and {len(new) - 3} more" if len(new) > 3 else ""
        names = ", ".join(name[:60] for name in new[:3])
        limit = f"new keys get columns until it has had {OPEN_VERSIONS} schemas"
        text = f"{item.name} has new variables: {names}{more} ({limit})"
    elif not is_wider:
        text = f"{item.name} has had {OPEN_VERSIONS} schemas: new keys get no columns any more"
    emit("schema_widened", text, item.source, item=item.name)


def _note_malformed(stream: TopicStream, count: int, emit: EmitEvent) -> None:
    item = stream.item
    if not item.malformed:
        encoding = stream.topic.message_encoding
        text = f"{item.name}: a message is no valid {encoding}, or nested too deep; kept as it came"
        emit("malformed", text, item.source, item=item.name)
    item.malformed += count


def _unchanged(
    stream: TopicStream,
    kept: list[StreamMessage],
    places: list[int],
    earlier: dict[int, list[StreamMessage]],
) -> list[int]:
    """Return the places of messages that the change filter drops; malformed ones stay.

    Messages of batches before that it keeps now are added to ``earlier``, by the next place.
    """
    if stream.stamps is None or (stream.change is None and stream.transforms is None):
        return []
    messages = [kept[place][1] for place in places]
    try:
        rows = stream.stamps.rows(messages)
    except UnrollError as error:
        bad = {places[row] for row in error.bad}
        rest = [place for place in places if place not in bad]
        return _unchanged(stream, kept, rest, earlier) if rest else []
    times = np.fromiter((kept[place][2] for place in places), np.int64, len(places))
    if stream.transforms is not None:
        chosen = stream.transforms.select(rows, times, messages)
        for row, data in chosen.earlier:
            place = places[row]
            earlier.setdefault(place, []).append((stream, data, kept[place][2]))
        mask = chosen.kept
        stream.counters.unchanged -= len(chosen.earlier)
    else:
        assert stream.change is not None
        mask = stream.change.mask(rows, times).tolist()
    dropped = [place for place, keep in zip(places, mask, strict=True) if not keep]
    stream.counters.unchanged += len(dropped)
    return dropped


_OVERHEAD = 120  # bytes of a queued message beside its payload


@dataclass
class MessageQueue:
    """Bounded queue between the sources' threads and the writer."""

    limit_bytes: int
    wake: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._room = threading.Condition()
        self._queue: list[tuple[TopicStream, bytes, int]] = []
        self._bytes = 0
        self._waiting_bytes = 0
        self._waits_no_more = False

    def put(self, stream: TopicStream, data: bytes, received_ns: int) -> None:
        """Queue a message, or drop and count it when the queue is full. Never blocks."""
        size = len(data) + _OVERHEAD
        with self._room:
            stream.counters.received += 1
            stream.counters.last_received_ns = received_ns
            if self._bytes + self._waiting_bytes + size > self.limit_bytes:
                stream.drop(received_ns)
                return
            self._bytes += size
            self._queue.append((stream, data, received_ns))

    def put_waiting(self, stream: TopicStream, data: bytes, received_ns: int) -> None:
        """Queue a message of a file; blocks while the queue is full, until ``wait_no_more``."""
        size = len(data) + _OVERHEAD
        with self._room:
            while self._is_full_for(size):
                if self._waits_no_more:
                    return
                self.wake.set()
                self._room.wait(1.0)
            stream.counters.received += 1
            stream.counters.last_received_ns = received_ns
            self._bytes += size
            self._queue.append((stream, data, received_ns))

    def _is_full_for(self, size: int) -> bool:
        """Return whether the queue is full; an empty queue accepts one message of any size."""
        used = self._bytes + self._waiting_bytes
        return used > 0 and used + size > self.limit_bytes

    def wait_no_more(self) -> None:
        """Release the threads that wait for room: the recording ends."""
        with self._room:
            self._waits_no_more = True
            self._room.notify_all()

    def refuse(self, messages: Iterable[tuple[DataItem, int]], reason: str) -> None:
        """Count messages as dropped that were dequeued but found no room on the disk."""
        with self._room:
            for item, received_ns in messages:
                item.drop(received_ns, reason)

    def count_rate_limited(self, stream: TopicStream, received_ns: int) -> None:
        """Count a message as received and dropped by the rate limit before it was put here."""
        with self._room:
            stream.counters.received += 1
            stream.counters.last_received_ns = max(stream.counters.last_received_ns, received_ns)
            stream.counters.rate_limited += 1

    def count_dropped(
        self, stream: TopicStream, from_ns: int, to_ns: int, count: int, reason: str = QUEUE_FULL
    ) -> None:
        """Count messages as received and dropped before they were put here."""
        with self._room:
            stream.counters.received += count
            stream.counters.last_received_ns = max(stream.counters.last_received_ns, to_ns)
            stream.item.drop_all((from_ns, to_ns, count), reason)

    def count_lost(self, item: DataItem, count: int) -> None:
        """Count messages that a source found missing between those received."""
        with self._room:
            item.counters.lost += count

    def take_drops(self, item: DataItem) -> dict[str, Drops]:
        """Return the drops of an item since the last call, by reason."""
        with self._room:
            drops, item.drops = item.drops, {}
        return drops

    def shift_drops(self, items: Iterable[DataItem], step_ns: int) -> None:
        """Shift the times of drops to a new epoch of log time."""
        with self._room:
            for item in items:
                for reason, (first_ns, last_ns, count) in item.drops.items():
                    item.drops[reason] = (first_ns + step_ns, last_ns + step_ns, count)

    @property
    def longest_bytes(self) -> int:
        """Return the bytes of the longest message that the empty queue accepts."""
        return max(0, self.limit_bytes - _OVERHEAD)

    @property
    def size_bytes(self) -> int:
        """Return the bytes in the queue, those being written included."""
        return self._bytes + self._waiting_bytes

    def take(self) -> list[tuple[TopicStream, bytes, int]]:
        """Return and remove all queued messages; their bytes count until ``release``."""
        with self._room:
            taken, self._queue = self._queue, []
            self._waiting_bytes += self._bytes
            self._bytes = 0
        return taken

    def give_back(self, messages: Sequence[tuple[TopicStream, bytes, int]]) -> None:
        """Put dequeued messages back to the front of the queue."""
        with self._room:
            self._queue[:0] = messages
            self._bytes += sum(len(data) + _OVERHEAD for _, data, _ in messages)

    def release(self) -> None:
        """Free the room of the dequeued messages: they have been written."""
        with self._room:
            self._waiting_bytes = 0
            self._room.notify_all()
