"""Locate the fields of serialised ROS messages, one message at a time or by byte layout.

The reader of a type is generated from numbers only (sizes, slots), never from names in a
definition. Messages whose strings and sequences have the same lengths share a byte layout, so their
fields are read column-wise.

A layout is exact by induction: the first length prefix of a message lies at a fixed place; if it
is equal to the layout's, the place of the next one is fixed as well, and so on to the end. So a
message of the right size with all prefixes equal has every field where the layout has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns.arrays import objects, offsets_of
from amberbox.blackbox.columns.layout_cache import MISFITS, LayoutGroup
from amberbox.blackbox.columns.ros_definition import SIZES
from amberbox.blackbox.columns.ros_wire import (
    ChildrenOp,
    FixedOp,
    NumbersOp,
    Op,
    Padding,
    TextOp,
    TextsOp,
    WirePlan,
    WireTable,
    text_slots,
)
from amberbox.core.types import IntArray

Slots: TypeAlias = list[list[int]]
MessageWalk: TypeAlias = Callable[[bytes, int, int], None]
Walker: TypeAlias = Callable[..., MessageWalk]

# most rows of structures without a byte: no message size limits their claimed number
_MOST_EMPTY_ROWS = 1 << 8
# most rows of all child tables of one message; a message with more has no columns
MOST_ROWS = 1 << 21


def compile_walker(plan: WirePlan, watch: bool = False) -> Walker:
    """Compile ``make(big_endian, slots, checks) -> walk(data, start, end)``.

    A walk appends the positions of one message's fields to the slots. It raises one of ``MISFITS``
    if the message is shorter or longer than its definition requires. With ``watch`` it also appends
    to ``checks`` the position and length of every prefix that other positions depend on.
    """
    lines = list(_WalkerSource(plan, watch).lines())
    space: dict[str, Any] = {
        "word": {big: Struct(f"{'>' if big else '<'}I").unpack_from for big in (False, True)}
    }
    exec("\n".join(lines), space)
    made: Walker = space["make"]
    return made


class _WalkerSource:
    def __init__(self, plan: WirePlan, watch: bool) -> None:
        self.plan = plan
        self.watch = watch

    def lines(self) -> Iterator[str]:
        yield "def make(big_endian, slots, checks):"
        yield " u = word[big_endian]"
        yield " c = checks.append"
        for slot in range(self.plan.slots):
            yield f" s{slot} = slots[{slot}].append"
        yield " def walk(d, p, e):"
        if self.plan.cdr:
            yield "  p += 4"
        yield "  o = p"
        yield "  r = 0"
        yield from _indented(self.table(self.plan.table), 2)
        trailing = 3 if self.plan.cdr else 0  # CDR writers pad messages to 4 bytes
        yield f"  if not 0 <= e - p <= {trailing}: raise ValueError"
        yield " return walk"

    def table(self, table: WireTable) -> Iterator[str]:
        for op in table.ops:
            yield from self.op(op)

    def op(self, op: Op) -> Iterator[str]:
        match op:
            case FixedOp():
                yield from _lead(op.lead)
                yield f"s{op.slot}(p)"
                yield f"p += {op.size}"
            case TextOp():
                yield from _lead(op.lead)
                yield from self.text(op.slot, op.slot + 1, op.wide)
            case NumbersOp():
                yield from self.numbers(op)
            case TextsOp():
                yield from self.texts(op)
            case ChildrenOp():
                yield from self.children(op)

    def prefix(self) -> Iterator[str]:
        if self.watch:
            yield "c((p, 4))"
        yield "n = u(d, p)[0]"
        yield "p += 4"

    def text(self, start: int, end: int, wide: bool) -> Iterator[str]:
        yield from self.prefix()
        yield f"s{start}(p)"
        if wide:
            yield "p += 4 * n"
            yield f"s{end}(p)"
        elif not self.plan.cdr:
            yield "p += n"
            yield f"s{end}(p)"
        else:
            yield from self.terminated(end)

    def terminated(self, end: int) -> Iterator[str]:
        """Yield code that reads a CDR string: its length counts the NUL, or is 0 if empty."""
        yield "if n:"
        yield " p += n"
        if self.watch:
            yield " c((p - 1, 1))"
        yield " if d[p - 1]: raise ValueError"
        yield f" s{end}(p - 1)"
        yield "else:"
        yield f" s{end}(p)"

    def numbers(self, op: NumbersOp) -> Iterator[str]:
        yield from _lead(op.lead)
        if op.count is None:
            yield from self.prefix()
            if op.align > 4:
                yield f"if n: p += (o - p) & {op.align - 1}"  # an empty sequence has no gap
        else:
            yield f"n = {op.count}"
        yield f"s{op.slot}(p)"
        yield f"s{op.slot + 1}(n)"
        yield f"p += {SIZES[op.item]} * n"

    def count(self, op: TextsOp | ChildrenOp, smallest: int) -> Iterator[str]:
        if op.count is None:
            yield from _lead(op.lead)
            yield from self.prefix()
        else:
            yield f"n = {op.count}"
        limit = f"{smallest} * n > e - p" if smallest else f"n > {_MOST_EMPTY_ROWS}"
        yield "r += n"
        yield f"if {limit} or r > {MOST_ROWS}: raise ValueError"
        yield f"s{op.slot}(n)"

    def texts(self, op: TextsOp) -> Iterator[str]:
        yield from self.count(op, 4)
        yield "for _ in range(n):"
        if self.plan.cdr:
            yield " p += (o - p) & 3"
        yield from _indented(self.text(op.slot + 1, op.slot + 2, op.wide), 1)

    def children(self, op: ChildrenOp) -> Iterator[str]:
        yield from self.count(op, op.table.smallest)
        if op.stride is None:
            yield "for _ in range(n):"
            yield from _indented(self.table(op.table), 1)
            yield " pass"
            return
        if op.align > 1:
            yield f"if n: p += (o - p) & {op.align - 1}"
        yield f"s{op.slot + 1}(p)"
        yield f"p += {op.stride} * n"


def _lead(lead: Padding) -> Iterator[str]:
    if lead.align > 1:
        yield f"p += (o - p) & {lead.align - 1}"
    elif lead.skip:
        yield f"p += {lead.skip}"


def _indented(lines: Iterator[str], depth: int) -> Iterator[str]:
    return (" " * depth + line for line in lines)


def walk_all(
    walker: Walker, plan: WirePlan, data: bytes, sizes: Sequence[int], big_endian: bool
) -> tuple[Slots, list[int]]:
    """Walk all messages of a joined buffer; return the slots and the places of misfits."""
    slots: Slots = [[] for _ in range(plan.slots)]
    walk = walker(big_endian, slots, [])
    bad, start = [], 0
    for index, size in enumerate(sizes):
        try:
            walk(data, start, start + size)
        except MISFITS:
            bad.append(index)
        start += size
    return slots, bad


Bytes: TypeAlias = NDArray[np.uint8]
Objects: TypeAlias = NDArray[np.object_]


class FixedPieces(NamedTuple):
    """``rows`` pieces of fixed size in a buffer, from ``offset`` on, ``stride`` bytes apart."""

    buffer: Any
    offset: int
    stride: int
    rows: int


class FieldPlaces(Protocol):
    """Access to the fields of a batch by the slots of its plan."""

    @property
    def big_endian(self) -> bool:
        """Return whether numbers are big-endian."""

    def pieces(self, slot: int, size: int) -> FixedPieces:
        """Return the pieces of ``size`` bytes that start at the places in a slot."""

    def offsets(self, slot: int) -> IntArray:
        """Return the offsets of lists whose lengths a slot records, for the whole batch, from 0."""

    def spans(self, starts: int, counts: int, width: int) -> Bytes:
        """Return sequences of ``width`` byte items, concatenated."""

    def blobs(self, starts: int, counts: int) -> list[bytes]:
        """Return byte sequences, one by one."""

    def texts(self, starts: int, ends: int, wide: bool) -> Objects:
        """Decode strings."""


def decode_text(data: bytes, wide: bool, big_endian: bool) -> str:
    """Decode UTF-8, or UTF-16 units of 4 bytes; invalid bytes become U+FFFD."""
    if not wide:
        return data.decode("utf-8", "replace")
    units = np.frombuffer(data, ">u4" if big_endian else "<u4").astype("<u2")
    return units.tobytes().decode("utf-16-le", "replace")


def gather(data: bytes | Bytes, places: IntArray, size: int) -> Bytes:
    """Return ``size`` bytes from each place, concatenated."""
    if not len(places) or not size:
        return np.empty(0, np.uint8)
    pieces = np.ndarray((len(data) - size + 1,), f"V{size}", data, 0, (1,))
    return pieces[places].view(np.uint8)


def join_spans(data: bytes, starts: IntArray, counts: IntArray, width: int) -> Bytes:
    if len(counts) and (counts == counts[0]).all():
        return gather(data, starts, int(counts[0]) * width)
    ends = (starts + counts * width).tolist()
    parts = [data[start:end] for start, end in zip(starts.tolist(), ends, strict=True)]
    return np.frombuffer(bytearray().join(parts), np.uint8)


@dataclass(frozen=True, slots=True)
class ScatteredPlaces:
    """Places of a batch whose messages have different layouts."""

    data: bytes
    slots: Slots
    big_endian: bool

    def pieces(self, slot: int, size: int) -> FixedPieces:
        places = np.array(self.slots[slot], np.int64)
        return FixedPieces(gather(self.data, places, size), 0, size, len(places))

    def offsets(self, slot: int) -> IntArray:
        return offsets_of(np.array(self.slots[slot], np.int64))

    def spans(self, starts: int, counts: int, width: int) -> Bytes:
        places = np.array([self.slots[starts], self.slots[counts]], np.int64)
        return join_spans(self.data, places[0], places[1], width)

    def blobs(self, starts: int, counts: int) -> list[bytes]:
        places = zip(self.slots[starts], self.slots[counts], strict=True)
        return [self.data[start : start + count] for start, count in places]

    def texts(self, starts: int, ends: int, wide: bool) -> Objects:
        places = list(zip(self.slots[starts], self.slots[ends], strict=True))
        if wide or len(self.data) > 256 * len(places):
            data, big = self.data, self.big_endian
            return objects([decode_text(data[start:end], wide, big) for start, end in places])
        # one byte is one character in Latin-1: cutting text is twice as fast as decoding cuts
        text = self.data.decode("latin-1")
        cuts = [text[start:end] for start, end in places]
        if not all(map(str.isascii, cuts)):
            cuts = [cut.encode("latin-1").decode("utf-8", "replace") for cut in cuts]
        return objects(cuts)


@dataclass(frozen=True, slots=True)
class EvenPlaces:
    """Positions of the fields of ``count`` messages of ``size`` bytes with one layout (``slots``).

    ``texts_of_all`` are the strings of each slot of starts when they are equal in all messages.
    """

    data: bytes
    size: int
    count: int
    slots: Slots
    big_endian: bool
    texts_of_all: Mapping[int, Objects] | None = None

    def pieces(self, slot: int, size: int) -> FixedPieces:
        places = self.slots[slot]
        if len(places) == 1:
            return FixedPieces(self.data, places[0], self.size, self.count)
        everywhere = self._spread(slot)
        return FixedPieces(gather(self.data, everywhere, size), 0, size, len(everywhere))

    def offsets(self, slot: int) -> IntArray:
        counts = self.slots[slot]
        if len(counts) == 1:
            return np.arange(self.count + 1, dtype=np.int64) * counts[0]
        return offsets_of(self._repeat(slot))

    def spans(self, starts: int, counts: int, width: int) -> Bytes:
        if len(self.slots[starts]) != 1:
            return join_spans(self.data, self._spread(starts), self._repeat(counts), width)
        start, length = self.slots[starts][0], self.slots[counts][0] * width
        return self._block(start, length).copy().reshape(-1)

    def blobs(self, starts: int, counts: int) -> list[bytes]:
        places = zip(self._spread(starts).tolist(), self._repeat(counts).tolist(), strict=True)
        return [self.data[start : start + count] for start, count in places]

    def texts(self, starts: int, ends: int, wide: bool) -> Objects:
        if self.texts_of_all is not None:
            return self._same(self.texts_of_all[starts])
        places = list(zip(self.slots[starts], self.slots[ends], strict=True))
        table = np.empty((self.count, len(places)), object)
        for column, (start, end) in enumerate(places):
            table[:, column] = self._column(start, end, wide)
        return table.reshape(-1)

    def _same(self, once: Objects) -> Objects:
        if len(once) != 1:
            return np.tile(once, self.count)
        texts = np.empty(self.count, object)
        texts.fill(once[0])
        return texts

    def _column(self, start: int, end: int, wide: bool) -> str | list[str]:
        block = self._block(start, end - start)
        if (block == block[0]).all():
            return self._text(0, start, end, wide)
        return [self._text(message, start, end, wide) for message in range(self.count)]

    def _text(self, message: int, start: int, end: int, wide: bool) -> str:
        base = message * self.size
        return decode_text(self.data[base + start : base + end], wide, self.big_endian)

    def _block(self, start: int, length: int) -> Bytes:
        """View the same bytes of all messages, one row each."""
        if not length:
            return np.empty((self.count, 0), np.uint8)
        return np.ndarray((self.count, length), np.uint8, self.data, start, (self.size, 1))

    def _repeat(self, slot: int) -> IntArray:
        """Return the numbers in a slot, repeated for all messages."""
        return np.tile(np.array(self.slots[slot], np.int64), self.count)

    def _spread(self, slot: int) -> IntArray:
        """Return the places in a slot for all messages."""
        bases = np.arange(self.count, dtype=np.int64) * self.size
        return np.add.outer(bases, np.array(self.slots[slot], np.int64)).reshape(-1)


_MOST_SPANS = 32
# bytes between a string and the next prefix that are compared as if they belonged to it
_PADDING = 3


@dataclass(frozen=True, slots=True, eq=False)
class ByteLayout:
    """The places of all fields in messages of one size, and the bytes that identify the layout.

    ``spans`` are the length prefixes (and the CDR header); ``same`` are these and the strings of
    the message that the layout was taken from, whose decoded ``texts`` are kept by slot.
    """

    size: int
    big_endian: bool
    slots: Slots
    spans: tuple[tuple[int, bytes], ...]
    same: tuple[tuple[int, bytes], ...]
    texts: Mapping[int, Objects]

    def fits(self, message: bytes) -> bool:
        """Return whether one message of the right size has this layout."""
        return all(message.startswith(value, place) for place, value in self.spans)

    def repeats(self, data: bytes, count: int) -> bool:
        """Return whether all of ``count`` joined messages have this layout and these strings."""
        return len(self.same) <= _MOST_SPANS and all(
            _column(data, self.size, count, place, len(value)).tobytes() == value * count
            for place, value in self.same
        )

    def matches(self, data: bytes, count: int) -> NDArray[np.bool_]:
        """Return which of ``count`` joined messages, all of the right size, have this layout."""
        matching = np.ones(count, np.bool_)
        for place, value in self.spans:
            column = _column(data, self.size, count, place, len(value))
            matching &= (column == np.frombuffer(value, np.uint8)).all(axis=1)
        return matching


def _column(data: bytes, size: int, count: int, place: int, length: int) -> NDArray[np.uint8]:
    return np.ndarray((count, length), np.uint8, data, place, (size, 1))


def layout_finder(plan: WirePlan) -> Callable[[bytes], ByteLayout]:
    """Compile a function that returns the layout of a message.

    It raises one of ``MISFITS`` if the message does not fit its definition.
    """
    walker = compile_walker(plan, watch=True)
    return lambda message: _find_layout(plan, walker, message, is_big_endian(plan, message))


def _find_layout(plan: WirePlan, walker: Walker, message: bytes, big_endian: bool) -> ByteLayout:
    slots: Slots = [[] for _ in range(plan.slots)]
    checks: list[tuple[int, int]] = [(0, 2)] if plan.cdr else []
    walker(big_endian, slots, checks)(message, 0, len(message))
    strings = [
        (start, end - start)
        for slot, _ in text_slots(plan.table)
        for start, end in zip(slots[slot], slots[slot + 1], strict=True)
    ]
    alone = ScatteredPlaces(message, slots, big_endian)
    return ByteLayout(
        len(message),
        big_endian,
        slots,
        _merged(message, checks),
        _merged(message, checks + strings, gap=_PADDING),
        {slot: alone.texts(slot, slot + 1, wide) for slot, wide in text_slots(plan.table)},
    )


def _merged(
    message: bytes, checks: Sequence[tuple[int, int]], gap: int = 0
) -> tuple[tuple[int, bytes], ...]:
    """Return offset and bytes of the checked places of a message, near neighbours merged."""
    merged: list[list[int]] = []
    for place, size in sorted(checks):
        if merged and place <= merged[-1][1] + gap:
            merged[-1][1] = max(merged[-1][1], place + size)
        elif size:
            merged.append([place, place + size])
    return tuple((start, message[start:end]) for start, end in merged)


def places_of(group: LayoutGroup[ByteLayout]) -> EvenPlaces:
    """Return the places of the fields of messages of one layout."""
    layout = group.layout
    texts = layout.texts if group.same_texts else None
    count = len(group.members)
    return EvenPlaces(group.data, layout.size, count, layout.slots, layout.big_endian, texts)


def is_big_endian(plan: WirePlan, message: bytes) -> bool:
    """Read the byte order from a CDR header; raises ValueError for any other encapsulation."""
    if not plan.cdr or message[:2] == b"\x00\x01":
        return False
    if message[:2] == b"\x00\x00":
        return True
    raise ValueError("not plain CDR")
