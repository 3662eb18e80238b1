"""The interface of recordings made by other tools: topics, messages in order of time, damage.

Also reads and unpacks the bytes of recordings, as far as they are undamaged.
"""

from __future__ import annotations

import bz2
import os
import shutil
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

import zstandard

from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic


class ByteSource(Protocol):
    """Bytes that are read by offset; a read beyond the end returns fewer bytes."""

    size: int

    def read(self, offset: int, length: int) -> bytes:
        """Return up to ``length`` bytes from ``offset`` on."""


def cannot_open(path: Path, error: OSError) -> AmberboxError:
    """Return the error for a recording that cannot be opened."""
    return AmberboxError(
        f"cannot open {path}: {error.strerror}", "check the path and its permissions"
    )


class FileBytes:
    """A file read by offset, not mapped: a bad sector is an error instead of a crash."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise cannot_open(path, error) from None
        self.size = os.fstat(self._fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        try:
            return os.pread(self._fd, min(length, max(0, self.size - offset)), offset)
        except OSError as error:
            raise AmberboxError(
                f"cannot read {self.path} at byte {offset}: {error.strerror}",
                "copy the disk with ddrescue first and read the copy",
            ) from None

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class MemoryBytes:
    """Bytes in memory, such as a chunk that was unpacked."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.size = len(data)

    def read(self, offset: int, length: int) -> bytes:
        return self.data[offset : offset + length]


MOST_BYTES = 512 << 20  # largest uncompressed piece of a recording: a few bytes may claim any size
DISK_LEFT_BYTES = 1 << 30  # unpacking a whole file stops when the disk has less than this left
_LOOK_BYTES = 32 << 20
_PIECE = 1 << 16
_ZSTD_PIECE = 1 << 11  # zstd has no output limit; each 4 bytes can become a block of 128 KiB
_MAGIC = {"bz2": b"BZh", "lz4": b"\x04\x22\x4d\x18", "zstd": b"\x28\xb5\x2f\xfd"}
_BELIEVED = 16 << 20  # unpacked even if a smaller size is stated: the stated size may be damaged


def unpack(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """Unpack up to ``size`` bytes; the second value is the error text, empty on success.

    ``compression`` is ``none`` (or empty), ``bz2``, ``lz4`` or ``zstd``.
    """
    if compression in ("", "none"):
        return data, ""
    decompressor = _decompressor(compression)
    if decompressor is None:
        return b"", f"compression {compression!r} is not known"
    # one byte more than promised, to notice data that would unpack to more
    room = max(size if size <= MOST_BYTES else 0, _BELIEVED) + 1
    unpacked, problem = _unpack_pieces(decompressor, data, room)
    if size > MOST_BYTES:
        problem = f"says that it unpacks to {size} bytes, {MOST_BYTES} are allowed"
    if not problem and len(unpacked) != size:
        problem = f"unpacks to {len(unpacked)} bytes instead of {size}"
    return unpacked[: room - 1], problem


def compression_of(data: bytes) -> str:
    """Return the compression of a piece by its first bytes; ``none`` if it is not compressed."""
    return next((name for name, magic in _MAGIC.items() if data.startswith(magic)), "none")


def unpack_message(data: bytes) -> bytes | None:
    """Unpack a message in zstd; None if that fails or it is too large."""
    unpacked, problem = _unpack_pieces(_Zstd(), data, MOST_BYTES)
    return None if problem or len(unpacked) > MOST_BYTES else unpacked


def write_unpacked(pieces: Iterable[bytes], target: Path) -> str:
    """Write unpacked pieces to a file while the disk has room; return why it ends early, if so."""
    free, written = _free_bytes(target), 0
    with target.open("wb") as unpacked:
        for piece in pieces:
            written += len(piece)
            if written > _LOOK_BYTES:
                free, written = _free_bytes(target), 0
            if free - written < DISK_LEFT_BYTES:
                return f"less than {DISK_LEFT_BYTES >> 20} MiB are left in {target.parent}"
            unpacked.write(piece)
    return ""


def _free_bytes(target: Path) -> int:
    return shutil.disk_usage(target.parent).free


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]  # the package has no type hints

        return lz4.frame.LZ4FrameDecompressor()
    return _Zstd() if compression == "zstd" else None


class _Zstd:
    """zstandard's streaming decompressor with the interface of the other two."""

    def __init__(self) -> None:
        self._stream = zstandard.ZstdDecompressor().decompressobj()

    @property
    def eof(self) -> bool:
        return self._stream.eof

    def decompress(self, data: bytes, _room: int) -> bytes:
        return self._stream.decompress(data)


def _unpack_pieces(decompressor: Any, data: bytes, room: int) -> tuple[bytes, str]:
    # in pieces, so that the data before a broken byte are not lost
    unpacked: list[bytes] = []
    step = _ZSTD_PIECE if isinstance(decompressor, _Zstd) else _PIECE
    for start in range(0, len(data), step):
        try:
            unpacked.append(decompressor.decompress(data[start : start + step], room))
        except (OSError, EOFError, RuntimeError, ValueError, zstandard.ZstdError) as error:
            return b"".join(unpacked), f"cannot be unpacked from byte {start} on ({error})"
        room -= len(unpacked[-1])
        if decompressor.eof or room <= 0:
            return b"".join(unpacked), ""
    return b"".join(unpacked), "compressed data end too early"


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options for recordings that do not contain everything.

    ``messages`` is a folder of ``.msg`` files, ``time`` the name of the time column of a table,
    ``start_ns`` the begin of a recording whose times are relative. ``dbc`` are files that describe
    the messages of a CAN bus, ``eds`` its CANopen nodes as ``NODE=FILE``. ``ethercat`` is a file
    such as ``black_box.yaml`` whose block ``ethercat`` describes the messages of EtherCAT segments.
    """

    messages: Path | None = None
    time: str | None = None
    start_ns: int | None = None
    dbc: Sequence[Path] = ()
    eds: Sequence[str] = ()
    ethercat: Path | None = None


_topic_index, _log_time = itemgetter(0), itemgetter(1)
_offset, _end = itemgetter(0), itemgetter(1)


class RecordedMessage(NamedTuple):
    """One message of a recording; ``topic_index`` is the index of its topic."""

    topic_index: int
    log_time_ns: int
    publish_time_ns: int | None
    data: bytes


class ReadableRange(NamedTuple):
    """A readable range of a file, and the time range of its messages."""

    offset: int
    end: int
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class RecordingDamage:
    """A range of a file that could not be read, and why.

    ``span_ns`` are the times that its messages may be of; None if they may be of any.
    """

    file: str
    offset: int
    length: int
    reason: str
    span_ns: tuple[int, int] | None = field(default=None, compare=False)

    def between(self, places: Sequence[ReadableRange]) -> RecordingDamage:
        """Return the damage with its time range: from the data before it to the data after it.

        ``places`` are in the order of the file; a damaged one counts as a whole.
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
    """A time range that the recording itself marks as a dropout."""

    from_ns: int
    to_ns: int
    reason: str


@dataclass
class PieceCounts:
    """Counts of the pieces of one file: each is a message of these topics, or refused."""

    name: str
    pieces: str
    total: int = 0
    topics: tuple[int, ...] = ()
    refused: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class TopicOrigin:
    """The origin of a topic, beside its definition.

    ``source`` is the first word of the item name, empty if the topic's name is all of it; ``stamp``
    as in the options of a topic; ``kind`` is the origin of the columns.
    """

    source: str = "ros"
    stamp: str | None = None
    kind: str = ""


_LIVE = TopicOrigin()


@dataclass
class RecordingReport:
    """The contents of a recording; the counts grow while its messages are read.

    ``notes`` state assumptions, such as the ROS distribution that definitions are taken from.
    """

    format: str
    start_ns: int | None = None
    end_ns: int | None = None
    messages: int = 0
    per_topic: list[int] = field(default_factory=list)
    damage: list[RecordingDamage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    accounts: list[PieceCounts] = field(default_factory=list)
    gaps: list[RecordedGap] = field(default_factory=list)

    def add_damage(self, damage: RecordingDamage) -> None:
        """Add a damaged range, once."""
        if damage not in self.damage:
            self.damage.append(damage)

    def add_note(self, text: str) -> None:
        """Add a note, once."""
        if text not in self.notes:
            self.notes.append(text)

    def lines(self, topics: Sequence[Topic]) -> list[str]:
        """Return the report as text, one line per fact."""
        counts = [f"  {t.name}: {n}" for t, n in zip(topics, self.per_topic, strict=False)]
        damage = [f"damaged: {d}" for d in self.damage]
        return [f"{self.format}: {self.messages} messages", *counts, *damage, *self.notes]


class TopicTable:
    """The topics of a recording; equal topics of several connections or files are one."""

    def __init__(self) -> None:
        self.topics: list[Topic] = []
        self.origins: list[TopicOrigin] = []
        self._places: dict[tuple[str, str, Schema | None, TopicOrigin], int] = {}

    def add(self, topic: Topic, origin: TopicOrigin = _LIVE) -> int:
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
class RecordingPart:
    """A part of a recording that is loaded at once, such as a chunk.

    ``load`` returns its messages in the order of the file; ``size`` is its weight in the progress.
    """

    start_ns: int
    end_ns: int
    size: int
    load: Callable[[], list[RecordedMessage]]


class RecordingReader:
    """A recording that is open for reading; a context manager.

    Every format is a function that finds topics and parts and passes them to this class.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[Topic],
        parts: Sequence[RecordingPart],
        report: RecordingReport,
        close: Callable[[], None] = lambda: None,
        origins: Sequence[TopicOrigin] = (),
    ) -> None:
        self.path = path
        self.topics = tuple(topics)
        self.origins = tuple(origins) or (_LIVE,) * len(self.topics)
        self.report = report
        self.progress = 0.0  # fraction of the recording that ``messages`` has yielded
        self.close = close
        self._parts = sorted(parts, key=lambda part: part.start_ns)
        if parts:
            report.start_ns = min(part.start_ns for part in parts)
            report.end_ns = max(part.end_ns for part in parts)

    def __enter__(self) -> RecordingReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def messages(
        self, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Yield the messages in the order of log time, those of ``[from_ns, to_ns)`` if given.

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
            low = 0 if from_ns is None else bisect_left(block, from_ns, key=_log_time)
            high = len(block) if to_ns is None else bisect_left(block, to_ns, key=_log_time)
            inside = block if high - low == len(block) else block[low:high]
            self.report.messages += len(inside)
            for topic_index, count in Counter(map(_topic_index, inside)).items():
                self.report.per_topic[topic_index] += count
            yield inside
        self.progress = 1.0

    def _load(self, part: RecordingPart) -> list[RecordedMessage]:
        """Load a part; damage found meanwhile gets its time range."""
        known = len(self.report.damage)
        messages = part.load()
        self.report.damage[known:] = [
            replace(damage, span_ns=damage.span_ns or (part.start_ns, part.end_ns))
            for damage in self.report.damage[known:]
        ]
        return messages


def _in_time_order(
    parts: Sequence[RecordingPart], load: Callable[[RecordingPart], list[RecordedMessage]]
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


def _overlaps(part: RecordingPart, from_ns: int | None, to_ns: int | None) -> bool:
    before_end = to_ns is None or part.start_ns < to_ns
    return before_end and (from_ns is None or part.end_ns >= from_ns)


ROOM_BYTES = 64 << 20
_OVERHEAD = 160  # bytes of a message beside its payload

# a number for the topic, the log time, the message
ConvertedMessage: TypeAlias = tuple[int, int, bytes]


@dataclass
class ConversionCache:
    """Keeps converted messages up to a limit of memory, so that they are not converted twice."""

    room_bytes: int = ROOM_BYTES

    def keep(
        self, messages: Sequence[ConvertedMessage], again: Callable[[], Sequence[ConvertedMessage]]
    ) -> ConvertedBlock:
        """Describe converted messages; they are loaded from memory, or by ``again``."""
        times = [time for _, time, _ in messages]
        size = sum(len(data) for _, _, data in messages) + _OVERHEAD * len(messages)
        if size > self.room_bytes:
            return ConvertedBlock(min(times), max(times), len(times), again)
        self.room_bytes -= size
        return ConvertedBlock(min(times), max(times), len(times), lambda: messages)


class ConvertedBlock(NamedTuple):
    """Converted messages: their first and last time, their number, a function that loads them."""

    first: int
    last: int
    number: int
    load: Callable[[], Sequence[ConvertedMessage]]
