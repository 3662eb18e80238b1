"""The original messages of a record, all items in order of time, in bounded memory.

``read_originals`` adds the last messages of latched topics before the view.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import Chunk, sequences
from amberbox.blackbox.journal.scan import ChunkPlace
from amberbox.blackbox.query.export_job import (
    ExportJob,
    LazySlice,
    RefreshingCatalogue,
    Window,
    chosen_items,
    journal_slices,
    ordered_windows,
)
from amberbox.blackbox.store.batches import ItemStream
from amberbox.blackbox.store.catalogue import StoreCatalogue
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.journal_reader import JournalFile, sound_chunks
from amberbox.blackbox.store.segment_file import overlaps
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import format_time
from amberbox.core.types import IntArray, Topic

Items = Collection[str] | None


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """Messages of several streams: ``stream[i]`` is the place of a message's in ``streams``."""

    streams: Sequence[ItemStream]
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
    """The messages of some items, None for all of the robot; ``with_box`` adds the box's own."""

    items: Items
    with_box: bool = False

    def wants(self, stream: ItemStream) -> bool:
        """Return whether a stream belongs to the chosen items."""
        if stream.repeated:
            return False
        if stream.source == channels.SOURCE:
            return self.with_box or (self.items is not None and stream.item in self.items)
        return self.items is None or stream.item in self.items

    def streams(self, catalogue: StoreCatalogue) -> list[ItemStream]:
        """List the streams that have messages, in the order they were first seen."""
        found: dict[ItemStream, None] = {}
        existing = frozenset(catalogue.existing)
        for journal in catalogue.journals(skip=()):
            found |= dict.fromkeys(self.of(journal, existing).values())
        return list(found)

    def of(self, journal: JournalFile, existing: Container[str]) -> dict[int, ItemStream]:
        """Return the wanted streams of a file that have messages in it, by channel.

        The last messages of latched topics are repeated at the start of each file; where the file
        before is gone, this is all that is left of it.
        """
        # whether the file before this one in the same run is gone
        head, _, _ = journal.name.rpartition("-")
        stands_in = journal.number > 0 and f"{head}-{journal.number - 1:04d}.mcap" not in existing
        found = {
            number: replace(stream, repeated=False) if stands_in else stream
            for number, stream in journal.streams.items()
            if journal.items.get(stream.item) or (stands_in and stream.repeated)
        }
        return {number: stream for number, stream in found.items() if self.wants(stream)}

    def read(
        self, current: RefreshingCatalogue, window: Window
    ) -> Iterator[tuple[Messages, float]]:
        """Read the messages received in a window, in order; files that go meanwhile are named."""
        places: dict[ItemStream, int] = {}
        return current.read_window(window, lambda rest: self._merged(current, rest, places))

    def _merged(
        self, current: RefreshingCatalogue, window: Window, places: dict[ItemStream, int]
    ) -> Iterator[tuple[Messages, int, float]]:
        parts = sorted(self._parts(current, window, places), key=lambda part: part.start_ns)
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
        self, current: RefreshingCatalogue, window: Window, places: dict[ItemStream, int]
    ) -> Iterator[LazySlice[Messages]]:
        existing = frozenset(current.catalogue.existing)
        for journal in current.catalogue.journals(skip=()):
            numbers = self.of(journal, existing)
            if not numbers:
                continue
            current.note_damage(journal)
            order = journal.run << 2 | _WRITERS.get(journal.writer, 3)
            for stream in numbers.values():
                places.setdefault(stream, len(places))
            table = {number: places[stream] for number, stream in numbers.items()}
            for span in journal_slices(journal, window):
                load = partial(_load, current, journal, table, places, order, span)
                yield LazySlice(span[0], load)


_WRITERS = {"main": 0, "ring": 1, "watch": 2}


def _load(
    current: RefreshingCatalogue,
    journal: JournalFile,
    table: dict[int, int],
    places: dict[ItemStream, int],
    order: int,
    span: tuple[int, int],
) -> Messages:
    """Read the messages that one file received in ``[from, to)`` on the channels of ``table``."""
    clock = ClockTable(journal.clock)
    expected = sum(p.count for p in journal.places if _may_hold(p, clock, span))
    read, found = 0, []
    for chunk in sound_chunks(journal, lambda place: _may_hold(place, clock, span)):
        read += len(chunk)
        found.append(_messages(chunk, journal, clock, table, span))
    if read < expected:
        current.report.miss(f"{journal.name}: {expected - read} messages or more are damaged")
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
    catalogue: StoreCatalogue, chosen: MessageStream, from_ns: int
) -> list[tuple[ItemStream, int, bytes]]:
    """Return the last message that each latched topic had sent before a moment.

    Returns stream, publish time and message. Files begin with repeated latched messages, so only
    the file before the moment has to be read.
    """
    found: dict[str, tuple[ItemStream, int, bytes]] = {}
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
    journal: JournalFile, wanted: dict[int, ItemStream], before_ns: int
) -> dict[str, tuple[ItemStream, int, bytes]]:
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


def without_originals(
    catalogue: StoreCatalogue, chosen: MessageStream, window: Window
) -> Iterator[str]:
    """Yield a text for each item of which only columns are left: its journals are deleted."""
    for item, segments in sorted(catalogue.manifest.segments.items()):
        schema = catalogue.manifest.schemas[segments[0].schema]
        if schema.parent or not chosen.wants(
            ItemStream(item, Topic(schema.topic, ""), schema.source)
        ):
            continue
        parts = [part for segment in segments for part in segment.parts]
        gone = [part for part in parts if part.journal not in catalogue.existing]
        inside = [part for part in gone if overlaps(*part.received_range_ns, window)]
        if inside:
            first = min(part.received_range_ns[0] for part in inside)
            last = max(part.received_range_ns[1] for part in inside)
            yield (
                f"{item}: original messages from {format_time(first)} to {format_time(last)} are "
                f"deleted; their columns ({sum(part.rows for part in inside)} rows) are left: "
                "export mcap-json, csv or parquet"
            )


@dataclass(frozen=True)
class Originals:
    """The available streams, and their messages in order of receipt."""

    streams: list[ItemStream]
    blocks: Iterator[Messages]


def read_originals(job: ExportJob) -> Originals:
    """Choose the messages of a view and read them; items without original messages are reported.

    Each window begins with a copy of the last message of each latched topic, so that a player shows
    it. Raises AmberboxError when there is no message.
    """
    ask = job.current.ask
    items = ask(lambda catalogue: chosen_items(catalogue, job.view))
    chosen = MessageStream(items, job.view.with_box)
    windows = ordered_windows(job.view.windows)
    for window in windows:
        for text in without_originals(job.current.catalogue, chosen, window):
            job.report.miss(text)
    streams = ask(chosen.streams)
    if not streams:
        raise AmberboxError(
            "there are no original messages of these items",
            job.report.missing[0] if job.report.missing else "'amberbox items' lists what there is",
        )
    return Originals(streams, _blocks(job, chosen, windows))


def _blocks(job: ExportJob, chosen: MessageStream, windows: list[Window]) -> Iterator[Messages]:
    for number, window in enumerate(windows):
        if window[0] is not None:
            yield from _latched(job, chosen, window[0])
        for messages, done in chosen.read(job.current, window):
            places, counts = np.unique(messages.stream, return_counts=True)
            for place, count in zip(places.tolist(), counts.tolist(), strict=True):
                job.report.add(messages.streams[place].item, count)
            yield messages
            job.progress((number + done) / len(windows))
    job.progress(1.0)


def _latched(job: ExportJob, chosen: MessageStream, from_ns: int) -> Iterator[Messages]:
    found = job.current.ask(lambda catalogue: latched_before(catalogue, chosen, from_ns))
    if found:
        for stream, _, _ in found:
            job.report.note(f"{stream.item} is latched: its last message stands at the start again")
        yield latched_messages(found, from_ns)


def latched_messages(found: list[tuple[ItemStream, int, bytes]], at_ns: int) -> Messages:
    """Return the last messages of latched topics as if received at one moment."""
    count = len(found)
    times = np.full(count, at_ns)
    return Messages(
        [stream for stream, _, _ in found],
        np.arange(count),
        times,
        np.array([publish_ns for _, publish_ns, _ in found]),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        [message for _, _, message in found],
    )
