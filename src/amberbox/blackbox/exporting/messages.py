"""The messages of a record as they came, all items in order of time, in bounded memory."""

from __future__ import annotations

from collections.abc import Collection, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amberbox.blackbox.exporting.looking import Looking
from amberbox.blackbox.exporting.slices import Part, slices
from amberbox.blackbox.exporting.view import Window
from amberbox.blackbox.follow.batching import Stream
from amberbox.blackbox.follow.read import JournalFile, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.chunk import Chunk, sequences
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.journal.scan import ChunkPlace
from amberbox.blackbox.query.catalogue import Catalogue
from amberbox.blackbox.segments.manifest import Part as ManifestPart
from amberbox.blackbox.segments.manifest import part_clock
from amberbox.blackbox.segments.parquet import overlaps
from amberbox.core.timetext import format_time
from amberbox.core.types import IntArray, Topic

Items = Collection[str] | None


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """Messages of several streams: ``stream[i]`` is the place of a message's in ``streams``."""

    streams: Sequence[Stream]
    stream: IntArray
    received_ns: IntArray
    publish_ns: IntArray
    writer: IntArray
    seq: IntArray
    data: Sequence[bytes]

    def __len__(self) -> int:
        return len(self.data)

    def take(self, rows: IntArray) -> Messages:
        """Return some messages in the order that is given."""
        return Messages(
            self.streams,
            self.stream[rows],
            self.received_ns[rows],
            self.publish_ns[rows],
            self.writer[rows],
            self.seq[rows],
            [self.data[row] for row in rows.tolist()],
        )


@dataclass(frozen=True)
class MessageStream:
    """The messages of some items, None for all that the robot said; ``with_box`` adds ours."""

    items: Items
    with_box: bool = False

    def wants(self, stream: Stream) -> bool:
        """Tell whether a stream belongs to the chosen items."""
        if stream.repeated:
            return False
        if stream.source == reserved.SOURCE:
            return self.with_box or (self.items is not None and stream.item in self.items)
        return self.items is None or stream.item in self.items

    def streams(self, catalogue: Catalogue) -> list[Stream]:
        """List the streams that have messages, in the order they were first seen."""
        found: dict[Stream, None] = {}
        existing = frozenset(catalogue.existing)
        for journal in catalogue.journals(skip=()):
            found |= dict.fromkeys(self.of(journal, existing).values())
        return list(found)

    def of(self, journal: JournalFile, existing: Container[str]) -> dict[int, Stream]:
        """Return the wanted streams of a file that have messages in it, by channel.

        What latched topics had said is repeated at the start of each file; where the file before
        is gone, this is all that is left of it.
        """
        stands_in = _is_first_left(journal, existing)
        found = {
            number: replace(stream, repeated=False) if stands_in else stream
            for number, stream in journal.streams.items()
            if journal.items.get(stream.item) or (stands_in and stream.repeated)
        }
        return {number: stream for number, stream in found.items() if self.wants(stream)}

    def read(self, looking: Looking, window: Window) -> Iterator[tuple[Messages, float]]:
        """Read the messages received in a window, in order; files that go meanwhile are named."""
        places: dict[Stream, int] = {}
        at_ns = window[0]
        while True:
            try:
                for messages, cut_ns, done in self._merged(looking, (at_ns, window[1]), places):
                    if len(messages):
                        yield messages, done
                    at_ns = cut_ns
                    looking.moved_on()
                return
            except FileNotFoundError:
                looking.again()

    def _merged(
        self, looking: Looking, window: Window, places: dict[Stream, int]
    ) -> Iterator[tuple[Messages, int, float]]:
        parts = sorted(self._parts(looking, window, places), key=lambda part: part.start_ns)
        waiting: list[Messages] = []
        for number, part in enumerate(parts):
            waiting.append(part.load())
            block = _in_order(waiting)
            if number + 1 == len(parts):
                yield block, part.start_ns, 1.0
                return
            cut_ns = parts[number + 1].start_ns
            place = int(np.searchsorted(block.received_ns, cut_ns))
            yield block.take(np.arange(place)), cut_ns, (number + 1) / len(parts)
            waiting = [block.take(np.arange(place, len(block)))]

    def _parts(
        self, looking: Looking, window: Window, places: dict[Stream, int]
    ) -> Iterator[Part[Messages]]:
        existing = frozenset(looking.catalogue.existing)
        for journal in looking.catalogue.journals(skip=()):
            numbers = self.of(journal, existing)
            if not numbers:
                continue
            looking.tell_damage(journal)
            order = journal.run << 2 | _WRITERS.get(journal.writer, 3)
            for stream in numbers.values():
                places.setdefault(stream, len(places))
            table = {number: places[stream] for number, stream in numbers.items()}
            for span in slices(journal, window):
                load = partial(_load, looking, journal, table, places, order, span)
                yield Part(span[0], load)


def _is_first_left(journal: JournalFile, existing: Container[str]) -> bool:
    """Tell whether the file before this one in the same run is gone."""
    head, _, _ = journal.name.rpartition("-")
    return journal.number > 0 and f"{head}-{journal.number - 1:04d}.mcap" not in existing


_WRITERS = {"main": 0, "ring": 1, "watch": 2}


def _load(
    looking: Looking,
    journal: JournalFile,
    table: dict[int, int],
    places: dict[Stream, int],
    order: int,
    span: tuple[int, int],
) -> Messages:
    """Read what one file received in ``[from, to)`` on the channels of ``table``."""
    clock = ClockTable(journal.clock)
    expected = sum(p.count for p in journal.places if _may_hold(p, clock, span))
    read, found = 0, []
    for chunk in sound_chunks(journal, lambda place: _may_hold(place, clock, span)):
        read += len(chunk)
        found.append(_messages(chunk, journal, clock, table, span))
    if read < expected:
        looking.report.miss(f"{journal.name}: {expected - read} messages or more are damaged")
    streams = list(places)
    stream, received, publish, seq = (
        np.concatenate([part[n] for part in found]) if found else np.empty(0, np.int64)
        for n in range(4)
    )
    data = [message for *_, messages in found for message in messages]
    return Messages(streams, stream, received, publish, np.full(len(data), order), seq, data)


def _may_hold(place: ChunkPlace, clock: ClockTable, span: Window) -> bool:
    low, high = clock.bounds()
    return overlaps(place.start_ns + low, place.end_ns + high, span)


def _messages(
    chunk: Chunk, journal: JournalFile, clock: ClockTable, table: dict[int, int], span: Window
) -> tuple[IntArray, IntArray, IntArray, IntArray, list[bytes]]:
    received = clock.received(chunk.log_ns)
    inside = np.isin(chunk.channel, list(table))
    inside &= (received >= (span[0] or 0)) & (received < (span[1] or 0))
    rows = np.flatnonzero(inside)
    numbers = np.array([table.get(n, 0) for n in range(int(chunk.channel.max(initial=0)) + 1)])
    publish = np.where(chunk.publish_ns == chunk.log_ns, received, chunk.publish_ns)
    seq = sequences(chunk, journal.first_seq)
    return (
        numbers[chunk.channel[rows]],
        received[rows],
        publish[rows],
        seq[rows],
        chunk.messages(rows),
    )


def _in_order(blocks: Sequence[Messages]) -> Messages:
    """Join blocks and order them by (received, run, writer, seq)."""
    if len(blocks) == 1:
        joined = blocks[0]
    else:
        joined = Messages(
            blocks[-1].streams,
            np.concatenate([block.stream for block in blocks]),
            np.concatenate([block.received_ns for block in blocks]),
            np.concatenate([block.publish_ns for block in blocks]),
            np.concatenate([block.writer for block in blocks]),
            np.concatenate([block.seq for block in blocks]),
            [message for block in blocks for message in block.data],
        )
    order = np.lexsort((joined.seq, joined.writer, joined.received_ns))
    in_order = bool((np.diff(order) == 1).all())
    return joined if in_order else joined.take(order)


def latched_before(
    catalogue: Catalogue, chosen: MessageStream, from_ns: int
) -> list[tuple[Stream, int, bytes]]:
    """Return the last message that each latched topic had sent before a moment.

    Gives stream, publish time and message. Repeated messages at the start of a file count: they
    are why no file has to be read but the one before the moment.
    """
    found: dict[str, tuple[Stream, int, bytes]] = {}
    earlier = [j for j in catalogue.journals(skip=()) if j.places and _starts(j) < from_ns]
    for journal in sorted(earlier, key=_starts, reverse=True):
        wanted = {
            number: replace(stream, repeated=False)
            for number, stream in journal.streams.items()
            if stream.topic.latched and stream.item not in found
        }
        wanted = {number: stream for number, stream in wanted.items() if chosen.wants(stream)}
        if wanted:
            found |= _last_messages(journal, wanted, from_ns)
    return list(found.values())


def _starts(journal: JournalFile) -> int:
    return journal.start_ns + ClockTable(journal.clock).bounds()[0]


def _last_messages(
    journal: JournalFile, wanted: dict[int, Stream], before_ns: int
) -> dict[str, tuple[Stream, int, bytes]]:
    clock = ClockTable(journal.clock)
    found = {}
    for chunk in sound_chunks(journal, lambda p: _may_hold(p, clock, (None, before_ns))):
        earlier = clock.received(chunk.log_ns) < before_ns
        for number in np.unique(chunk.channel).tolist():
            rows = np.flatnonzero(earlier & (chunk.channel == number))
            if number in wanted and len(rows):
                stream, (message,) = wanted[number], chunk.messages(rows[-1:])
                found[stream.item] = stream, int(chunk.publish_ns[rows[-1]]), message
    return found


def without_originals(catalogue: Catalogue, chosen: MessageStream, window: Window) -> Iterator[str]:
    """Say of which items, and when, only columns are left: their journals are deleted."""
    for item, segments in sorted(catalogue.manifest.segments.items()):
        schema = catalogue.manifest.schemas[segments[0].schema]
        if schema.parent or not chosen.wants(Stream(item, Topic(schema.topic, ""), schema.source)):
            continue
        parts = [part for segment in segments for part in segment.parts]
        gone = [_span(part) for part in parts if part.journal not in catalogue.existing]
        inside = [span for span in gone if overlaps(span[0], span[1], window)]
        if inside:
            first, last = min(low for low, _, _ in inside), max(high for _, high, _ in inside)
            yield (
                f"{item}: original messages from {format_time(first)} to {format_time(last)} are "
                f"deleted; their columns ({sum(rows for _, _, rows in inside)} rows) are left: "
                "export mcap-json, csv or parquet"
            )


def _span(part: ManifestPart) -> tuple[int, int, int]:
    """Return first and last time of receipt, and rows."""
    edges = np.array([part.from_ns, part.to_ns])
    first, last = ClockTable(part_clock(part)).received(edges).tolist()
    return first, last, part.rows
