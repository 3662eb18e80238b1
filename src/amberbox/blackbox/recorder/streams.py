"""One topic on its way into the journal: its item, its filters, its counters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, TypeAlias

import msgspec
from msgspec import structs

from amberbox.blackbox.filters.change import ChangeFilter
from amberbox.blackbox.filters.rate import RateLimit
from amberbox.blackbox.unroll import Unroller, unroller
from amberbox.blackbox.unroll.notes import Notes
from amberbox.blackbox.unroll.select import select
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.core.types import ItemSchema, Topic

_WRITERS = {"all": "main", "bulk": "bulk"}


class Counters(msgspec.Struct):
    """What happened to an item's messages since the start of the run.

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
        """Return the counters as they are written; only what was lost may be left out.

        Servers of earlier versions know no such counter.
        """
        values = structs.asdict(self)
        return values if self.lost else {k: v for k, v in values.items() if k != "lost"}


Drops: TypeAlias = tuple[int, int, int]
"""First and last time and count of messages dropped since the last gap record."""

QUEUE_FULL = "queue full"


class Tell(Protocol):
    """How an event is written: kind, one line for a person, the source, details."""

    def __call__(self, kind: str, text: str, source: str = "", **details: Any) -> None:
        """Write the event."""


@dataclass(slots=True)
class Item:
    """A data item: what is configured for it, and what all its streams share."""

    name: str
    source: str
    topic: str
    options: TopicOptions
    counters: Counters = field(default_factory=Counters)
    rate: RateLimit | None = None
    drops: dict[str, Drops] = field(default_factory=dict)
    """What the box had to drop since it was last written down, by reason."""
    last_latched: bytes | None = None
    reported: Counters = field(default_factory=Counters)
    waits: bool = False
    """Whether its source waits for room, as a file does, instead of being lost."""
    malformed: int = 0
    widened_ns: dict[str, int] = field(default_factory=dict)
    """When its schema got ``new`` or ``wider`` variables last."""
    versions: int = 0
    """How many schemas have been inferred for its messages."""
    stamp_told: bool = False
    """Whether it has been told that the messages' own stamp is no time."""
    unused: tuple[str, ...] = ()
    """Names in the options that fit no variable, as told last."""

    def __post_init__(self) -> None:
        if self.options.max_frequency:
            self.rate = RateLimit(self.options.max_frequency)

    def drop(self, received_ns: int, reason: str) -> None:
        """Count a message that is not kept though it should be."""
        self.counters.dropped += 1
        first, last, count = self.drops.get(reason, (received_ns, received_ns, 0))
        self.drops[reason] = (min(first, received_ns), max(last, received_ns), count + 1)

    @property
    def writer(self) -> str:
        """Journal that this item's keeping class is written to."""
        return _WRITERS.get(self.options.keep, "ring")

    def describe(self) -> dict[str, Any]:
        """Say in the run record what is configured for the item."""
        options = asdict(self.options)
        return {
            "source": self.source,
            "topic": self.topic,
            "type": self.options.type,
            "variables": list(self.options.variable_names),
            "max_frequency": self.options.max_frequency,
            "keep": self.options.keep,
            "change": options["change"],
        }


@dataclass(slots=True)
class Stream:
    """One definition of an item's messages; a change of type makes another stream."""

    item: Item
    topic: Topic
    channel: int = -1
    stamps: Unroller | None = None
    infers: bool = False
    told: Notes = field(default_factory=dict)
    """What its sender says of units and codes, where the schema is inferred."""
    letters: bool = False
    """Whether inferred variables keep what words of other scripts say in their names."""
    change: ChangeFilter | None = None

    @property
    def counters(self) -> Counters:
        """Counters of the item."""
        return self.item.counters

    def columns(self) -> dict[str, str]:
        """Return paths and types of the variables, those of child tables included."""
        return {} if self.stamps is None else dict(_columns(self.stamps.schema))

    def drop(self, received_ns: int, reason: str = QUEUE_FULL) -> None:
        """Count a message that found no room."""
        self.item.drop(received_ns, reason)

    def stamp_ns(self, data: bytes) -> int | None:
        """Return the message's own time stamp, if it has one."""
        return None if self.stamps is None else self.stamps.stamp_ns(data)

    def compile(self) -> str:
        """Build unroller and change filter before the first row; return what is wrong with them."""
        options = self.item.options
        try:
            self.stamps = unroller(self.topic, options.stamp)
            if options.change is not None:
                self.change = ChangeFilter(options.change, self.stamps.schema)
        except AmberboxError as error:
            return error.what
        return ""


def _columns(schema: ItemSchema, above: str = "") -> Iterator[tuple[str, str]]:
    yield from ((above + column.path, column.type) for column in schema.columns)
    for path, child in schema.children.items():
        yield from _columns(child, f"{above}{path}/")


def tell_no_stamp(stream: Stream, data: bytes, tell: Tell) -> None:
    """Say once of an item that what it has for a stamp is no time."""
    item, stamps = stream.item, stream.stamps
    if item.stamp_told or stamps is None or not stamps.schema.stamp:
        return
    found = stamps.no_stamp(data)
    if found is not None:
        item.stamp_told = True
        path, value = stamps.schema.stamp, str(found)[:40]
        text = f"{item.name}: {path} is {value}, which is no time; the time of receipt counts"
        tell("no_stamp", text, item.source, item=item.name, path=path)


def tell_unused(stream: Stream, tell: Tell) -> None:
    """Say which names in an item's options fit no variable, each time others do not."""
    if stream.stamps is None:
        return
    item = stream.item
    _, unmatched = select(stream.stamps.schema, item.options.variable_names)
    unused = (*unmatched, *(stream.change.unused if stream.change else ()))
    if unused and unused != item.unused:
        text = f"{item.name} has no {' or '.join(dict.fromkeys(unused))}, as configured"
        tell("unused_names", text, item.source, item=item.name, names=unused)
    item.unused = unused
