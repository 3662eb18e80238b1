"""ULog files of PX4 autopilots: topics, parameters, log lines, and the times it could not write.

The bytes of a ULog message are those of a ROS 1 message, but for texts (``char`` arrays) and
padding inside a structure, which are rewritten.
"""

from __future__ import annotations

import dataclasses
import re
import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from struct import Struct, error, unpack
from typing import Any

import msgspec

from amberbox.blackbox.formats._recording import (
    ConversionCache,
    ConvertedBlock,
    ConvertedMessage,
    FileBytes,
    PieceCounts,
    ReadOptions,
    RecordedGap,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicOrigin,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.names import identifier
from amberbox.core.timestamps import format_time
from amberbox.core.types import Schema, Topic

PACKAGE = "ulog"
TIME = "timestamp"  # field of every message: microseconds since the start of the autopilot
UTC = "time_utc_usec"  # field of GPS messages: the same moment in UTC, 0 without a fix
_TYPES = {
    "int8_t": ("int8", 1), "uint8_t": ("uint8", 1), "int16_t": ("int16", 2),
    "uint16_t": ("uint16", 2), "int32_t": ("int32", 4), "uint32_t": ("uint32", 4),
    "int64_t": ("int64", 8), "uint64_t": ("uint64", 8), "float": ("float32", 4),
    "double": ("float64", 8), "bool": ("bool", 1), "char": ("string", 1),
}  # fmt: skip
_FIELD = re.compile(r"\s*(\w+)(?:\[(\d+)\])?\s+(\w+)\s*")
_DEEPEST = 8
_LARGEST = 0xFFFF


@dataclass(frozen=True, slots=True)
class UlogField:
    """One field; ``count`` is None unless it is an array."""

    base: str
    count: int | None
    name: str

    @property
    def is_padding(self) -> bool:
        """Return whether the field is only padding."""
        return self.name.startswith("_padding")


@dataclass(frozen=True, slots=True)
class UlogType:
    """A message of ULog that can be unrolled.

    ``size`` is that without padding at its end, ``largest`` with it. The offsets are -1 where
    there is no such field. ``rewrite`` makes a ROS 1 message, None if it is one already.
    """

    schema: Schema
    size: int
    largest: int
    time_at: int
    utc_at: int
    rewrite: Callable[[bytes], bytes] | None


def parse_format(text: str) -> tuple[str, tuple[UlogField, ...]]:
    """Read ``name:type field;type[n] field;``; raises ValueError."""
    name, colon, rest = text.partition(":")
    if not colon or not name:
        raise ValueError(f"no format: {text[:40]!r}")
    return name, tuple(_parse_field(part) for part in rest.split(";") if part)


def _parse_field(text: str) -> UlogField:
    match = _FIELD.fullmatch(text)
    if match is None:
        raise ValueError(f"no field: {text[:40]!r}")
    base, count, name = match.groups()
    return UlogField(base, None if count is None else int(count), name)


Formats = Mapping[str, Sequence[UlogField]]


def compile_type(name: str, formats: Formats) -> UlogType:
    """Compile a message type; raises AmberboxError when a format in it is missing or too large."""
    fields = list(_fields(name, formats))
    largest = _size(fields, formats)
    while fields and fields[-1].is_padding:
        fields.pop()
    pieces = _merged(_pieces(fields, formats, 0))
    size = _size(fields, formats)
    whole = pieces == [(0, size, False)]
    return UlogType(
        Schema(f"{PACKAGE}/{name}", "ros1msg", _definition(name, fields, formats).encode()),
        size,
        largest,
        _offset_of(TIME, fields, formats),
        _offset_of(UTC, fields, formats),
        None if whole else partial(_rewrite, pieces),
    )


def _fields(name: str, formats: Formats, depth: int = 0) -> Sequence[UlogField]:
    if name not in formats or depth > _DEEPEST:
        what = "is missing" if name not in formats else "contains itself"
        raise AmberboxError(f"the format {name} {what}", "its messages are kept as they are")
    for field in formats[name]:
        if field.base not in _TYPES:
            _fields(field.base, formats, depth + 1)
    return formats[name]


def _size(fields: Sequence[UlogField], formats: Formats) -> int:
    size = sum(_field_size(field, formats) for field in fields)
    if size > _LARGEST:
        raise AmberboxError(f"a format of {size} bytes", "its messages are kept as they are")
    return size


def _field_size(field: UlogField, formats: Formats) -> int:
    count = 1 if field.count is None else field.count
    if field.base in _TYPES:
        return count * _TYPES[field.base][1]
    return count * _size(formats[field.base], formats)


def _offset_of(name: str, fields: Sequence[UlogField], formats: Formats) -> int:
    at = 0
    for field in fields:
        if (field.name, field.base, field.count) == (name, "uint64_t", None):
            return at
        at += _field_size(field, formats)
    return -1


# -- the definition


def _definition(name: str, fields: Sequence[UlogField], formats: Formats) -> str:
    texts = [_structure(fields)]
    needed, done = [f.base for f in fields], {name}
    while needed:
        base = needed.pop(0)
        if base in _TYPES or base in done:
            continue
        done.add(base)
        texts.append(f"MSG: {PACKAGE}/{base}\n{_structure(formats[base])}")
        needed += [field.base for field in formats[base]]
    return ("=" * 80 + "\n").join(texts)


def _structure(fields: Sequence[UlogField]) -> str:
    names = {field.name for field in fields}
    lines = [_line(field, names) for field in fields if not field.is_padding]
    return "".join(lines)


def _line(field: UlogField, names: set[str]) -> str:
    base = _TYPES[field.base][0] if field.base in _TYPES else f"{PACKAGE}/{field.base}"
    array = "" if field.count is None or field.base == "char" else f"[{field.count}]"
    return f"{base}{array} {_name(field, names)}\n"


def _name(field: UlogField, names: set[str]) -> str:
    """Return the name of a field; ``timestamp``, which rows have already, gets its unit."""
    if field.name == TIME and f"{TIME}_us" not in names:
        return f"{TIME}_us"
    return identifier(field.name.lstrip("_") or field.name)


# -- the bytes

_Piece = tuple[int, int, bool]  # from and to which byte, and whether that is a text


def _pieces(fields: Sequence[UlogField], formats: Formats, at: int) -> Iterator[_Piece]:
    for field in fields:
        size = _field_size(field, formats)
        if field.base in _TYPES:
            if not field.is_padding:
                yield at, at + size, field.base == "char"
            at += size
            continue
        inner = formats[field.base]
        for _ in range(1 if field.count is None else field.count):
            yield from _pieces(inner, formats, at)
            at += _size(inner, formats)


def _merged(pieces: Iterator[_Piece]) -> list[_Piece]:
    merged: list[_Piece] = []
    for start, end, is_text in pieces:
        if merged and not is_text and not merged[-1][2] and merged[-1][1] == start:
            merged[-1] = (merged[-1][0], end, False)
        else:
            merged.append((start, end, is_text))
    return merged


def _rewrite(pieces: Sequence[_Piece], message: bytes) -> bytes:
    return b"".join(
        _text(message[start:end]) if is_text else message[start:end]
        for start, end, is_text in pieces
    )


def _text(characters: bytes) -> bytes:
    """Encode a text for ROS 1; in ULog it ends at its first NUL."""
    text = characters.partition(b"\0")[0]
    return len(text).to_bytes(4, "little") + text


HEAD = Struct("<HB").unpack_from
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
SOURCE = "ulog"
_U16 = Struct("<H").unpack_from
_U64 = Struct("<Q").unpack_from
_DATA = ord("D")
_FIRST_UTC_US = 10**15
_LATEST_US = 2**53
_LEVELS = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_VALUES = {
    "int8_t": "<b", "uint8_t": "<B", "int16_t": "<h", "uint16_t": "<H", "int32_t": "<i",
    "uint32_t": "<I", "int64_t": "<q", "uint64_t": "<Q", "float": "<f", "double": "<d",
    "bool": "<?",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class UlogSubscription:
    """The topic of the messages of one number; ``type`` None keeps them unconverted."""

    topic: int
    type: UlogType | None


@dataclass
class UlogTopics:
    """The topics of a log by their names."""

    topics: list[Topic] = dataclasses.field(default_factory=list)
    origins: list[TopicOrigin] = dataclasses.field(default_factory=list)
    _places: dict[Topic, int] = dataclasses.field(default_factory=dict)

    def add(self, topic: Topic, kind: str) -> int:
        """Return the number of a topic, which is made at its first mention."""
        if topic not in self._places:
            self._places[topic] = len(self.topics)
            self.topics.append(topic)
            self.origins.append(TopicOrigin(SOURCE, stamp="", kind=kind))
        return self._places[topic]


@dataclass(frozen=True, slots=True)
class UlogState:
    """State needed to read on from the middle of the file."""

    subscriptions: Mapping[int, UlogSubscription]
    last_us: int


@dataclass
class UlogReader:
    """Reads records from a given position on and collects their content."""

    topics: UlogTopics
    formats: dict[str, Any]
    state: UlogState
    messages: list[ConvertedMessage] = dataclasses.field(default_factory=list)
    data_records: int = 0
    refused: Counter[str] = dataclasses.field(default_factory=Counter)
    dropouts_us: list[tuple[int, int]] = dataclasses.field(default_factory=list)
    utc_offsets_us: list[int] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        self._subscriptions, self._last_us = self.state.subscriptions, self.state.last_us

    def read(self, block: bytes) -> tuple[int, bool]:
        """Read the complete records of a block; return the bytes read, and whether there
        is damage.
        """
        at, end = 0, len(block)
        while at + 3 <= end:
            size, kind = HEAD(block, at)
            after = at + 3 + size
            if not is_record(size, kind):
                return self._stop(at, True)
            if after > end:
                break
            if kind == _DATA:
                self._data(block, at + 3, after)
            else:
                self._other(kind, block[at + 3 : after])
            at = after
        return self._stop(at, False)

    def _stop(self, at: int, damaged: bool) -> tuple[int, bool]:
        self.state = UlogState(self._subscriptions, self._last_us)
        return at, damaged

    def _data(self, block: bytes, start: int, end: int) -> None:
        self.data_records += 1
        subscription = self._subscriptions.get(_U16(block, start)[0]) if end - start >= 2 else None
        if subscription is None:
            self.refused["of an unknown message number"] += 1
            return
        start += 2
        known = subscription.type
        if known is None:
            self.messages.append((subscription.topic, self._last_us, block[start:end]))
            return
        if not known.size <= end - start <= known.largest:
            self.refused["of a wrong length"] += 1
            return
        time_us = _U64(block, start + known.time_at)[0] if known.time_at >= 0 else self._last_us
        if time_us > _LATEST_US:
            self.refused["of an impossible time"] += 1
            return
        self._last_us = max(self._last_us, time_us)
        if known.utc_at >= 0:
            utc_us = _U64(block, start + known.utc_at)[0]
            if _FIRST_UTC_US < utc_us < _LATEST_US:
                self.utc_offsets_us.append(utc_us - time_us)
        data = block[start : start + known.size]
        data = data if known.rewrite is None else known.rewrite(data)
        self.messages.append((subscription.topic, time_us, data))

    def _other(self, kind: int, payload: bytes) -> None:
        handle = _HANDLERS.get(chr(kind))
        if handle is None:
            self.notes.append(f"records of kind {chr(kind)!r} are not known and left out")
            return
        try:
            handle(self, payload)
        except (ValueError, IndexError, error) as problem:
            self.notes.append(f"a record of kind {chr(kind)!r} makes no sense ({problem})")

    # -- the other kinds of records

    def format(self, payload: bytes) -> None:
        """Handle the format of a message type."""
        name, fields = parse_format(_decode_text(payload))
        self.formats.setdefault(name, fields)

    def subscribe(self, payload: bytes) -> None:
        """Handle a subscription: the number of the messages of an instance of a type."""
        instance, number = payload[0], _U16(payload, 1)[0]
        name = _decode_text(payload[3:])
        topic_name = f"/{name}_{instance}" if instance else f"/{name}"
        known, topic, kind = self._typed(name, topic_name, self.formats)
        place = self.topics.add(topic, kind)
        self._subscriptions = {**self._subscriptions, number: UlogSubscription(place, known)}

    def _typed(self, name: str, topic: str, formats: Formats) -> tuple[UlogType | None, Topic, str]:
        try:
            known = compile_type(name, formats)
        except AmberboxError as error:
            self.notes.append(f"{name}: {error.what}; its messages are kept as they are")
            return None, Topic(topic, "ulog", Schema(name, "", b"")), f"kept raw ({error.what})"
        return known, Topic(topic, "ros1", known.schema), f"typed ({name}, from the file)"

    def info(self, payload: bytes) -> None:
        """Handle information about the log."""
        self._row("/info", self._last_us, {**_key_value(payload), "continued": False})

    def info_multiple(self, payload: bytes) -> None:
        """Handle one part of longer information."""
        row = {**_key_value(payload[1:]), "continued": payload[0] == 1}
        self._row("/info", self._last_us, row)

    def parameter(self, payload: bytes) -> None:
        """Handle the new value of a parameter."""
        self._row("/parameter", self._last_us, _key_value(payload))

    def parameter_default(self, payload: bytes) -> None:
        """Handle the default of a parameter."""
        row = {**_key_value(payload[1:]), "system": bool(payload[0] & 1)}
        self._row("/parameter_default", self._last_us, row)

    def logged(self, payload: bytes) -> None:
        """Handle a line of the autopilot's own log."""
        self._log_line(payload[0], _U64(payload, 1)[0], payload[9:], None)

    def logged_tagged(self, payload: bytes) -> None:
        """Handle a line of a tagged log."""
        self._log_line(payload[0], _U64(payload, 3)[0], payload[11:], _U16(payload, 1)[0])

    def dropout(self, payload: bytes) -> None:
        """Handle a dropout: how long the logger could not write."""
        self.dropouts_us.append((self._last_us, self._last_us + 1000 * _U16(payload, 0)[0]))

    def _log_line(self, level: int, time_us: int, text: bytes, tag: int | None) -> None:
        if time_us > _LATEST_US:
            raise ValueError("an impossible time")
        number = level - ord("0") if level >= ord("0") else level
        name = _LEVELS[number] if number < len(_LEVELS) else "unknown"
        row = {"level": number, "level_name": name, "tag": tag, "text": _decode_text(text)}
        self._row("/log", time_us, row)

    def _row(self, topic: str, time_us: int, row: Mapping[str, Any]) -> None:
        place = self.topics.add(Topic(topic, "msgpack"), "")
        self.messages.append((place, time_us, msgspec.msgpack.encode(row)))


def is_record(size: int, kind: int) -> bool:
    """Return whether this may be the head of a record; later versions may add kinds."""
    return size > 0 and ord("A") <= kind <= ord("Z")


def next_record(block: bytes, subscriptions: Mapping[int, UlogSubscription]) -> int:
    """Return where records continue after damage: at a sync mark, or at data of a known number."""
    sync = block.find(SYNC)
    stop = len(block) if sync < 0 else sync
    at = block.find(b"D", 2, stop)
    while at >= 0:
        if _begins_data(block, at - 2, subscriptions):
            return at - 2
        at = block.find(b"D", at + 1, stop)
    return len(block) if sync < 0 else sync + len(SYNC)


def _begins_data(block: bytes, at: int, subscriptions: Mapping[int, UlogSubscription]) -> bool:
    if at + 5 > len(block):
        return False
    subscription = subscriptions.get(_U16(block, at + 3)[0])
    known = subscription.type if subscription else None
    return known is not None and known.size + 2 <= _U16(block, at)[0] <= known.largest + 2


def _key_value(payload: bytes) -> dict[str, Any]:
    """Read a key with its type, and the value; numbers and texts have columns of their own."""
    length = payload[0]
    if length >= len(payload):
        raise ValueError("its key is longer than the record")
    type_name, _, key = _decode_text(payload[1 : 1 + length]).partition(" ")
    data = payload[1 + length :]
    if type_name in _VALUES:
        (value,) = unpack(_VALUES[type_name], data)
        return {"name": key, "type": type_name, "value": float(value), "text": None}
    text = _decode_text(data) if type_name.startswith("char") else data.hex()
    return {"name": key, "type": type_name, "value": None, "text": text}


def _decode_text(data: bytes) -> str:
    return data.decode("utf-8", "replace").rstrip("\0")


_HANDLERS: Mapping[str, Callable[[UlogReader, bytes], None]] = {
    "F": UlogReader.format,
    "A": UlogReader.subscribe,
    "I": UlogReader.info,
    "M": UlogReader.info_multiple,
    "P": UlogReader.parameter,
    "Q": UlogReader.parameter_default,
    "L": UlogReader.logged,
    "C": UlogReader.logged_tagged,
    "O": UlogReader.dropout,
    "B": lambda reader, payload: None,
    "R": lambda reader, payload: None,
    "S": lambda reader, payload: None,
}


MAGIC = b"ULog\x01\x12\x35"
_HEADER_BYTES = 16
_BLOCK = 1 << 20
_US = 1000
_FLAG_BITS = b"\x28\x00B"


@dataclass
class _Log:
    """State while a file is read for the first time."""

    file: FileBytes
    report: RecordingReport
    account: PieceCounts
    state: UlogState
    topics: UlogTopics = dataclasses.field(default_factory=UlogTopics)
    formats: dict[str, Formats] = dataclasses.field(default_factory=dict)
    kept: ConversionCache = dataclasses.field(default_factory=ConversionCache)
    blocks: list[ConvertedBlock] = dataclasses.field(default_factory=list)
    dropouts_us: list[tuple[int, int]] = dataclasses.field(default_factory=list)
    utc_offsets_us: list[int] = dataclasses.field(default_factory=list)


def open_ulog(path: Path, options: ReadOptions) -> RecordingReader:
    """Open a ULog file; it is read once to find its topics and times."""
    file = FileBytes(path)
    try:
        return _open(path, file, options)
    except BaseException:
        file.close()
        raise


def _open(path: Path, file: FileBytes, options: ReadOptions) -> RecordingReader:
    header = file.read(0, _HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        raise AmberboxError(f"{path} ends within its header", "nothing was logged in it")
    start_us = int.from_bytes(header[8:], "little")
    report = RecordingReport("ULog file")
    log = _Log(file, report, PieceCounts(path.name, "data records"), UlogState({}, start_us))
    report.accounts.append(log.account)
    for start, stop in _regions(file, path):
        _read_region(log, start, stop)
    base_ns = _base_ns(log, start_us, options)
    report.gaps += [
        RecordedGap(_shifted(base_ns, start), _shifted(base_ns, end), "dropout in the log")
        for start, end in log.dropouts_us
    ]
    log.account.topics = tuple(
        n for n, topic in enumerate(log.topics.topics) if topic.message_encoding != "msgpack"
    )
    parts = [_part(block, base_ns) for block in log.blocks]
    topics = log.topics
    return RecordingReader(path, topics.topics, parts, report, file.close, topics.origins)


def _regions(file: FileBytes, path: Path) -> Iterator[tuple[int, int]]:
    """Yield the regions of the file: data appended after a crash begin at stated offsets."""
    flags = file.read(_HEADER_BYTES, 3 + 40)
    offsets: list[int] = []
    if flags.startswith(_FLAG_BITS) and len(flags) == 43:
        _refuse_unknown(flags[11:19], path)
        found = [int.from_bytes(flags[at : at + 8], "little") for at in (19, 27, 35)]
        offsets = sorted(offset for offset in found if _HEADER_BYTES < offset < file.size)
    edges = [_HEADER_BYTES, *offsets, file.size]
    yield from pairwise(edges)


def _refuse_unknown(flags: bytes, path: Path) -> None:
    if flags[0] & 0xFE or any(flags[1:]):
        raise AmberboxError(
            f"{path} needs a newer reader: its incompatible flags are {flags.hex()}",
            "a later version of Amberbox may know them",
        )


def _read_region(log: _Log, start: int, stop: int) -> None:
    at = start
    while at < stop:
        used, damaged = _read_block(log, at, stop)
        at += used
        if damaged:
            at = _skip_damage(log, at, stop)
        elif not used:
            if stop < log.file.size:
                log.report.add_note(f"{stop - at} bytes before appended data are no whole record")
            else:
                reason = "the file is cut short"
                log.report.add_damage(RecordingDamage(log.file.path.name, at, stop - at, reason))
            return


def _read_block(log: _Log, offset: int, stop: int) -> tuple[int, bool]:
    reader = UlogReader(log.topics, log.formats, log.state)
    before = log.state
    used, damaged = reader.read(log.file.read(offset, min(_BLOCK, stop - offset)))
    log.state = reader.state
    log.account.total += reader.data_records
    log.account.refused.update(reader.refused)
    log.dropouts_us += reader.dropouts_us
    log.utc_offsets_us += reader.utc_offsets_us
    for note in reader.notes:
        log.report.add_note(note)
    if reader.messages:
        again = partial(_read_again, log, offset, used, before)
        log.blocks.append(log.kept.keep(reader.messages, again))
    return used, damaged


def _read_again(log: _Log, offset: int, size: int, state: UlogState) -> Sequence[ConvertedMessage]:
    reader = UlogReader(log.topics, log.formats, state)
    reader.read(log.file.read(offset, size))
    return reader.messages


def _skip_damage(log: _Log, at: int, stop: int) -> int:
    """Report damage and return where records continue."""
    found = at + 1
    while found < stop:
        block = log.file.read(found, min(_BLOCK, stop - found))
        place = next_record(block, log.state.subscriptions)
        if place < len(block):
            found += place
            break
        found += max(1, len(block) - 16) if found + len(block) < stop else len(block)
    reason = "no record begins here"
    log.report.add_damage(RecordingDamage(log.file.path.name, at, found - at, reason))
    return found


# -- time


def _base_ns(log: _Log, start_us: int, options: ReadOptions) -> int:
    """Return when the autopilot's clock was 0, and note how that is known."""
    if options.start_ns is not None:
        base_ns = options.start_ns - start_us * _US
        log.report.add_note(f"the log begins at {format_time(options.start_ns)}, as given")
        return base_ns
    if log.utc_offsets_us:
        base_ns = round(statistics.median(log.utc_offsets_us)) * _US
        log.report.add_note(
            f"times are UTC by GPS: the autopilot started at {format_time(base_ns)}"
        )
        return base_ns
    log.report.add_note(
        "the log does not say what time it was: times count from the start of the autopilot, "
        "as if that was 1970; --start TIME says when the log begins"
    )
    return 0


def _shifted(base_ns: int, time_us: int) -> int:
    return max(0, base_ns + time_us * _US)


def _part(block: ConvertedBlock, base_ns: int) -> RecordingPart:
    def load() -> list[RecordedMessage]:
        return [
            RecordedMessage(topic, _shifted(base_ns, time_us), None, data)
            for topic, time_us, data in block.load()
        ]

    first_ns, last_ns = _shifted(base_ns, block.first), _shifted(base_ns, block.last)
    return RecordingPart(first_ns, last_ns, block.number, load)
