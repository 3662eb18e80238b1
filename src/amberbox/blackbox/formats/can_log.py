"""Logs of CAN buses: candump, and ASC, BLF and TRC by the readers of python-can."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from amberbox.blackbox.canbus.definition import CanDefinitions
from amberbox.blackbox.canbus.files import parse_node, read_definitions
from amberbox.blackbox.canbus.frame import ERROR, ID_MASK, CanFrame
from amberbox.blackbox.formats._recording import (
    ConversionCache,
    ConvertedBlock,
    ConvertedMessage,
    FileBytes,
    PieceCounts,
    ReadOptions,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicOrigin,
)
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import format_time
from amberbox.core.types import Topic

_CANDUMP = re.compile(
    rb"\((\d{1,12}\.\d{1,9})\) (\S{1,32}) ([0-9A-F]{3}|[0-9A-F]{8})#"
    rb"(?:(R)([0-9A-F]?)|(?:#([0-9A-F]))?((?:[0-9A-F]{2}){0,64}))(?:_[0-9A-F])?(?: [RT])?\s*",
    re.IGNORECASE,
)
_KINDS = {"blf": "BLF file", "asc": "ASC file", "trc": "TRC file", "candump": "candump log"}
_BLOCK = 20_000  # frames that are converted at once
_PIECE = 1 << 20
_LONGEST_LINE = 4096
_MOST_DAMAGE = 100  # places of damage that are listed one by one
_FIRST_DATE_S = 10**8  # earlier times do not count from 1970
_LATEST_S = 1 << 33


def kind_of(path: Path, start: bytes) -> str:
    """Return which log begins with these bytes: blf, asc, trc, candump; empty for none."""
    if start.startswith(b"LOGG"):
        return "blf"
    if re.match(rb"\(\d+\.\d+\) \S", start):
        return "candump"
    if re.match(rb"date \w", start, re.IGNORECASE):
        return "asc"
    if start.startswith(b";") and (b"$FILEVERSION" in start or path.suffix.lower() == ".trc"):
        return "trc"
    return ""


def open_can_log(path: Path, kind: str, options: ReadOptions) -> RecordingReader:
    """Open a log; it is read once to find its topics and times. Raises AmberboxError."""
    try:
        nodes = [parse_node(text) for text in options.eds]
    except ValueError as error:
        raise AmberboxError(f"--eds: {error}", "write NODE=FILE, as in 5=lift.eds") from None
    log = _Log(path, kind, read_definitions(options.dbc, nodes))
    report = RecordingReport(_KINDS[kind])
    counts = PieceCounts(path.name, "frames")
    report.accounts.append(counts)
    blocks = list(_first_pass(log, report, counts))
    counts.topics = tuple(range(len(log.topics)))
    shift_ns = _shift_ns(blocks, options, report)
    parts = [_part(block, shift_ns) for block in blocks]
    channels = {channel for channel, _ in log.topics}
    origins = [
        TopicOrigin("can" if len(channels) == 1 else channel, stamp="", kind=_origin(topic))
        for channel, topic in log.topics
    ]
    return RecordingReader(
        path, [topic for _, topic in log.topics], parts, report, log.close, origins
    )


def _origin(topic: Topic) -> str:
    fixed = ("can/Frame", "can/Error")
    return "raw frames" if topic.schema and topic.schema.name in fixed else "by its definition"


def _first_pass(
    log: _Log, report: RecordingReport, counts: PieceCounts
) -> Iterator[ConvertedBlock]:
    kept = ConversionCache()
    number = 0
    while True:
        messages, frames = log.block(number)
        counts.total += frames
        if not frames:
            break
        if messages:

            def again(number: int = number) -> Sequence[ConvertedMessage]:
                return log.block(number)[0]

            yield kept.keep(messages, again)
        number += 1
    for damage in log.damage:
        report.add_damage(damage)
    for text, count in log.refused.items():
        report.add_note(f"{count} {text}")


class _Damaged(NamedTuple):
    """Bytes that are no frame."""

    offset: int
    length: int
    reason: str


@dataclass
class _Log:
    """A log, read block by block; the block after the one read last is read without a search."""

    path: Path
    kind: str
    definitions: CanDefinitions
    topics: list[tuple[str, Topic]] = field(default_factory=list)
    damage: list[RecordingDamage] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    _places: dict[tuple[str, str], int] = field(default_factory=dict)
    _frames: Iterator[Any] = field(default_factory=lambda: iter(()))
    _next: int = -1
    _close: Callable[[], None] = lambda: None

    def close(self) -> None:
        """Close the file."""
        self._close()

    def block(self, number: int) -> tuple[Sequence[ConvertedMessage], int]:
        """Return the messages of a block in order of time, and how many frames it has."""
        if number < self._next or self._next < 0:
            self._begin()
        while self._next < number:
            self._read()
        return self._read()

    def _begin(self) -> None:
        self.close()
        self._next = 0
        if self.kind == "candump":
            file = FileBytes(self.path)
            self._close, self._frames = file.close, _candump(file)
        else:
            self._close, self._frames = _reader(self.path, self.kind)

    def _read(self) -> tuple[Sequence[ConvertedMessage], int]:
        self._next += 1
        messages: list[ConvertedMessage] = []
        frames = 0
        for frame in self._frames:
            if isinstance(frame, _Damaged):
                self._note_damage(frame)
                continue
            frames += 1
            if not 0 <= frame.timestamp < _LATEST_S:
                self.refused["frames of an impossible time are left out"] += 1
                continue
            time_ns = round(frame.timestamp * 1e6) * 1000  # the resolution of these logs
            channel = _channel(frame.channel)
            for topic, data in self.definitions.records(frame):
                messages.append((self._place(channel, topic), time_ns, data))
            if frames == _BLOCK:
                break
        return sorted(messages, key=lambda message: message[1]), frames

    def _place(self, channel: str, topic: Topic) -> int:
        place = self._places.get((channel, topic.name))
        if place is None:
            place = self._places[channel, topic.name] = len(self.topics)
            self.topics.append((channel, topic))
        return place

    def _note_damage(self, found: _Damaged) -> None:
        damage = RecordingDamage(self.path.name, *found)
        if damage in self.damage:
            return
        if len(self.damage) < _MOST_DAMAGE:
            self.damage.append(damage)
        else:
            self.refused["more places are damaged"] += 1


def _channel(channel: Any) -> str:
    return f"can{channel or 0}" if channel is None or isinstance(channel, int) else str(channel)


@dataclass(slots=True)
class _CandumpFrame:
    """A line of candump; the fields are those of ``can.Message``."""

    timestamp: float
    channel: str
    arbitration_id: int
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    is_fd: bool
    bitrate_switch: bool
    error_state_indicator: bool
    dlc: int
    data: bytes


def _candump(file: FileBytes) -> Iterator[CanFrame | _Damaged]:
    for offset, line in _lines(file):
        match = _CANDUMP.fullmatch(line)
        if match is None:
            if line.strip():
                yield _Damaged(offset, len(line), "no frame of candump")
            continue
        stamp, channel, number, remote, length, flags, data = match.groups()
        bits, fd = int(number, 16), int(flags or b"0", 16)
        is_extended = len(number) == 8
        yield _CandumpFrame(
            float(stamp),
            channel.decode("ascii", "replace"),
            bits & ID_MASK,
            is_extended and not bits & ERROR,
            bool(remote),
            bool(is_extended and bits & ERROR),
            flags is not None,
            bool(fd & 1),
            bool(fd & 2),
            int(length or b"0", 16) if remote else len(data) // 2,
            bytes.fromhex((data or b"").decode()),
        )


def _lines(file: FileBytes) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a file with their offsets; longer ones in pieces."""
    offset, rest = 0, b""
    while piece := file.read(offset + len(rest), _PIECE):
        *lines, rest = (rest + piece).split(b"\n")
        for line in lines:
            yield offset, line
            offset += len(line) + 1
        if len(rest) > _LONGEST_LINE:
            yield offset, rest
            offset, rest = offset + len(rest), b""
    if rest:
        yield offset, rest


class _TextLines:
    """The lines of a text file for a reader of python-can, which may be started again."""

    def __init__(self, file: FileBytes) -> None:
        self.place, self.length, self.size = 0, 0, file.size
        self._found = _lines(file)
        self._again = False

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._again:
            self._again = False
            return "\n"
        self.place, line = next(self._found)
        self.length = len(line)
        return line.decode("utf-8", "replace") + "\n"

    def begin_again(self) -> None:
        """Give an empty line first: a reader looks for its header in it."""
        self._again = True

    def read(self, *_: Any) -> str:
        """Look like a file."""
        return "".join(self)

    write = read

    def close(self) -> None:
        """Leave the file open; the log closes it."""


def _reader(path: Path, kind: str) -> tuple[Callable[[], None], Iterator[Any]]:
    """Return a function that closes the file, and its frames."""
    try:
        from can import io
    except ImportError as error:
        raise AmberboxError(
            f"reading {path} needs python-can", "pip install 'amberbox[can]'"
        ) from error
    if kind == "blf":
        file = path.open("rb")
        return file.close, _binary(lambda: io.BLFReader(file), file)
    opened = FileBytes(path)
    lines: Any = _TextLines(opened)
    reader: Any = (
        io.ASCReader(lines, relative_timestamp=False) if kind == "asc" else io.TRCReader(lines)
    )
    return opened.close, _text(reader, lines)


def _binary(make: Callable[[], Any], file: Any) -> Iterator[Any]:
    size = Path(file.name).stat().st_size
    try:
        reader = make()
        yield from reader
    except Exception as error:  # the reader raises all kinds of errors for damaged files
        at = 0 if file.closed else min(file.tell(), size)
        yield _Damaged(at, size - at, f"the rest cannot be read: {_one_line(error)}")
        return
    if size < reader.file_size:  # the reader takes a cut for the end
        yield _Damaged(size, reader.file_size - size, "the file is cut short")


def _text(reader: Any, lines: _TextLines) -> Iterator[Any]:
    frames, failed_at = iter(reader), -1
    while True:
        try:
            frame = next(frames)
        except StopIteration:
            return
        except Exception as error:  # the readers raise all kinds of errors for damaged lines
            reason = _one_line(error)
            if lines.place == failed_at:  # a header without which no line can be read
                size = lines.size - lines.place
                yield _Damaged(lines.place, size, f"the rest cannot be read: {reason}")
                return
            yield _Damaged(lines.place, lines.length, f"no frame: {reason}")
            failed_at = lines.place
            lines.begin_again()
            frames = iter(reader)
            continue
        yield frame


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _shift_ns(
    blocks: Sequence[ConvertedBlock], options: ReadOptions, report: RecordingReport
) -> int:
    """Return what makes times count from 1970, and note how that is known."""
    if not blocks:
        return 0
    first_ns = min(block.first for block in blocks)
    if options.start_ns is not None:
        report.add_note(f"the log begins at {format_time(options.start_ns)}, as given")
        return options.start_ns - first_ns
    if first_ns < _FIRST_DATE_S * NS:
        report.add_note(
            "the log does not say what time it was: its times are kept, as if it began in 1970; "
            "--start TIME says when the log begins"
        )
    return 0


def _part(block: ConvertedBlock, shift_ns: int) -> RecordingPart:
    def load() -> list[RecordedMessage]:
        return [
            RecordedMessage(topic, time_ns + shift_ns, None, data)
            for topic, time_ns, data in block.load()
        ]

    return RecordingPart(block.first + shift_ns, block.last + shift_ns, block.number, load)
