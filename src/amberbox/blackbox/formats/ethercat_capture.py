"""Captures of EtherCAT segments in pcap and pcapng, with the columns of the live source."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct
from typing import NamedTuple

from amberbox.blackbox.ethercat.bus import BusCounts, EtherCatBus
from amberbox.blackbox.ethercat.images import InterfaceOptions
from amberbox.blackbox.ethercat.options import EtherCatOptions, read_block
from amberbox.blackbox.formats._recording import (
    ConversionCache,
    ConvertedBlock,
    ConvertedMessage,
    FileBytes,
    ReadOptions,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReader,
    RecordingReport,
    TopicOrigin,
)
from amberbox.core.clock import NS
from amberbox.core.types import Topic

PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
PCAP_MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""First bytes of a pcap file, with its byte order and the ns of a unit of its times."""

_ETHERNET = 1
_LINK_MASK = 0x0FFF_FFFF
_MOST_FRAME = 1 << 18
_MOST_BLOCK = 16 << 20
_MOST_INTERFACES = 64
_MOST_NS = 1 << 62
_PIECE = 1 << 20
_BLOCK = 20_000  # frames that are converted at once
_SECTION, _INTERFACE, _SIMPLE, _PACKET = 0x0A0D0D0A, 1, 3, 6
_NAME, _RESOLUTION, _OFFSET, _FLAGS = 2, 9, 14, 2  # options


def is_capture(start: bytes) -> bool:
    """Return whether a file begins as pcap or pcapng."""
    return start.startswith(PCAPNG_MAGIC) or start[:4] in PCAP_MAGICS


class CapturedFrame(NamedTuple):
    """A frame; ``sent`` is whether the computer that captured it sent or received it, if known."""

    interface: str
    time_ns: int
    data: bytes
    sent: bool | None = None


class Refused(NamedTuple):
    """A frame that cannot be used."""

    reason: str


class Damaged(NamedTuple):
    """Bytes that cannot be read."""

    offset: int
    length: int
    reason: str


class _Buffered:
    """Reads a file onwards in pieces."""

    def __init__(self, file: FileBytes) -> None:
        self._file = file
        self._begin, self._data = 0, b""

    @property
    def size(self) -> int:
        return self._file.size

    def read(self, offset: int, length: int) -> bytes:
        place = offset - self._begin
        if place < 0 or place + length > len(self._data):
            self._begin, self._data = offset, self._file.read(offset, max(length, _PIECE))
            place = 0
        return self._data[place : place + length]


def read_capture(source: FileBytes) -> Iterator[CapturedFrame | Refused | Damaged]:
    """Yield the frames of a capture; after damage the rest of the file is not read."""
    file = _Buffered(source)
    magic = file.read(0, 4)
    yield from _pcapng(file) if magic == PCAPNG_MAGIC else _pcap(file, *PCAP_MAGICS[magic])


def _pcap(file: _Buffered, order: str, unit_ns: int) -> Iterator[CapturedFrame | Refused | Damaged]:
    head = file.read(0, 24)
    if len(head) < 24:
        yield Damaged(0, file.size, "the file is cut short")
        return
    (link,) = Struct(order + "I").unpack_from(head, 20)
    record = Struct(order + "IIII")
    place = 24
    while place < file.size:
        start = file.read(place, record.size)
        if len(start) < record.size:
            yield Damaged(place, file.size - place, "the file is cut short")
            return
        seconds, fraction, length, full = record.unpack(start)
        if length > _MOST_FRAME:
            yield _rest(file, place, f"a frame says that it has {length} bytes")
            return
        data = file.read(place + record.size, length)
        if len(data) < length:
            yield Damaged(place, file.size - place, "the file is cut short")
            return
        place += record.size + length
        yield _frame(link & _LINK_MASK, "", seconds * NS + fraction * unit_ns, data, full, None)


def _rest(file: _Buffered, place: int, reason: str) -> Damaged:
    return Damaged(place, file.size - place, f"{reason}; the rest is not read")


def _frame(
    link: int, interface: str, time_ns: int, data: bytes, full: int, sent: bool | None
) -> CapturedFrame | Refused:
    if link != _ETHERNET:
        return Refused(f"frames without Ethernet header (link type {link}) are left out")
    if len(data) < full:
        return Refused("frames that were captured in part are left out (snap length)")
    if not 0 <= time_ns < _MOST_NS:
        return Refused("frames of an impossible time are left out")
    return CapturedFrame(interface, time_ns, data, sent)


class _Interface(NamedTuple):
    """An interface of a section of a pcapng file."""

    name: str
    link: int
    ticks: int
    """Per second."""
    offset_s: int

    def time_ns(self, high: int, low: int) -> int:
        return self.offset_s * NS + (high << 32 | low) * NS // self.ticks


def _pcapng(file: _Buffered) -> Iterator[CapturedFrame | Refused | Damaged]:
    order = "<"
    interfaces: list[_Interface] = []
    place = 0
    while place < file.size:
        start = file.read(place, 12)
        if start[:4] == PCAPNG_MAGIC:
            order = "<" if start[8:] == b"\x4d\x3c\x2b\x1a" else ">"
            interfaces = []
        block = _block(file, place, start, order)
        if isinstance(block, Damaged):
            yield block
            return
        (kind,) = Struct(order + "I").unpack_from(block)
        body = block[8:-4]
        if kind == _INTERFACE and len(body) >= 8 and len(interfaces) < _MOST_INTERFACES:
            interfaces.append(_interface(order, body, len(interfaces)))
        elif kind == _PACKET and len(body) >= 20:
            yield _packet(order, body, interfaces)
        elif kind == _SIMPLE:
            yield Refused("frames without a time are left out")
        elif kind in (_INTERFACE, _PACKET):
            yield Refused("blocks are too short, or of too many interfaces")
        place += len(block)


def _block(file: _Buffered, place: int, start: bytes, order: str) -> bytes | Damaged:
    if len(start) < 12:
        return Damaged(place, file.size - place, "the file is cut short")
    (length,) = Struct(order + "I").unpack_from(start, 4)
    if length % 4 or not 12 <= length <= _MOST_BLOCK:
        return _rest(file, place, f"a block says that it has {length} bytes")
    block = file.read(place, length)
    if len(block) < length:
        return Damaged(place, file.size - place, "the file is cut short")
    if block[-4:] != block[4:8]:
        return _rest(file, place, "the two lengths of a block differ")
    return block


def _interface(order: str, body: bytes, number: int) -> _Interface:
    (link,) = Struct(order + "H").unpack_from(body)
    name, ticks, offset_s = f"interface_{number}", 10**6, 0
    for code, value in _options(order, body[8:]):
        if code == _NAME:
            name = value.rstrip(b"\0").decode("utf-8", "replace")[:64] or name
        elif code == _RESOLUTION and value:
            exponent = value[0] & 0x7F
            ticks = 2**exponent if value[0] & 0x80 else 10 ** min(exponent, 30)
        elif code == _OFFSET and len(value) == 8:
            (offset_s,) = Struct(order + "q").unpack(value)
    return _Interface(name, link, ticks, offset_s)


def _packet(order: str, body: bytes, interfaces: Sequence[_Interface]) -> CapturedFrame | Refused:
    number, high, low, length, full = Struct(order + "IIIII").unpack_from(body)
    if number >= len(interfaces):
        return Refused("frames of an unknown interface are left out")
    if length > len(body) - 20:
        return Refused("frames that are longer than their block are left out")
    sent = None
    for code, value in _options(order, body[20 + (length + 3) // 4 * 4 :]):
        if code == _FLAGS and len(value) == 4:
            (flags,) = Struct(order + "I").unpack(value)
            sent = {1: False, 2: True}.get(flags & 3)
    one = interfaces[number]
    data = body[20 : 20 + length]
    return _frame(one.link, one.name, one.time_ns(high, low), data, full, sent)


def _options(order: str, data: bytes) -> Iterator[tuple[int, bytes]]:
    head = Struct(order + "HH")
    place = 0
    while place + 4 <= len(data):
        code, length = head.unpack_from(data, place)
        if not code:
            return
        yield code, data[place + 4 : place + 4 + length]
        place += 4 + (length + 3) // 4 * 4


def open_ethercat_capture(path: Path, options: ReadOptions) -> RecordingReader:
    """Open a capture; it is read once to find its topics and times. Raises AmberboxError."""
    described = None if options.ethercat is None else read_block(options.ethercat)
    capture = _Capture(path, FileBytes(path), described)
    report = RecordingReport("EtherCAT capture")
    blocks = list(_first_pass(capture, report))
    parts = [_part(block) for block in blocks]
    alike = len({interface for interface, _ in capture.topics}) > 1 and (
        described is None or len(described.interfaces) == 1
    )
    origins = [
        TopicOrigin(name if alike else "ethercat", stamp="", kind="by its layout")
        for name, _ in capture.topics
    ]
    topics = [topic for _, topic in capture.topics]
    return RecordingReader(path, topics, parts, report, capture.close, origins)


def _first_pass(capture: _Capture, report: RecordingReport) -> Iterator[ConvertedBlock]:
    kept = ConversionCache()
    number = 0
    while (messages := capture.block(number)) is not None:
        if messages:

            def again(number: int = number) -> Sequence[ConvertedMessage]:
                return capture.block(number) or ()

            yield kept.keep(messages, again)
        number += 1
    for damage in capture.damage:
        report.add_damage(damage)
    for text, count in capture.refused.items():
        report.add_note(f"{count} {text}")
    for text in capture.told:
        report.add_note(text)
    for name, counts in capture.counts().items():
        report.add_note(
            f"{name or 'EtherCAT'}: {counts.sent} frames out, {counts.returned} back, "
            f"{counts.lost} lost, {counts.malformed} malformed, {counts.other} of other protocols"
        )


@dataclass
class _Capture:
    """A capture, read block by block; the block after the one read last is read without a search.

    What is lost or learnt depends on the frames before, so a block is read with all before it.
    """

    path: Path
    file: FileBytes
    described: EtherCatOptions | None
    topics: list[tuple[str, Topic]] = field(default_factory=list)
    damage: list[RecordingDamage] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)
    _places: dict[tuple[str, str], int] = field(default_factory=dict)
    _buses: dict[str, EtherCatBus | None] = field(default_factory=dict)
    _found: list[ConvertedMessage] = field(default_factory=list)
    _frames: Iterator[CapturedFrame | Refused | Damaged] = field(default_factory=lambda: iter(()))
    _next: int = -1

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def counts(self) -> dict[str, BusCounts]:
        """Return the counts of each interface."""
        return {name: bus.counts for name, bus in self._buses.items() if bus is not None}

    def block(self, number: int) -> Sequence[ConvertedMessage] | None:
        """Return the messages of a block in order of time; None after the end."""
        if number < self._next or self._next < 0:
            self._frames, self._buses, self._next = read_capture(self.file), {}, 0
            self.damage, self.refused, self.told = [], Counter(), []
        while self._next < number:
            self._read()
        return self._read()

    def _read(self) -> Sequence[ConvertedMessage] | None:
        self._next += 1
        self._found = []
        frames = 0
        for one in self._frames:
            frames += 1
            if isinstance(one, Damaged):
                self.damage.append(RecordingDamage(self.path.name, *one))
            elif isinstance(one, Refused):
                self.refused[one.reason] += 1
            elif (bus := self._bus(one.interface)) is not None:
                bus.frame(one.data, one.time_ns, one.sent)
            if frames == _BLOCK:
                break
        if not frames:
            return None
        return sorted(self._found, key=lambda message: message[1])

    def _bus(self, name: str) -> EtherCatBus | None:
        """Return the segment of an interface; None if the configuration has others only."""
        if name not in self._buses:
            options, prefix = self._options(name)
            self._buses[name] = None
            if options is not None:
                self._buses[name] = EtherCatBus(
                    options,
                    lambda topic, data, time_ns: self._put(name, topic, data, time_ns),
                    lambda _, text: self._tell(text),
                    prefix,
                )
            else:
                self._tell(f"interface {name} is not in the configuration; it is left out")
        return self._buses[name]

    def _options(self, name: str) -> tuple[InterfaceOptions | None, str]:
        if self.described is None:
            return InterfaceOptions(name or "capture", datagrams="all"), ""
        for one in self.described.interfaces:
            if one.interface == name or len(self.described.interfaces) == 1:
                return one, self.described.prefix(one)
        return None, ""

    def _tell(self, text: str) -> None:
        if text not in self.told:
            self.told.append(text)

    def _put(self, interface: str, topic: Topic, data: bytes, time_ns: int) -> None:
        place = self._places.get((interface, topic.name))
        if place is None:
            place = self._places[interface, topic.name] = len(self.topics)
            self.topics.append((interface, topic))
        self._found.append((place, time_ns, data))


def _part(block: ConvertedBlock) -> RecordingPart:
    def load() -> list[RecordedMessage]:
        return [
            RecordedMessage(topic, time_ns, None, data) for topic, time_ns, data in block.load()
        ]

    return RecordingPart(block.first, block.last, block.number, load)
