"""The records of a ULog file one by one, and where to go on behind damaged ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from struct import Struct, error, unpack
from typing import Any

import msgspec

from amberbox.blackbox.formats.kept import Converted
from amberbox.blackbox.formats.recording import Origin
from amberbox.blackbox.formats.ulog_types import Formats, MessageType, compile_type, parse_format
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

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
class Subscription:
    """Which topic the messages of one number belong to; ``type`` None keeps them as they are."""

    topic: int
    type: MessageType | None


@dataclass
class Topics:
    """The topics of a log by their names."""

    topics: list[Topic] = field(default_factory=list)
    origins: list[Origin] = field(default_factory=list)
    _places: dict[Topic, int] = field(default_factory=dict)

    def add(self, topic: Topic, kind: str) -> int:
        """Return the number of a topic, which is made at its first mention."""
        if topic not in self._places:
            self._places[topic] = len(self.topics)
            self.topics.append(topic)
            self.origins.append(Origin(SOURCE, stamp="", kind=kind))
        return self._places[topic]


@dataclass(frozen=True, slots=True)
class State:
    """What must be known to read on from a place in the middle of the file."""

    subscriptions: Mapping[int, Subscription]
    last_us: int


@dataclass
class Reader:
    """Reads records from a known state on; what it finds is gathered here."""

    topics: Topics
    formats: dict[str, Any]
    state: State
    messages: list[Converted] = field(default_factory=list)
    data_records: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    dropouts_us: list[tuple[int, int]] = field(default_factory=list)
    utc_offsets_us: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._subscriptions, self._last_us = self.state.subscriptions, self.state.last_us

    def read(self, block: bytes) -> tuple[int, bool]:
        """Read the whole records of a block; returns how far, and whether damage is there."""
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
        self.state = State(self._subscriptions, self._last_us)
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
            self._compare_clocks(time_us, _U64(block, start + known.utc_at)[0])
        data = block[start : start + known.size]
        data = data if known.rewrite is None else known.rewrite(data)
        self.messages.append((subscription.topic, time_us, data))

    def _compare_clocks(self, time_us: int, utc_us: int) -> None:
        if _FIRST_UTC_US < utc_us < _LATEST_US:
            self.utc_offsets_us.append(utc_us - time_us)

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
        """Take the format of a message type."""
        name, fields = parse_format(_text(payload))
        self.formats.setdefault(name, fields)

    def subscribe(self, payload: bytes) -> None:
        """Take which number the messages of an instance of a type have."""
        instance, number = payload[0], _U16(payload, 1)[0]
        name = _text(payload[3:])
        topic_name = f"/{name}_{instance}" if instance else f"/{name}"
        known, topic, kind = self._typed(name, topic_name, self.formats)
        place = self.topics.add(topic, kind)
        self._subscriptions = {**self._subscriptions, number: Subscription(place, known)}

    def _typed(
        self, name: str, topic: str, formats: Formats
    ) -> tuple[MessageType | None, Topic, str]:
        try:
            known = compile_type(name, formats)
        except AmberboxError as error:
            self.notes.append(f"{name}: {error.what}; its messages are kept as they are")
            return None, Topic(topic, "ulog", Schema(name, "", b"")), f"kept raw ({error.what})"
        return known, Topic(topic, "ros1", known.schema), f"typed ({name}, from the file)"

    def info(self, payload: bytes) -> None:
        """Take something the log says about itself."""
        self._row("/info", self._last_us, {**_key_value(payload), "continued": False})

    def info_multiple(self, payload: bytes) -> None:
        """Take a piece of something longer."""
        row = {**_key_value(payload[1:]), "continued": payload[0] == 1}
        self._row("/info", self._last_us, row)

    def parameter(self, payload: bytes) -> None:
        """Take the value that a parameter has from now on."""
        self._row("/parameter", self._last_us, _key_value(payload))

    def parameter_default(self, payload: bytes) -> None:
        """Take what a parameter would be by default."""
        row = {**_key_value(payload[1:]), "system": bool(payload[0] & 1)}
        self._row("/parameter_default", self._last_us, row)

    def logged(self, payload: bytes) -> None:
        """Take a line of the autopilot's own log."""
        self._log_line(payload[0], _U64(payload, 1)[0], payload[9:], None)

    def logged_tagged(self, payload: bytes) -> None:
        """Take a line of a tagged log."""
        self._log_line(payload[0], _U64(payload, 3)[0], payload[11:], _U16(payload, 1)[0])

    def dropout(self, payload: bytes) -> None:
        """Take how long the logger could not write."""
        self.dropouts_us.append((self._last_us, self._last_us + 1000 * _U16(payload, 0)[0]))

    def _log_line(self, level: int, time_us: int, text: bytes, tag: int | None) -> None:
        if time_us > _LATEST_US:
            raise ValueError("an impossible time")
        number = level - ord("0") if level >= ord("0") else level
        name = _LEVELS[number] if number < len(_LEVELS) else "unknown"
        row = {"level": number, "level_name": name, "tag": tag, "text": _text(text)}
        self._row("/log", time_us, row)

    def _row(self, topic: str, time_us: int, row: Mapping[str, Any]) -> None:
        place = self.topics.add(Topic(topic, "msgpack"), "")
        self.messages.append((place, time_us, msgspec.msgpack.encode(row)))


def is_record(size: int, kind: int) -> bool:
    """Tell whether this may be the head of a record; later versions may add kinds."""
    return size > 0 and ord("A") <= kind <= ord("Z")


def next_record(block: bytes, start: int, subscriptions: Mapping[int, Subscription]) -> int:
    """Find where records go on behind damage: at a sync mark, or at data of a known kind."""
    sync = block.find(SYNC, start)
    stop = len(block) if sync < 0 else sync
    at = block.find(b"D", start + 2, stop)
    while at >= 0:
        if _begins_data(block, at - 2, subscriptions):
            return at - 2
        at = block.find(b"D", at + 1, stop)
    return len(block) if sync < 0 else sync + len(SYNC)


def _begins_data(block: bytes, at: int, subscriptions: Mapping[int, Subscription]) -> bool:
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
    type_name, _, key = _text(payload[1 : 1 + length]).partition(" ")
    data = payload[1 + length :]
    if type_name in _VALUES:
        (value,) = unpack(_VALUES[type_name], data)
        return {"name": key, "type": type_name, "value": float(value), "text": None}
    text = _text(data) if type_name.startswith("char") else data.hex()
    return {"name": key, "type": type_name, "value": None, "text": text}


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace").rstrip("\0")


_HANDLERS: Mapping[str, Callable[[Reader, bytes], None]] = {
    "F": Reader.format,
    "A": Reader.subscribe,
    "I": Reader.info,
    "M": Reader.info_multiple,
    "P": Reader.parameter,
    "Q": Reader.parameter_default,
    "L": Reader.logged,
    "C": Reader.logged_tagged,
    "O": Reader.dropout,
    "B": lambda reader, payload: None,
    "R": lambda reader, payload: None,
    "S": lambda reader, payload: None,
}
