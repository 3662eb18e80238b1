"""Rows out of journals: files listed, chunks decoded, messages unrolled into batches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.follow.batching import Origin, Stream, make_batch, stream_of
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.chunk import Chunk, sequences
from amberbox.blackbox.journal.clocktable import ClockReading, ClockTable, simplified
from amberbox.blackbox.journal.groups import read_in_groups
from amberbox.blackbox.journal.growing import GrowingIndex, UnindexedError
from amberbox.blackbox.journal.scan import ChunkPlace, FileScan, Tally, read_chunk, scan
from amberbox.blackbox.journal.walk import Damage
from amberbox.blackbox.store import Store, being_written, open_store
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Batch, Gap, IntArray

BATCH_ROWS = 4096
BATCH_BYTES = 4 << 20

OnGap = Callable[[Gap], None]


@dataclass(frozen=True, slots=True)
class JournalFile:
    """One journal file and what it holds; times are log time in ns."""

    name: str
    path: Path
    writer: str
    run: int
    number: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    finished: bool
    items: Mapping[str, int]
    bytes: int
    clock: tuple[tuple[int, int], ...]
    chain: str
    streams: Mapping[int, Stream] = field(repr=False)
    places: Sequence[ChunkPlace] = field(repr=False)
    damage: Sequence[Damage] = ()
    store_id: str = ""
    walked: bool = False
    readings: tuple[ClockReading, ...] = ()
    tallies: Mapping[int, Tally] | None = field(default=None, repr=False)
    """What there is of each channel, where that is known without reading messages."""

    @property
    def rows(self) -> int:
        """Number of messages that can be read."""
        return sum(place.count for place in self.places)


def journals(store: Path) -> list[JournalFile]:
    """List a store's journal files in the order they were written, writer by writer."""
    opened = open_store(store)
    return [journal for writer in opened.writers() for journal in files_of(opened, writer)]


def files_of(store: Store, writer: str) -> list[JournalFile]:
    """List one writer's journal files; those that are deleted meanwhile are left out."""
    found = []
    for path in store.journal_files(writer):
        with suppress(FileNotFoundError):
            found.append(journal_file(path, f"{path.parent.name}/{path.name}"))
    return found


def newest_first(store: Store, writer: str) -> Iterator[JournalFile]:
    """Look into one writer's journal files from the newest back, no further than is asked for."""
    for path in reversed(store.journal_files(writer)):
        try:
            found = journal_file(path, f"{path.parent.name}/{path.name}")
        except FileNotFoundError:
            continue
        yield found


def journal_file(path: Path, name: str = "") -> JournalFile:
    """Look into a journal file; what was found is remembered until the file changes."""
    return _journal_file(path, name or path.name).now()


@lru_cache(maxsize=1024)
def _journal_file(path: Path, name: str) -> _Looked:
    return _Looked(path, name)


class _Looked:
    """What is known of one file by now; of one that is being written only the rest is read."""

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self._name = name
        self._lock = threading.Lock()
        self._seen: tuple[int, int, int] | None = None
        self._index: GrowingIndex | None = None
        self._found: JournalFile | None = None

    def now(self) -> JournalFile:
        """Look into the file, if it has changed."""
        with self._lock:
            status = self._path.stat()
            seen = status.st_ino, status.st_mtime_ns, status.st_size
            given_up = self._index is not None and not being_written(self._path)
            if self._found is None or seen != self._seen or given_up:
                if self._seen is not None and self._seen[0] != status.st_ino:
                    self._index = self._found = None
                self._found = self._look()
                self._seen = seen
            return self._found

    def _look(self) -> JournalFile:
        known = self._found
        if being_written(self._path):
            self._index = self._index or GrowingIndex(self._path)
            try:
                return describe(self._index.read(), self._name, known)
            except UnindexedError:  # damaged, or not ours
                pass
        self._index = None
        return describe(scan(self._path), self._name)


def describe(found: FileScan, name: str, known: JournalFile | None = None) -> JournalFile:
    """Turn a scan into a journal file with items and clock.

    ``known`` is the same file as it was before it grew.
    """
    start, summary = found.start, found.summary
    streams = {n: stream_of(c, summary.schemas) for n, c in summary.channels.items()}
    items: dict[str, int] = {}
    for number, count in summary.counts.items():
        stream = streams[number]
        if not stream.repeated:
            items[stream.item] = items.get(stream.item, 0) + count
    first_seq = int(start.get("first_seq", 0))
    journal = JournalFile(
        name=name,
        path=found.path,
        writer=start.get("writer", "main"),
        run=int(start.get("run", 0)),
        number=int(start.get("file", 0)),
        first_seq=first_seq,
        end_seq=_end_seq(found, first_seq),
        start_ns=summary.start_ns,
        end_ns=summary.end_ns,
        finished=found.finished,
        items=items,
        bytes=found.size,
        clock=(),
        chain=found.chain,
        streams=streams,
        places=tuple(found.places),
        damage=tuple(found.damage),
        store_id=start.get("store_id", ""),
        walked=found.walked,
        tallies=found.tallies,
    )
    numbers = {n for n, c in found.summary.channels.items() if c.topic == reserved.CLOCK}
    read, readings = (len(known.places), known.readings) if known else (0, ())
    places = [p for p in journal.places[read:] if p.may_hold(numbers)] if numbers else []
    readings += tuple(_clock_readings(journal, places))
    points = [(reading.log_ns, reading.offset_ns) for reading in readings]
    return replace(journal, clock=simplified(points), readings=readings)


def _end_seq(found: FileScan, first_seq: int) -> int:
    if found.indexed is not None:
        return first_seq + found.indexed
    if not found.places:
        return first_seq
    last = found.places[-1]
    if last.first_sequence is None:
        return first_seq + sum(place.count for place in found.places)
    return first_seq + ((last.first_sequence - first_seq) & 0xFFFFFFFF) + last.count


def _clock_readings(journal: JournalFile, places: Sequence[ChunkPlace]) -> Iterator[ClockReading]:
    for log_ns, values in _own_messages(journal, reserved.CLOCK, places):
        yield ClockReading(
            log_ns, int(values["offset_ns"]), values.get("synchronised"), values.get("boot_ns")
        )


def _own_messages(
    journal: JournalFile, topic: str, places: Sequence[ChunkPlace]
) -> Iterator[tuple[int, dict[str, Any]]]:
    numbers = [n for n, s in journal.streams.items() if s.topic.name == topic]
    with open_buffer(journal.path) as data:
        for chunk in filter(None, (read_chunk(data, place) for place in places)):
            for number in numbers:
                rows = chunk.rows_of(number)
                times = chunk.log_ns[rows].tolist()
                for log_ns, message in zip(times, chunk.messages(rows), strict=True):
                    yield log_ns, msgspec.json.decode(message)


def run_messages(journal: JournalFile) -> dict[str, Any]:
    """Return what a file's run record says (robot, items and their options)."""
    for _, values in _own_messages(journal, reserved.RUN, journal.places[:1]):
        return values
    return {}


@dataclass(slots=True)
class _Pile:
    """Messages of one stream waiting to be unrolled together."""

    seq: list[IntArray] = field(default_factory=list)
    log_ns: list[IntArray] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, seq: IntArray, log_ns: IntArray, messages: Sequence[bytes], size: int) -> None:
        self.seq.append(seq)
        self.log_ns.append(log_ns)
        self.messages.extend(messages)
        self.size += size

    @property
    def full(self) -> bool:
        return len(self.messages) >= BATCH_ROWS or self.size >= BATCH_BYTES


def batches(
    store: Path,
    items: Collection[str] | None = None,
    from_ns: int | None = None,
    to_ns: int | None = None,
    skip: Container[str] = (),
    on_gap: OnGap | None = None,
) -> Iterator[Batch]:
    """Yield rows received in ``[from_ns, to_ns)`` from the journals of a store.

    ``skip`` names journal files (relative to the store) that need not be read. What cannot be
    read or decoded is told to ``on_gap``. Batches of one item come in order within a file.
    """
    for journal in journals(store):
        if journal.name not in skip:
            yield from batches_of(journal, items, from_ns, to_ns, on_gap)


KEPT_RAW = "no columns, only in "


def with_columns(journal: JournalFile, on_gap: OnGap) -> set[str]:
    """Name the items of a file whose messages can be unrolled; the others are told as gaps."""
    found: set[str] = set()
    reasons: dict[str, str] = {}
    for stream in journal.streams.values():
        try:
            stream.unroller()
            found.add(stream.item)
        except AmberboxError as error:
            reasons[stream.item] = error.what
    edges = np.array([journal.start_ns, journal.end_ns])
    start_ns, end_ns = ClockTable(journal.clock).received(edges).tolist()
    for item, why in reasons.items():
        if item not in found and journal.items.get(item):
            reason = f"{KEPT_RAW}{journal.name}: {why}"
            on_gap(Gap(journal.writer, journal.run, start_ns, end_ns + 1, reason, item,
                       journal.items[item]))  # fmt: skip
    return found


def batches_of(
    journal: JournalFile,
    items: Collection[str] | None = None,
    from_ns: int | None = None,
    to_ns: int | None = None,
    on_gap: OnGap | None = None,
    sizes: dict[str, int] | None = None,
) -> Iterator[Batch]:
    """Yield the rows of one journal file, in large batches per item.

    The bytes of each item's messages are added up in ``sizes``.
    """
    wanted = {
        n: s
        for n, s in journal.streams.items()
        if not s.repeated and (items is None or s.item in items)
    }
    if not wanted or not any(journal.items.get(s.item) for s in wanted.values()):
        return
    clock = ClockTable(journal.clock)
    piles: dict[int, _Pile] = {}
    overlaps = _overlapping(clock, from_ns, to_ns)

    def may_hold(place: ChunkPlace) -> bool:
        return place.may_hold(wanted.keys()) and overlaps(place)

    for chunk in sound_chunks(journal, may_hold, in_groups=True):
        seq, received = sequences(chunk, journal.first_seq), clock.received(chunk.log_ns)
        inside = _inside(received, from_ns, to_ns)
        for number in np.unique(chunk.channel[inside]).tolist():
            if number not in wanted:
                continue
            rows = np.flatnonzero(inside & (chunk.channel == number))
            size = int((chunk.ends[rows] - chunk.starts[rows]).sum())
            if sizes is not None:
                item = wanted[number].item
                sizes[item] = sizes.get(item, 0) + size
            pile = piles.setdefault(number, _Pile())
            pile.add(seq[rows], chunk.log_ns[rows], chunk.messages(rows), size)
            if pile.full:
                yield from _unpile(journal, wanted[number], piles.pop(number), clock, on_gap)
    for number, pile in piles.items():
        yield from _unpile(journal, wanted[number], pile, clock, on_gap)


def _overlapping(
    clock: ClockTable, from_ns: int | None, to_ns: int | None
) -> Callable[[ChunkPlace], bool]:
    """Choose the chunks that may hold rows received in ``[from_ns, to_ns)``."""
    low, high = clock.bounds()

    def may_hold(place: ChunkPlace) -> bool:
        too_late = to_ns is not None and place.start_ns + low >= to_ns
        too_early = from_ns is not None and place.end_ns + high < from_ns
        return not too_late and not too_early

    return may_hold


def _inside(received: IntArray, from_ns: int | None, to_ns: int | None) -> Any:
    inside = np.ones(len(received), bool)
    if from_ns is not None:
        inside &= received >= from_ns
    if to_ns is not None:
        inside &= received < to_ns
    return inside


def sound_chunks(
    journal: JournalFile,
    choose: Callable[[ChunkPlace], bool] = lambda place: True,
    *,
    in_groups: bool = False,
) -> Iterator[Chunk]:
    """Decode the chosen chunks of a file in ``seq`` order; ``in_groups`` several as one.

    When a checksum refuses one, the file is walked: what lies elsewhere than its index says (a
    disk that swapped pages) is found, and only what is really damaged is missing.
    """
    next_seq = journal.first_seq
    with open_buffer(journal.path) as data:
        places = (place for place in journal.places if choose(place))
        if in_groups:
            chunks = read_in_groups(data, places)
        else:
            chunks = (read_chunk(data, place) for place in places)
        for chunk in chunks:
            if chunk is None:
                break
            if len(chunk):
                next_seq = int(sequences(chunk, journal.first_seq)[-1]) + 1
                yield chunk
        else:
            return
    walked = walked_again(journal)

    def rest(place: ChunkPlace) -> bool:
        first = _first_seq(walked, place)
        return (first is None or first >= next_seq) and choose(place)

    if not journal.walked:
        yield from sound_chunks(walked, rest)


def walked_again(journal: JournalFile) -> JournalFile:
    """Describe a file by every chunk that holds, not by its summary."""
    status = journal.path.stat()
    return _walked(journal.path, journal.name, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _walked(path: Path, name: str, _mtime_ns: int, _size: int) -> JournalFile:
    return describe(scan(path, walk=True), name)


def _first_seq(journal: JournalFile, place: ChunkPlace) -> int | None:
    if place.first_sequence is None:
        return None
    return journal.first_seq + ((place.first_sequence - journal.first_seq) & 0xFFFFFFFF)


def holes(journal: JournalFile) -> list[Gap]:
    """Name what is missing between the chunks that hold, by sequence and time."""
    gaps, expected, last_ns = [], journal.first_seq, journal.start_ns
    for place in journal.places:
        first = _first_seq(journal, place)
        if first is not None and first > expected:
            gaps.append(missing(journal, expected, first, last_ns, place.start_ns))
        expected = (expected if first is None else first) + place.count
        last_ns = place.end_ns
    return gaps


def missing(journal: JournalFile, from_seq: int, to_seq: int, from_ns: int, to_ns: int) -> Gap:
    """Describe rows that were written and cannot be read."""
    clock = ClockTable(journal.clock)
    start, end = clock.received(np.array([from_ns, to_ns])).tolist()
    return Gap(
        journal.writer,
        journal.run,
        start,
        end,
        f"damaged: {journal.name}",
        count=to_seq - from_seq,
        from_seq=from_seq,
        to_seq=to_seq,
    )


def _unpile(
    journal: JournalFile, stream: Stream, pile: _Pile, clock: ClockTable, on_gap: OnGap | None
) -> Iterator[Batch]:
    seq, log_ns = np.concatenate(pile.seq), np.concatenate(pile.log_ns)
    origin = Origin(journal.writer, journal.run, stream, clock)
    made = make_batch(origin, seq, log_ns, pile.messages)
    if on_gap is not None:
        for gap in made.gaps:
            on_gap(gap)
    if made.batch is not None:
        yield made.batch


def last_message(store: Path, item: str) -> bytes | None:
    """Return the newest latched message of an item, repeated ones included."""
    for journal in reversed(journals(store)):
        numbers = [n for n, s in journal.streams.items() if s.item == item and s.topic.latched]
        found = None
        for chunk in sound_chunks(journal) if numbers else ():
            rows = np.flatnonzero(np.isin(chunk.channel, numbers))
            if len(rows):
                found = chunk.messages(rows[-1:])[0]
        if found is not None:
            return found
    return None
