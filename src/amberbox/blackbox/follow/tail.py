"""One writer's journal, file after file and chunk after chunk, from a position on."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.follow.batching import Origin, Stream, make_batch, stream_of
from amberbox.blackbox.follow.chunkrows import (
    by_item,
    clock_points,
    gap_records,
    runs_of_channel,
)
from amberbox.blackbox.follow.deleted import (
    FORGOTTEN,
    LOST,
    GoneJournal,
    GoneList,
    outline_of,
    rows_of_gone,
)
from amberbox.blackbox.follow.joining import joined
from amberbox.blackbox.follow.read import (
    JournalFile,
    journal_file,
    missing,
    newest_first,
    sound_chunks,
)
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.chunk import Chunk, sequences
from amberbox.blackbox.journal.clocktable import ClockTable, held_points
from amberbox.blackbox.journal.head import Head, read_head
from amberbox.blackbox.journal.scan import ChunkPlace, start_record
from amberbox.blackbox.journal.summary import read_summary
from amberbox.blackbox.journal.walk import Metadata, Walk
from amberbox.blackbox.store import Store, is_locked, run_and_number
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Cursor, Gap, IntArray, Schema, Watermark, WriterCursor

Delivery = Batch | Gap | Watermark


@dataclass(slots=True)
class _Live:
    """What is known of the file that is still being written."""

    path: Path
    at: int = 0
    tag: str = ""
    trusted: int = 0
    first_seq: int = 0
    schemas: dict[int, Schema] = field(default_factory=dict)
    streams: dict[int, Stream] = field(default_factory=dict)
    clock: list[tuple[int, int]] = field(default_factory=list)


class WriterTail:
    """Delivers one writer's rows once each and in order; ``step`` gives what is new."""

    def __init__(
        self, store: Store, writer: str, items: Collection[str] | None, start: WriterCursor
    ) -> None:
        self.store = store
        self.writer = writer
        self.items = items
        self.run, self.seq, self.ahead = start.run, start.seq, dict(start.ahead)
        self._done: tuple[int, int] = (-1, -1)
        self._ends_at: tuple[int, int] = (-1, 0)
        self._live: _Live | None = None
        self._gone = GoneList(store, writer)
        self.last_ns: int | None = None
        self._watermark: tuple[int, int, int] = (0, 0, 0)

    def position(self) -> WriterCursor:
        """Where this tail stands."""
        return WriterCursor(self.run, self.seq, dict(self.ahead))

    def step(self) -> Iterator[Delivery]:
        """Yield what has come since the last step."""
        head = read_head(self.store.folder(self.writer))  # before the files: never too much
        files = [p for p in self.store.journal_files(self.writer) if run_and_number(p) > self._done]
        alive = is_locked(self.store, self.writer)  # after the files: nobody writes these any more
        gone = self._gone.since(self._done, files)
        with suppress(FileNotFoundError):  # deleted meanwhile: the next step says what is missing
            files = files[_first_of_interest(files, self.run, self.seq) :]
            for path in files:
                yield from self._deleted_before(gone, run_and_number(path))
                if path is files[-1] and alive and not _is_finished(path):
                    yield from self._grow(path)
                else:
                    yield from self._static(path)
            yield from self._deleted_before(gone, None)
        if head is not None:
            yield from self._watermark_of_head(head)

    def _static(self, path: Path) -> Iterator[Delivery]:
        """Deliver the rest of a file that nobody writes any more."""
        journal = journal_file(path, f"{path.parent.name}/{path.name}")
        self._live = None
        if journal.places:
            yield from self._enter(journal.run, journal.first_seq, journal)
        clock = ClockTable(held_points(journal.readings), held=True)
        skip_before = _skipper(journal, self.run, self.seq)
        chunks = sound_chunks(journal, skip_before)
        for chunk in joined(chunks, journal.first_seq, self._wanted(journal.streams)):
            yield from self._deliver(chunk, journal, clock, journal.streams)
        yield from self._missing_end(journal)
        self._ends_at = (journal.run, journal.end_seq)
        self._done = run_and_number(path)

    def _wanted(self, streams: Mapping[int, Stream]) -> frozenset[int]:
        """Name the channels whose messages are read: those of the items, and of gaps."""
        return frozenset(
            number
            for number, stream in streams.items()
            if stream.topic.name == reserved.GAP
            or (not stream.repeated and (self.items is None or stream.item in self.items))
        )

    def _deleted_before(
        self, gone: list[GoneJournal], place: tuple[int, int] | None
    ) -> Iterator[Delivery]:
        """Deliver what is left of journals that are gone: columns, or why there are none."""
        while gone and (place is None or gone[0].place < place):
            journal = gone.pop(0)
            stretch = journal.stretch
            if (stretch.run, stretch.end_seq) > (self.run, self.seq):
                yield from self._of_gone(journal)

    def _of_gone(self, journal: GoneJournal) -> Iterator[Delivery]:
        stretch = journal.stretch
        self._live = None
        yield from self._enter(stretch.run, stretch.first_seq, outline_of(journal))
        rows = rows_of_gone(self.store.path, journal, self.items, self.seq, self._read_to)
        for end_seq, deliveries in rows:
            for delivery in deliveries:
                if isinstance(delivery, Batch):
                    self.ahead[delivery.item] = int(delivery.seq[-1]) + 1
                yield self._at(delivery)
            self.seq, self.ahead = end_seq, {}
        self.last_ns = journal.end_ns
        self._ends_at = (stretch.run, stretch.end_seq)
        self._done = max(self._done, journal.place)

    def _missing_end(self, journal: JournalFile) -> Iterator[Gap]:
        """Tell of rows at a file's end: by number if its index counts them, else that some were."""
        last_ns = journal.end_ns if self.last_ns is None else self.last_ns
        if self.run == journal.run and self.seq < journal.end_seq:
            gap = missing(journal, self.seq, journal.end_seq, last_ns, journal.end_ns)
            self.seq, self.ahead = journal.end_seq, {}
            yield self._at(gap)
        elif journal.damage and _ends_damaged(journal):
            gap = missing(journal, self.seq, self.seq, last_ns, last_ns)
            yield self._at(replace(gap, count=None, to_seq=None))

    def _grow(self, path: Path) -> Iterator[Delivery]:
        """Deliver what has been added to the file being written."""
        live = self._live
        if live is None or live.path != path:
            live = self._live = _Live(path)
        with open_buffer(path) as data:
            if len(data) <= live.at:
                return
            walk = Walk(data, at=live.at, tag=live.tag, grows=True, trusted=live.trusted)
            for found in walk:
                if isinstance(found, Metadata):
                    _note_start(live, walk, found)
                elif isinstance(found, Chunk):
                    yield from self._live_chunk(live, found)
                live.at, live.trusted = walk.at, walk.trusted
            live.at, live.trusted = walk.at, walk.trusted

    def _live_chunk(self, live: _Live, chunk: Chunk) -> Iterator[Delivery]:
        live.schemas.update(chunk.schemas)
        for number, channel in chunk.channels.items():
            known = live.streams.get(number)
            if known is None or (known.topic.schema is None and channel.schema_id in chunk.schemas):
                live.streams[number] = stream_of(channel, live.schemas)
        live.clock.extend(clock_points(chunk, live.streams))
        run, number = run_and_number(live.path)
        journal = _outline(live, self.writer, run, number)
        if len(chunk):
            yield from self._enter(run, live.first_seq, journal)
            yield from self._deliver(
                chunk, journal, ClockTable(live.clock, held=True), live.streams
            )

    def _enter(self, run: int, first_seq: int, journal: JournalFile) -> Iterator[Gap]:
        """Go over to another run, or to a later file after some were deleted."""
        if run > self.run:
            yield from self._set_back(journal)
            self.run, self.seq, self.ahead = run, 0, {}
        if first_seq > self.seq:
            start = self.last_ns if self.last_ns is not None else journal.start_ns
            gap = missing(journal, self.seq, first_seq, start, journal.start_ns or start)
            self.seq, self.ahead = first_seq, {}
            reason = FORGOTTEN if self.writer == "ring" else LOST
            yield self._at(Gap(
                gap.writer, run, gap.from_ns, gap.to_ns, reason,
                count=gap.count, from_seq=gap.from_seq, to_seq=gap.to_seq,
            ))  # fmt: skip

    def _set_back(self, journal: JournalFile) -> Iterator[Gap]:
        """Tell of provisional rows that were delivered, and then taken by a power cut."""
        run, end_seq = self._ends_at
        if run == self.run and end_seq < self.seq:
            start = self.last_ns if self.last_ns is not None else journal.start_ns
            gap = missing(journal, end_seq, self.seq, start, journal.start_ns or start)
            self.seq, self.ahead = end_seq, {}
            yield self._at(replace(gap, run=run, reason="delivered, then lost in a power cut"))

    def _deliver(
        self,
        chunk: Chunk,
        journal: JournalFile,
        clock: ClockTable,
        streams: Any,
    ) -> Iterator[Delivery]:
        seq = sequences(chunk, journal.first_seq)
        first, end = int(seq[0]), int(seq[-1]) + 1
        if end <= self.seq:
            return
        if first > self.seq:
            start = self.last_ns if self.last_ns is not None else int(chunk.log_ns[0])
            gap = missing(journal, self.seq, first, start, int(chunk.log_ns[0]))
            self.seq, self.ahead = first, {}
            yield self._at(gap)
        for item, rows in by_item(chunk, streams, self.items):
            yield from self._item_rows(item, rows[seq[rows] >= self._read_to(item)],
                                       chunk, seq, clock, streams)  # fmt: skip
        self.seq, self.ahead = end, {}
        self.last_ns = int(chunk.log_ns.max())
        yield from map(self._at, gap_records(chunk, streams, self.writer, self.run, clock))
        yield from self._advance_watermark(clock, self.last_ns)

    def _read_to(self, item: str) -> int:
        return max(self.seq, self.ahead.get(item, 0))

    def _item_rows(
        self,
        item: str,
        rows: IntArray,
        chunk: Chunk,
        seq: IntArray,
        clock: ClockTable,
        streams: Any,
    ) -> Iterator[Delivery]:
        """Yield an item's rows of a chunk: one batch, or more where its type changes."""
        for part in runs_of_channel(rows, chunk):
            stream = streams[int(chunk.channel[part[0]])]
            messages = chunk.messages(part)
            origin = Origin(self.writer, self.run, stream, clock)
            made = make_batch(origin, seq[part], chunk.log_ns[part], messages)
            for gap in made.gaps:
                yield self._at(gap)
            self.ahead[item] = int(seq[part[-1]]) + 1
            if made.batch is not None:
                yield self._at(made.batch)

    def _advance_watermark(self, clock: ClockTable, log_ns: int) -> Iterator[Watermark]:
        """Say that everything before the last row of a chunk has been delivered."""
        received = int(clock.received(np.array([log_ns]))[0])
        head = read_head(self.store.folder(self.writer))
        durable = head.durable_seq if head and head.run == self.run else self.seq
        yield from self._mark(received, durable)

    def _watermark_of_head(self, head: Head) -> Iterator[Watermark]:
        """Say that nothing has come up to now, when all that was written is delivered."""
        if (head.run, head.next_seq) != (self.run, self.seq):
            return
        points = self._live.clock if self._live else []
        received = int(ClockTable(points, held=True).received(np.array([head.watermark_ns]))[0])
        yield from self._mark(received, head.durable_seq)

    def _mark(self, received_ns: int, durable_seq: int) -> Iterator[Watermark]:
        mark = (self.run, received_ns, durable_seq)
        if mark > self._watermark:
            self._watermark = mark
            yield self._at(Watermark(self.writer, self.run, received_ns, durable_seq))

    def _at(self, delivery: Any) -> Any:
        return replace(delivery, cursor=Cursor(self.store.id, {self.writer: self.position()}))


def _note_start(live: _Live, walk: Walk, found: Metadata) -> None:
    live.tag = walk.tag
    if "first_seq" in found.values:
        live.first_seq = int(found.values["first_seq"])


def _is_finished(path: Path) -> bool:
    with open_buffer(path) as data:
        return read_summary(data) is not None


def _ends_damaged(journal: JournalFile) -> bool:
    return not journal.places or journal.damage[-1].to_offset == journal.bytes


def _outline(live: _Live, writer: str, run: int, number: int) -> JournalFile:
    return JournalFile(
        name=f"{live.path.parent.name}/{live.path.name}", path=live.path, writer=writer, run=run,
        number=number, first_seq=live.first_seq, end_seq=0, start_ns=0, end_ns=0, finished=False,
        items={}, bytes=0, clock=tuple(live.clock), chain="", streams=live.streams, places=(),
    )  # fmt: skip


def _first_of_interest(files: list[Path], run: int, seq: int) -> int:
    """Skip files that lie before a position, looking only at their names and start records."""
    runs = [run_and_number(path)[0] for path in files]
    first, end = bisect_left(runs, run), bisect_right(runs, run)
    for place in range(end - 1, first, -1):  # most positions are near the end
        if _starts_at(files[place]) <= seq:
            return place
    return first


def _starts_at(path: Path) -> int:
    return int(start_record(path).get("first_seq", 1 << 62))


def _skipper(journal: JournalFile, run: int, seq: int) -> Any:
    """Skip chunks that end before a position, where the index tells it without decoding."""
    if journal.run != run or journal.walked:
        return lambda place: True
    ends, total = {}, journal.first_seq
    for place in journal.places:
        total += place.count
        ends[place.offset] = total

    def wanted(place: ChunkPlace) -> bool:
        return ends.get(place.offset, total + 1) > seq

    return wanted


def position_at(
    store: Store, writer: str, cursor: WriterCursor | None, lookback_s: float
) -> WriterCursor:
    """Find where to begin: at the cursor, or ``lookback_s`` before it, or before the end."""
    if lookback_s <= 0:
        return cursor or WriterCursor()
    before = (
        f
        for f in newest_first(store, writer)
        if cursor is None or (f.run, f.first_seq) <= (cursor.run, cursor.seq)
    )
    newest = next(before, None)
    if newest is None:
        return cursor or WriterCursor()
    end_ns = _time_of(newest, cursor)
    start = cursor or WriterCursor(newest.run, newest.end_seq)
    for journal in chain([newest], before):
        seq = journal.first_seq
        for place in journal.places:
            if place.end_ns >= end_ns - lookback_s * NS:
                start = min(start, WriterCursor(journal.run, seq), key=lambda c: (c.run, c.seq))
                break
            seq += place.count
        if journal.start_ns < end_ns - lookback_s * NS:
            break
    return start


def _time_of(journal: JournalFile, cursor: WriterCursor | None) -> int:
    """Log time at a cursor, or at the end of the file."""
    if cursor is None or cursor.run != journal.run:
        return journal.end_ns
    seq, time_ns = journal.first_seq, journal.start_ns
    for place in journal.places:
        if seq >= cursor.seq:
            break
        time_ns = place.end_ns
        seq += place.count
    return time_ns
