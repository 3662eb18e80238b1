"""Process images: the messages of the ``ethercat`` block, and where datagrams have them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.blackbox.columns.frame_layout import (
    MESSAGE_ENCODING,
    FrameField,
    FrameLayout,
    read_layout,
)
from amberbox.blackbox.ethercat.frame import LRD, LRW, LWR
from amberbox.core.errors import AmberboxError, did_you_mean
from amberbox.core.options import option
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic

Datagrams = Literal["unknown", "all", "none"]
Kind = Literal["uint", "int", "float", "bool"]

TYPES: Mapping[str, tuple[Kind, int]] = {
    "bool": ("bool", 1),
    **{f"uint{bits}": ("uint", bits) for bits in (8, 16, 32, 64)},
    **{f"int{bits}": ("int", bits) for bits in (8, 16, 32, 64)},
    **dict.fromkeys(("float", "float32"), ("float", 32)),
    **dict.fromkeys(("double", "float64"), ("float", 64)),
}
_MOST_SLAVES = 1000
_MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class ElementOptions:
    """One value of a message."""

    name: str = option(doc="name of the value")
    type: str = option(doc="uint8 to uint64, int8 to int64, float, double, or bool for one bit")
    offset: int | None = option(
        None, "byte in the message; after the element before it when absent", unit="bytes"
    )
    bit: int = option(0, "lowest bit of a bool in its byte, 0 to 7")
    unit: str = option("", "unit of the value")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if self.type not in TYPES:
            yield "type", f"'{self.type}' is no type{did_you_mean(self.type, list(TYPES))}"
        if self.offset is not None and not 0 <= self.offset < _MOST_BYTES:
            yield "offset", "must be 0 or more, and within the message"
        if self.bit and self.type != "bool":
            yield "bit", "only a bool has one"
        if not 0 <= self.bit <= 7:
            yield "bit", "must be 0 to 7"


@dataclass(frozen=True)
class InterfaceOptions:
    """One EtherCAT segment, and the messages in its process image.

    A message is what each slave sends or receives; all slaves have the same.
    """

    interface: str = option(doc="network interface of the computer, such as eth1")
    input_message_size: int = option(
        0, "input message of one slave; that of its elements when absent", unit="bytes"
    )
    output_message_size: int = option(
        0, "output message of one slave; that of its elements when absent", unit="bytes"
    )
    number_of_slaves: int = option(1, "slaves that have these messages")
    output_message_elements: Sequence[ElementOptions] = option((), "values of the output message")
    input_message_elements: Sequence[ElementOptions] = option((), "values of the input message")
    output_data_items: TopicOptions | None = option(
        None, "name of the item of output messages, and what is kept of it"
    )
    input_data_items: TopicOptions | None = option(
        None, "name of the item of input messages, and what is kept of it"
    )
    outputs_from: Literal["slaves", "master"] = option(
        "slaves", "who sends the output messages; the other sends the input messages"
    )
    output_address: int | None = option(
        None, "logical address of the first output message; found by size when absent"
    )
    input_address: int | None = option(
        None, "logical address of the first input message; found by size when absent"
    )
    expected_working_counter: int | None = option(
        None, "working counter when every slave takes part; learnt when absent"
    )
    debounce_cycles: int = option(3, "cycles in a row that make or end a fault")
    datagrams: Datagrams = option(
        "unknown", "raw datagrams to record: returned ones outside the messages, all, or none"
    )
    buffer_mb: int = option(32, "room for frames that wait to be read", unit="MB")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if not self.interface:
            yield "interface", "names no interface; write eth1"
        if not 1 <= self.number_of_slaves <= _MOST_SLAVES:
            yield "number_of_slaves", f"must be 1 to {_MOST_SLAVES}"
            return
        if not 1 <= self.buffer_mb <= 1024:
            yield "buffer_mb", "must be 1 to 1024"
        if self.debounce_cycles < 1:
            yield "debounce_cycles", "must be 1 or more"
        if self.expected_working_counter is not None and self.expected_working_counter < 1:
            yield "expected_working_counter", "must be 1 or more"
        for way in ("output", "input"):
            address = getattr(self, f"{way}_address")
            if address is not None and not 0 <= address < 1 << 32:
                yield f"{way}_address", "must be a logical address of 32 bits"
            yield from self._wrong_message(way)

    def _wrong_message(self, way: str) -> Iterator[tuple[str, str]]:
        elements, size = self._message(way)
        key = f"{way}_message_elements"
        if self.number_of_slaves * size > _MOST_BYTES:
            yield f"{way}_message_size", f"all messages have more than {_MOST_BYTES} bytes"
            return
        bits = max((bit + TYPES[one.type][1] for one, bit in elements), default=0)
        if bits > 8 * size:
            yield key, f"take {(bits + 7) // 8} bytes, {way}_message_size is {size}"
        if (topic := self.topic(way)) is not None and topic.schema is not None:
            try:
                read_layout(topic.schema)
            except AmberboxError as error:
                yield key, error.what

    def _message(self, way: str) -> tuple[Sequence[tuple[ElementOptions, int]], int]:
        """Return the elements of a message with their first bits, and its size in bytes."""
        placed: list[tuple[ElementOptions, int]] = []
        bit = 0
        for one in getattr(self, f"{way}_message_elements"):
            width = TYPES[one.type][1]
            if one.offset is not None:
                bit = 8 * one.offset
            elif one.type != "bool" or (one.bit and bit % 8 > one.bit):
                bit = (bit + 7) // 8 * 8
            if one.bit:
                bit = bit // 8 * 8 + one.bit
            placed.append((one, bit))
            bit += width
        ends = (at + TYPES[one.type][1] for one, at in placed)
        size = getattr(self, f"{way}_message_size") or (max(ends, default=0) + 7) // 8
        return placed, size

    def topic(self, way: str) -> Topic | None:
        """Return the topic of the ``output`` or ``input`` messages; None without elements."""
        elements, size = self._message(way)
        if not elements:
            return None
        count = self.number_of_slaves
        fields = tuple(
            FrameField(
                one.name if count == 1 else f"slaves/{slave}/{one.name}",
                8 * size * slave + bit,
                TYPES[one.type][1],
                TYPES[one.type][0],
                unit=one.unit,
            )
            for slave in range(count)
            for one, bit in elements
        )
        options = getattr(self, f"{way}_data_items")
        name = options.name if options is not None else way
        layout = FrameLayout(fields, size * count)
        return Topic(name, MESSAGE_ENCODING, layout.to_schema(f"ethercat/{name}"))

    def images(self) -> ProcessImages:
        """Return the process images of the segment."""
        found = []
        for way in ("output", "input"):
            topic = self.topic(way)
            _, size = self._message(way)
            from_slaves = (way == "output") == (self.outputs_from == "slaves")
            found.append(
                Image(
                    topic, size * self.number_of_slaves, from_slaves,
                    getattr(self, f"{way}_address"),
                )
            )  # fmt: skip
        return ProcessImages(found)


@dataclass(frozen=True)
class Image:
    """The messages of one direction, of all slaves; without a topic only their size counts."""

    topic: Topic | None
    size: int
    from_slaves: bool
    address: int | None = None


@dataclass(frozen=True, slots=True)
class Cut:
    """Bytes ``begin`` to ``end`` of a datagram, which belong at ``at`` in an image."""

    topic: Topic
    from_slaves: bool
    begin: int
    end: int
    at: int
    size: int
    """Bytes of the whole image."""


class ProcessImages:
    """Finds the images of a segment in datagrams with logical addresses."""

    def __init__(self, images: Sequence[Image]) -> None:
        self._images = images
        self._slaves = sum(i.size for i in images if i.from_slaves and i.address is None)
        self._master = sum(i.size for i in images if not i.from_slaves and i.address is None)

    @property
    def topics(self) -> Sequence[Topic]:
        """Return the topics of the images."""
        return [image.topic for image in self._images if image.topic is not None]

    def cuts(self, command: int, address: int, length: int) -> Sequence[Cut]:
        """Return what a datagram contains of the images.

        By size: LRD has what the slaves send, LWR what the master sends, LRW first what the master
        sends and then what the slaves send, or both in the same place.
        """
        found = []
        for image in self._images:
            if image.topic is None or command == (LWR if image.from_slaves else LRD):
                continue
            if image.address is not None:
                place = image.address - address
            else:
                place = self._place(command, length, image)
            begin, end = max(place, 0), min(place + image.size, length)
            if begin < end:
                found.append(
                    Cut(image.topic, image.from_slaves, begin, end, begin - place, image.size)
                )
        return found

    def _place(self, command: int, length: int, image: Image) -> int:
        """Return where an image begins by the size of a datagram; ``length`` if it is not in it."""
        if command != LRW:
            return 0 if length == image.size else length
        if length == self._master + self._slaves:
            return self._master if image.from_slaves else 0
        return 0 if length == max(self._master, self._slaves) else length
