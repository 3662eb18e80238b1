"""Follow a record with a cursor: one writer's journals, file after file, from a position on.

Live and replay are the same: rows are returned in ``seq`` order per writer, damage as gaps, and a
follower resumes exactly at its stored cursor.
"""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import Chunk, decode_own_messages, open_buffer, sequences
from amberbox.blackbox.journal.mcap import read_summary
from amberbox.blackbox.journal.scan import ChunkPlace, late_ns_of, start_record
from amberbox.blackbox.journal.tail import FileTail, JournalHead, read_head
from amberbox.blackbox.store.batches import BatchOrigin, ItemStream, make_batch, stream_of
from amberbox.blackbox.store.clocks import ClockTable, held_points
from amberbox.blackbox.store.deleted_journals import (
    FORGOTTEN,
    LOST,
    DeletedJournal,
    DeletedJournals,
    outline_of,
    rows_of_deleted,
)
from amberbox.blackbox.store.journal_reader import (
    BATCH_BYTES,
    BATCH_ROWS,
    JournalFile,
    journal_file,
    missing,
    newest_first,
    sound_chunks,
)
from amberbox.blackbox.store.store import Store, is_locked, open_store, run_and_number, store_path
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Cursor, Gap, IntArray, Schema, Watermark, WriterCursor


def by_item(
    chunk: Chunk, streams: Any, items: Collection[str] | None
) -> list[tuple[str, IntArray]]:
    """Group rows by item, in the order of their first row."""
    rows: dict[str, list[IntArray]] = {}
    numbers, firsts = np.unique(chunk.channel, return_index=True)
    for number in numbers[np.argsort(firsts)].tolist():
        stream = streams[number]
        if not stream.repeated and (items is None or stream.item in items):
            rows.setdefault(stream.item, []).append(chunk.rows_of(number))
    return [(item, np.sort(np.concatenate(parts))) for item, parts in rows.items()]


def runs_of_channel(rows: IntArray, chunk: Chunk) -> list[IntArray]:
    """Split rows where the type of their messages changes."""
    if not len(rows):
        return []
    channel = chunk.channel[rows]
    return np.split(rows, np.flatnonzero(channel[1:] != channel[:-1]) + 1)


def gap_records(chunk: Chunk, writer: str, run: int, clock: ClockTable) -> Iterator[Gap]:
    """Yield the gaps of closed gap records of the recorder."""
    for _, _, values in decode_own_messages(chunk, (channels.GAP,)):
        if values.get("to_ns") is not None:
            times = clock.span(values["from_ns"], values["to_ns"])
            yield Gap(
                writer, run, times[0], times[1], values["reason"], values["item"],
                values.get("count"),
            )  # fmt: skip


@dataclass(slots=True)
class _Pile:
    """Chunks that follow each other without a hole."""

    chunks: list[Chunk] = field(default_factory=list)
    bodies: list[bytes] = field(default_factory=list)
    starts: list[IntArray] = field(default_factory=list)
    ends: list[IntArray] = field(default_factory=list)
    rows: int = 0
    size: int = 0
    end_seq: int = -1

    def add(self, chunk: Chunk, wanted: NDArray[np.bool_]) -> None:
        """Put a chunk on top, of its messages only those of the wanted channels."""
        keep = wanted[chunk.channel]
        lengths = np.where(keep, chunk.ends - chunk.starts, 0)
        ends = self.size + np.cumsum(lengths)
        self.bodies.extend(chunk.messages(np.flatnonzero(keep)))
        self.starts.append(ends - lengths)
        self.ends.append(ends)
        self.chunks.append(chunk)
        self.rows += int(keep.sum())
        self.size = int(ends[-1])

    @property
    def is_full(self) -> bool:
        return self.rows >= BATCH_ROWS or self.size >= BATCH_BYTES

    def joined(self) -> Chunk:
        """Make one chunk of them; the bytes of unwanted channels are left out."""
        if len(self.chunks) == 1:
            return self.chunks[0]
        first, last = self.chunks[0], self.chunks[-1]
        return Chunk(
            offset=first.offset,
            end=last.end,
            channel=np.concatenate([chunk.channel for chunk in self.chunks]),
            sequence=np.concatenate([chunk.sequence for chunk in self.chunks]),
            log_ns=np.concatenate([chunk.log_ns for chunk in self.chunks]),
            publish_ns=np.concatenate([chunk.publish_ns for chunk in self.chunks]),
            starts=np.concatenate(self.starts),
            ends=np.concatenate(self.ends),
            body=b"".join(self.bodies),
            schemas={number: s for chunk in self.chunks for number, s in chunk.schemas.items()},
            channels={number: c for chunk in self.chunks for number, c in chunk.channels.items()},
        )


def joined(chunks: Iterable[Chunk], first_seq: int, wanted: Collection[int]) -> Iterator[Chunk]:
    """Join chunks of one file until there are many rows of the wanted channels.

    A joined chunk has no hole in its sequence, and the messages of wanted channels only.
    """
    flags = np.zeros(1 << 16, bool)
    flags[list(wanted)] = True
    pile = _Pile()
    for chunk in chunks:
        seq = sequences(chunk, first_seq)
        if pile.chunks and (pile.is_full or int(seq[0]) != pile.end_seq):
            yield pile.joined()
            pile = _Pile()
        pile.add(chunk, flags)
        pile.end_seq = int(seq[-1]) + 1
    if pile.chunks:
        yield pile.joined()


Delivery: TypeAlias = Batch | Gap | Watermark


@dataclass(slots=True)
class _Live:
    """The file that is being written: its tail, and the position read so far."""

    tail: FileTail
    schemas: dict[int, Schema] = field(default_factory=dict)
    streams: dict[int, ItemStream] = field(default_factory=dict)
    clock: list[tuple[int, int]] = field(default_factory=list)
    late_ns: int = 0


class WriterTail:
    """Delivers one writer's rows once each and in order; ``step`` yields new ones."""

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
        self._gone = DeletedJournals(store, writer)
        self.last_ns: int | None = None
        # log time up to which the rows read are all that there will be, by the file alone
        self.complete_ns: int | None = None
        self.late_ns = 0  # how much before earlier rows the rows of the present file may be
        self._watermark: tuple[int, int, int] = (0, 0, 0)

    def position(self) -> WriterCursor:
        """Return the position of this tail."""
        return WriterCursor(self.run, self.seq, dict(self.ahead))

    def step(self) -> Iterator[Delivery]:
        """Yield the deliveries since the last step."""
        head = read_head(self.store.folder(self.writer))  # before the files: never too much
        files = [p for p in self.store.journal_files(self.writer) if run_and_number(p) > self._done]
        alive = is_locked(self.store, self.writer)  # after the files: if false, they are finished
        gone = self._gone.since(self._done, files)
        with suppress(FileNotFoundError):  # deleted meanwhile: a gap of the next step
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
        """Yield the remaining rows of a finished file."""
        journal = journal_file(path, f"{path.parent.name}/{path.name}")
        self._live = None
        if journal.places:
            yield from self._enter(journal.run, journal.first_seq, journal)
        clock = ClockTable(held_points(journal.readings), held=True)
        skip_before = _skipper(journal, self.run, self.seq)
        chunks = sound_chunks(journal, skip_before)
        for chunk in joined(chunks, journal.first_seq, self._wanted(journal.streams)):
            yield from self._deliver(chunk, journal, clock, journal.streams)
        # Deliver a gap for rows at a file's end: with their number if its index counts them.
        last_ns = journal.end_ns if self.last_ns is None else self.last_ns
        if self.run == journal.run and self.seq < journal.end_seq:
            gap = missing(journal, self.seq, journal.end_seq, last_ns, journal.end_ns)
            self.seq, self.ahead = journal.end_seq, {}
            yield self._at(gap)
        elif journal.damage and _ends_damaged(journal):
            gap = missing(journal, self.seq, self.seq, last_ns, last_ns)
            yield self._at(replace(gap, count=None, to_seq=None))
        if journal.late_ns and journal.rows:  # the next file begins after all rows of this one
            self.complete_ns = journal.end_ns
            yield from self._mark(clock.at(journal.end_ns), self._durable_seq())
        self._ends_at = (journal.run, journal.end_seq)
        self._done = run_and_number(path)

    def _wanted(self, streams: Mapping[int, ItemStream]) -> frozenset[int]:
        """Return the channels whose messages are read: those of the items, and of gaps."""
        return frozenset(
            number
            for number, stream in streams.items()
            if stream.topic.name == channels.GAP
            or (not stream.repeated and (self.items is None or stream.item in self.items))
        )

    def _deleted_before(
        self, gone: list[DeletedJournal], place: tuple[int, int] | None
    ) -> Iterator[Delivery]:
        """Yield the remains of deleted journals: columns, or gaps with the reason."""
        while gone and (place is None or gone[0].place < place):
            journal = gone.pop(0)
            stretch = journal.stretch
            if (stretch.run, stretch.end_seq) > (self.run, self.seq):
                yield from self._of_gone(journal)

    def _of_gone(self, journal: DeletedJournal) -> Iterator[Delivery]:
        stretch = journal.stretch
        self._live = None
        yield from self._enter(stretch.run, stretch.first_seq, outline_of(journal))
        rows = rows_of_deleted(self.store.path, journal, self.items, self.seq, self._read_to)
        for end_seq, deliveries in rows:
            for delivery in deliveries:
                if isinstance(delivery, Batch):
                    self.ahead[delivery.item] = int(delivery.seq[-1]) + 1
                yield self._at(delivery)
            self.seq, self.ahead = end_seq, {}
        self.last_ns = self.complete_ns = journal.end_ns
        self._ends_at = (stretch.run, stretch.end_seq)
        self._done = max(self._done, journal.place)

    def _grow(self, path: Path) -> Iterator[Delivery]:
        """Yield the rows added to the file being written."""
        live = self._live
        if live is None or live.tail.path != path:
            late_ns = late_ns_of(start_record(path))
            live = self._live = _Live(FileTail(path), late_ns=late_ns)
        for chunk in live.tail.chunks():
            yield from self._live_chunk(live, chunk)

    def _live_chunk(self, live: _Live, chunk: Chunk) -> Iterator[Delivery]:
        live.schemas.update(chunk.schemas)
        for number, channel in chunk.channels.items():
            known = live.streams.get(number)
            if known is None or (known.topic.schema is None and channel.schema_id in chunk.schemas):
                live.streams[number] = stream_of(channel, live.schemas)
        clock = decode_own_messages(chunk, (channels.CLOCK,))
        live.clock.extend((log_ns, int(values["offset_ns"])) for log_ns, _, values in clock)
        journal = _outline(live, self.writer)
        if len(chunk):
            yield from self._enter(journal.run, journal.first_seq, journal)
            yield from self._deliver(
                chunk, journal, ClockTable(live.clock, held=True), live.streams
            )

    def _enter(self, run: int, first_seq: int, journal: JournalFile) -> Iterator[Gap]:
        """Enter another run, or a later file after some were deleted; yield gaps of lost rows."""
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
        """Yield a gap for provisional rows that were delivered, then lost in a power cut."""
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
        yield from map(self._at, gap_records(chunk, self.writer, self.run, clock))
        # Everything before the last row of a chunk has been delivered, but for late rows.
        self.late_ns = journal.late_ns
        self.complete_ns = self.last_ns - journal.late_ns
        yield from self._mark(clock.at(self.complete_ns), self._durable_seq())

    def _durable_seq(self) -> int:
        head = read_head(self.store.folder(self.writer))
        return head.durable_seq if head and head.run == self.run else self.seq

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
            origin = BatchOrigin(self.writer, self.run, stream, clock)
            made = make_batch(origin, seq[part], chunk.log_ns[part], messages)
            for gap in made.gaps:
                yield self._at(gap)
            self.ahead[item] = int(seq[part[-1]]) + 1
            if made.batch is not None:
                yield self._at(made.batch)

    def _watermark_of_head(self, head: JournalHead) -> Iterator[Watermark]:
        """Yield the head's watermark when all written rows are delivered."""
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


def _is_finished(path: Path) -> bool:
    with open_buffer(path) as data:
        return read_summary(data) is not None


def _ends_damaged(journal: JournalFile) -> bool:
    return not journal.places or journal.damage[-1].to_offset == journal.bytes


def _outline(live: _Live, writer: str) -> JournalFile:
    path = live.tail.path
    run, number = run_and_number(path)
    return JournalFile(
        name=f"{path.parent.name}/{path.name}", path=path, writer=writer, run=run,
        number=number, first_seq=live.tail.first_seq, end_seq=0, start_ns=0, end_ns=0,
        finished=False, items={}, bytes=0, clock=tuple(live.clock), chain="",
        streams=live.streams, places=(), late_ns=live.late_ns,
    )  # fmt: skip


def _first_of_interest(files: list[Path], run: int, seq: int) -> int:
    """Skip files before a position, by their names and start records only."""
    runs = [run_and_number(path)[0] for path in files]
    first, end = bisect_left(runs, run), bisect_right(runs, run)
    for place in range(end - 1, first, -1):  # most positions are near the end
        if int(start_record(files[place]).get("first_seq", 1 << 62)) <= seq:
            return place
    return first


def _skipper(journal: JournalFile, run: int, seq: int) -> Any:
    """Skip chunks that end before a position, where the index states it."""
    if journal.run != run or journal.walked:
        return lambda place: True
    ends = {place.offset: first + place.count for first, place in _chunk_starts(journal)}
    return lambda place: ends.get(place.offset, seq + 1) > seq


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
    start = cursor or WriterCursor(newest.run, newest.end_seq)
    from_ns = _time_of(newest, cursor) - lookback_s * NS
    return go_back(chain([newest], before), start, from_ns)


def go_back(files: Iterable[JournalFile], at: WriterCursor, from_ns: float) -> WriterCursor:
    """Return the position before ``at`` where the rows since a log time begin.

    ``files`` are those of one writer, newest first.
    """
    for journal in files:
        for seq, place in _chunk_starts(journal):
            if place.end_ns >= from_ns:
                at = min(at, WriterCursor(journal.run, seq), key=lambda c: (c.run, c.seq))
                break
        if journal.start_ns < from_ns:
            break
    return at


def _chunk_starts(journal: JournalFile) -> Iterator[tuple[int, ChunkPlace]]:
    """Yield the position at which each chunk of a file begins."""
    seq = journal.first_seq
    for place in journal.places:
        yield seq, place
        seq += place.count


def _time_of(journal: JournalFile, cursor: WriterCursor | None) -> int:
    """Return the log time at a cursor, or at the end of the file."""
    if cursor is None or cursor.run != journal.run:
        return journal.end_ns
    time_ns = journal.start_ns
    for seq, place in _chunk_starts(journal):
        if seq >= cursor.seq:
            break
        time_ns = place.end_ns
    return time_ns


# The writers that are followed unless others are named: what the recorder writes
RECORDED = ("main", "bulk", "ring")


class RecordFollower:
    """Follows the journals of a store; ``step`` yields what is new, in the terms of ``follow``.

    Raises UsageError when there is no store at ``where``.
    """

    def __init__(
        self,
        where: str | Path,
        items: Collection[str] | None = None,
        cursor: Cursor | None = None,
        lookback_s: float = 0.0,
        writers: Sequence[str] = RECORDED,
    ) -> None:
        self._store = open_store(store_path(where))
        self._items, self._lookback_s, self._writers = items, lookback_s, writers
        self._foreign = ""
        known = cursor if cursor is not None and cursor.store_id == self._store.id else None
        if cursor is not None and known is None:
            self._foreign = f"the cursor is of another store ({cursor.store_id}): starting anew"
        self._floor = known.writers if known else {}
        self._tails: dict[str, WriterTail] = {}

    def step(self) -> Iterator[Delivery]:
        """Yield the deliveries since the last step."""
        if self._foreign:
            foreign, self._foreign = self._foreign, ""
            yield Gap("", 0, 0, 0, foreign)
        for writer in self._store.writers():
            if writer in self._writers and writer not in self._tails:
                at = self._floor.get(writer)
                start = position_at(self._store, writer, at, self._lookback_s)
                self._tails[writer] = WriterTail(self._store, writer, self._items, start)
        for writer, tail in self._tails.items():
            for delivery in tail.step():
                at_all = {w: t.position() for w, t in self._tails.items()}
                at_all[writer] = delivery.cursor.writers[writer]
                here = {w: _not_before(p, self._floor.get(w)) for w, p in at_all.items()}
                yield replace(delivery, cursor=Cursor(self._store.id, {**self._floor, **here}))


def follow(
    where: str | Path,
    items: Collection[str] | None = None,
    cursor: Cursor | None = None,
    lookback_s: float = 0.0,
    *,
    live: bool = True,
    writers: Sequence[str] = RECORDED,
    stop: threading.Event | None = None,
    poll_s: float = 0.02,
) -> Iterator[Delivery]:
    """Yield the rows of a store and, while ``live``, those being added to it.

    Without ``cursor`` it begins with the oldest row, or ``lookback_s`` before the newest one. With
    ``cursor`` it continues there; ``lookback_s`` then repeats the rows of that many seconds before
    it (``cursor.writers[w].has_read(run, seq, item)`` is true for them), so that windows can be
    filled again. With a cursor of another store it starts at the beginning, after a Gap. ``items``
    are names; None means all. Each delivery carries the cursor to continue with after it has been
    processed.

    Raises UsageError when there is no store at ``where``.
    """
    follower = RecordFollower(where, items, cursor, lookback_s, writers)
    stop = stop or threading.Event()
    while True:
        moved = False
        for delivery in follower.step():
            moved = True
            yield delivery
        if not moved and (not live or stop.wait(poll_s)):
            return


def _not_before(position: WriterCursor, floor: WriterCursor | None) -> WriterCursor:
    """Return the later of a position and a floor: a lookback does not move the cursor back."""
    if floor is None or (position.run, position.seq) > (floor.run, floor.seq):
        return position
    if (position.run, position.seq) < (floor.run, floor.seq):
        return floor
    ahead = {**position.ahead}
    for item, seq in floor.ahead.items():
        ahead[item] = max(seq, ahead.get(item, 0))
    return WriterCursor(floor.run, floor.seq, ahead)
