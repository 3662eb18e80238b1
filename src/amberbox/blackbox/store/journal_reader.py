"""Read rows out of a store's journals: files listed, chunks decoded, messages unrolled.

``extent`` returns first and last time of a file without reading it all; ``previous_chain`` returns
the link from which a writer's next file continues the hash chain.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal import channels, mcap
from amberbox.blackbox.journal.chunk import (
    Buffer,
    Chunk,
    decode_own_messages,
    open_buffer,
    sequences,
)
from amberbox.blackbox.journal.index import GrowingIndex, UnindexedError, read_in_groups
from amberbox.blackbox.journal.mcap import FOOTER_SIZE, START_METADATA
from amberbox.blackbox.journal.scan import (
    ChannelTally,
    ChunkPlace,
    FileScan,
    JournalDamage,
    JournalWalk,
    MetadataRecord,
    late_ns_of,
    read_chunk,
    scan,
    start_record,
)
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.journal.writer import EMPTY_CHAIN
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.batches import BatchOrigin, ItemStream, make_batch, stream_of
from amberbox.blackbox.store.clocks import ClockReading, ClockTable, simplified
from amberbox.blackbox.store.store import Store, being_written, open_store, run_and_number
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Batch, Gap, IntArray

BATCH_ROWS = 4096
BATCH_BYTES = 4 << 20

OnGap = Callable[[Gap], None]


@dataclass(frozen=True, slots=True)
class JournalFile:
    """One journal file and its content; times are log time in ns."""

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
    streams: Mapping[int, ItemStream] = field(repr=False)
    places: Sequence[ChunkPlace] = field(repr=False)
    damage: Sequence[JournalDamage] = ()
    store_id: str = ""
    walked: bool = False
    readings: tuple[ClockReading, ...] = ()
    tallies: Mapping[int, ChannelTally] | None = field(default=None, repr=False)
    """Counts of each channel, if known without reading messages."""
    late_ns: int = 0
    """How much before the rows written before it a row may be: its source handed it over late."""

    @property
    def rows(self) -> int:
        """Return the number of messages that can be read."""
        return sum(place.count for place in self.places)

    @property
    def received_range_ns(self) -> tuple[int, int]:
        """Return when the first and the last message were received, ns."""
        return ClockTable(self.clock).span(self.start_ns, self.end_ns)


def journals(store: Path) -> list[JournalFile]:
    """Return a store's journal files in the order they were written, writer by writer."""
    opened = open_store(store)
    return [journal for writer in opened.writers() for journal in files_of(opened, writer)]


def files_of(store: Store, writer: str) -> list[JournalFile]:
    """Return one writer's journal files; those deleted meanwhile are left out."""
    found = []
    for path in store.journal_files(writer):
        with suppress(FileNotFoundError):
            found.append(journal_file(path, f"{path.parent.name}/{path.name}"))
    return found


def newest_first(store: Store, writer: str) -> Iterator[JournalFile]:
    """Yield one writer's journal files from the newest back; each is read when it is yielded."""
    for path in reversed(store.journal_files(writer)):
        try:
            found = journal_file(path, f"{path.parent.name}/{path.name}")
        except FileNotFoundError:
            continue
        yield found


def journal_file(path: Path, name: str = "") -> JournalFile:
    """Read a journal file; the result is cached until the file changes."""
    return _journal_file(path, name or path.name).now()


@lru_cache(maxsize=1024)
def _journal_file(path: Path, name: str) -> _Looked:
    return _Looked(path, name)


class _Looked:
    """The cached state of one file; of a growing file only the new part is read."""

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self._name = name
        self._lock = threading.Lock()
        self._seen: tuple[int, int, int] | None = None
        self._index: GrowingIndex | None = None
        self._found: JournalFile | None = None

    def now(self) -> JournalFile:
        """Return the file, read again if it has changed."""
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
    """Return a journal file with items and clock, made from a scan.

    ``known`` is an earlier description of the same file, before it grew.
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
        late_ns=late_ns_of(start),
    )
    numbers = {n for n, c in found.summary.channels.items() if c.topic == channels.CLOCK}
    read, readings = (len(known.places), known.readings) if known else (0, ())
    places = [p for p in journal.places[read:] if p.may_hold(numbers)] if numbers else []
    readings += tuple(
        ClockReading(
            log_ns, int(values["offset_ns"]), values.get("synchronised"), values.get("boot_ns")
        )
        for log_ns, values in _own_messages(journal, channels.CLOCK, places)
    )
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


def _own_messages(
    journal: JournalFile, topic: str, places: Sequence[ChunkPlace]
) -> Iterator[tuple[int, dict[str, Any]]]:
    with open_buffer(journal.path) as data:
        for chunk in filter(None, (read_chunk(data, place) for place in places)):
            for log_ns, _, values in decode_own_messages(chunk, (topic,)):
                yield log_ns, values


def run_messages(journal: JournalFile) -> dict[str, Any]:
    """Return the values of a file's run record (robot, items and their options)."""
    return next((v for _, v in _own_messages(journal, channels.RUN, journal.places[:1])), {})


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

    ``skip`` names journal files (relative to the store) that need not be read. Unreadable and
    undecodable rows are passed to ``on_gap``. Batches of one item are in order within a file.
    """
    for journal in journals(store):
        if journal.name not in skip:
            yield from batches_of(journal, items, from_ns, to_ns, on_gap)


KEPT_RAW = "no columns, only in "


def with_columns(journal: JournalFile, on_gap: OnGap) -> set[str]:
    """Return the items of a file whose messages can be unrolled; others are passed as gaps."""
    found: set[str] = set()
    reasons: dict[str, str] = {}
    for stream in journal.streams.values():
        try:
            stream.unroller()
            found.add(stream.item)
        except AmberboxError as error:
            reasons[stream.item] = error.what
    start_ns, end_ns = journal.received_range_ns
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
        wanted_rows = inside(received, from_ns, to_ns)
        for number in np.unique(chunk.channel[wanted_rows]).tolist():
            if number not in wanted:
                continue
            rows = np.flatnonzero(wanted_rows & (chunk.channel == number))
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
    """Return a filter of chunks that may hold rows received in ``[from_ns, to_ns)``."""
    low, high = clock.bounds()

    def may_hold(place: ChunkPlace) -> bool:
        too_late = to_ns is not None and place.start_ns + low >= to_ns
        too_early = from_ns is not None and place.end_ns + high < from_ns
        return not too_late and not too_early

    return may_hold


def inside(times_ns: IntArray, from_ns: int | None, to_ns: int | None) -> NDArray[np.bool_]:
    """Return which times are in ``[from_ns, to_ns)``."""
    rows = np.ones(len(times_ns), bool)
    if from_ns is not None:
        rows &= times_ns >= from_ns
    if to_ns is not None:
        rows &= times_ns < to_ns
    return rows


def sound_chunks(
    journal: JournalFile,
    choose: Callable[[ChunkPlace], bool] = lambda place: True,
    *,
    in_groups: bool = False,
) -> Iterator[Chunk]:
    """Decode the chosen chunks of a file in ``seq`` order; ``in_groups`` several as one.

    When a checksum is wrong, the whole file is scanned: chunks at other places than in the index (a
    disk that swapped pages) are found, and only damaged ones are missing.
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
    """Return a file described by every sound chunk, not by its summary."""
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
    """Return the gaps between the sound chunks, by sequence and time."""
    gaps, expected, last_ns = [], journal.first_seq, journal.start_ns
    for place in journal.places:
        first = _first_seq(journal, place)
        if first is not None and first > expected:
            gaps.append(missing(journal, expected, first, last_ns, place.start_ns))
        expected = (expected if first is None else first) + place.count
        last_ns = place.end_ns
    return gaps


def missing(journal: JournalFile, from_seq: int, to_seq: int, from_ns: int, to_ns: int) -> Gap:
    """Return the gap of rows that were written and cannot be read."""
    start, end = ClockTable(journal.clock).span(from_ns, max(from_ns, to_ns))
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
    journal: JournalFile, stream: ItemStream, pile: _Pile, clock: ClockTable, on_gap: OnGap | None
) -> Iterator[Batch]:
    seq, log_ns = np.concatenate(pile.seq), np.concatenate(pile.log_ns)
    origin = BatchOrigin(journal.writer, journal.run, stream, clock)
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


# Run of a file and its number within the run: the order in which files were written
JournalNumber = tuple[int, int]


def previous_chain(store: Store, writer: str) -> str:
    """Return the last link of a writer's newest file that can still be read, else zeros.

    For a file deleted since, the link is in its tombstone.
    """
    place, chain = max(_buried(store, writer), default=((-1, -1), EMPTY_CHAIN))
    for path in reversed(store.journal_files(writer)):
        if run_and_number(path) <= place:
            break
        link = _last_link(path)
        if link:
            return link
    return chain


def _last_link(path: Path) -> str:
    """Return a file's last link, or where it began if it ended before the first; or nothing."""
    try:
        return journal_file(path).chain or start_record(path).get("chain", "")
    except OSError:  # deleted or unreadable: the file before it is the best there is
        return ""


def _buried(store: Store, writer: str) -> Iterator[tuple[JournalNumber, str]]:
    for stone in manifest.read(store.path).tombstones:
        if stone.writer == writer and stone.what != "columns" and stone.chain:
            yield (
                max(run_and_number(Path(PurePosixPath(name).name)) for name in stone.journals),
                (stone.chain),
            )


_START_BYTES = 4 << 20


@dataclass(frozen=True, slots=True)
class Extent:
    """The range of a journal file in log time (ns), both ends inclusive.

    ``boot`` names the boot and ``boot_base_ns`` is log time minus boot time, None where the file
    does not state it; ``offset_ns`` is wall minus log time at its start.
    """

    path: Path
    name: str
    run: int
    start_ns: int
    end_ns: int
    bytes: int
    boot: str = ""
    boot_base_ns: int | None = None
    offset_ns: int = 0
    config_hash: str = ""


def extent(path: Path) -> Extent | None:
    """Return the extent of a journal file; None where it has no rows, or is deleted.

    The end of a file that is being written is the one its head file states.
    """
    with suppress(FileNotFoundError):
        status = path.stat()
        found = _extent(path, status.st_mtime_ns, status.st_size)
        if found is None or found.end_ns:
            return found
        return _with_live_end(found)
    return None


def _with_live_end(found: Extent) -> Extent | None:
    head = read_head(found.path.parent)
    if head is not None and head.file == found.path.name and head.watermark_ns >= found.start_ns:
        return replace(found, end_ns=max(head.watermark_ns, found.start_ns))
    journal = journal_file(found.path)
    return replace(found, end_ns=max(journal.end_ns, found.start_ns)) if journal.rows else None


@lru_cache(maxsize=4096)
def _extent(path: Path, _mtime_ns: int, size: int) -> Extent | None:
    """Return the extent of a file; an end of 0 means that the file does not state it."""
    start = start_record(path)
    with open_buffer(path) as data:
        chunk = _first_chunk(data)
        end_ns = _stated_end(data)
        name = f"{path.parent.name}/{path.name}"
        if chunk is None:  # go by the chunks that hold
            journal = journal_file(path)
            edges = journal.run, journal.start_ns, journal.end_ns
            return Extent(path, name, *edges, size) if journal.rows else None
        [(_, _, run), (clock_ns, _, clock)] = [
            next(decode_own_messages(chunk, (topic,)), (0, topic, {}))
            for topic in (channels.RUN, channels.CLOCK)
        ]
    boot_ns = clock.get("boot_ns")
    return Extent(
        path=path,
        name=name,
        run=int(start.get("run", 0)),
        start_ns=int(chunk.log_ns.min()),
        end_ns=end_ns,
        bytes=size,
        boot=start.get("boot_id", ""),
        boot_base_ns=None if boot_ns is None else clock_ns - int(boot_ns),
        offset_ns=int(clock.get("offset_ns", 0)),
        config_hash=str(run.get("config_hash", "")),
    )


def _first_chunk(data: Buffer) -> Chunk | None:
    walk = JournalWalk(data[:_START_BYTES], grows=True)
    for found in walk:
        if isinstance(found, Chunk) and len(found):
            return found
        if not isinstance(found, MetadataRecord) or found.name != START_METADATA:
            return None
    return None


def _stated_end(data: Buffer) -> int:
    """Read the last log time from the statistics of a finished file; 0 without them."""
    if len(data) < FOOTER_SIZE or bytes(data[-8:]) != mcap.MAGIC:
        return 0
    end = len(data) - FOOTER_SIZE
    with suppress(struct.error, ValueError):
        _, _, _, at = struct.unpack_from("<BQQQ", data, end)
        while 0 < at < end:
            opcode, length, group, offset = struct.unpack_from("<BQBQ", data, at)
            if opcode == mcap.SUMMARY_OFFSET and group == mcap.STATISTICS:
                return int(struct.unpack_from("<Q", data, offset + 9 + 8 + 2 + 16 + 8)[0])
            at += 9 + length
    return 0
