"""Unroll protobuf messages: by byte layout where messages share one, else one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.arrays import numpy_type, objects, offsets_of
from amberbox.blackbox.columns.layout_cache import (
    MISFITS,
    LayoutCache,
    LayoutGroup,
    TooManyLayoutsError,
    rows_in_portions,
)
from amberbox.blackbox.columns.own_stamp import first_value, stamp_column, with_stamps
from amberbox.blackbox.columns.protobuf_definition import (
    BYTES,
    STRUCTURES,
    VARINT,
    ProtoDefinition,
    fields_of,
    parse_definition,
    read_varint,
)
from amberbox.blackbox.columns.protobuf_layout import (
    NUMBERS,
    WIDTHS,
    Leaf,
    Places,
    Presence,
    ProtoLayout,
    Table,
    ValuePlaces,
    Walk,
    find_layout,
    places_of,
    plan,
    walked,
)
from amberbox.blackbox.columns.ros_layout import gather, join_spans
from amberbox.core.clock import NS
from amberbox.core.types import ColumnData, IntArray, Ragged, Rows, Schema

# numbers of varying length, such as times, give a topic some layouts
MOST_LAYOUTS = 32
# of a message with more bytes for each value a walk is faster than to compare it with a layout
_CONTENT_BYTES = 64
_STAMPS = ("header/stamp", "header/timestamp", "timestamp", "stamp")
_MOST_SECONDS = (2**63 - 1) // NS - 1


class ProtobufUnroller:
    """Unrolls messages of one protobuf type.

    With ``by_layout`` False no layouts are used; the rows are the same either way.
    """

    def __init__(self, schema: Schema, stamp: str | None = None, by_layout: bool = True) -> None:
        definition = parse_definition(schema)
        self._plan = plan(definition)
        found = self._plan.table.schema
        times = {column.path for column in found.columns if column.type == "time"}
        own = next((path for path in _STAMPS if path in times), "")
        self._stamp = stamp_column(replace(found, stamp=own), stamp)
        self.schema = replace(found, stamp=self._stamp.path if self._stamp else "")
        self._stamp_numbers: tuple[int, ...] = ()
        if self._stamp is not None and self._stamp.type == "time":
            self._stamp_numbers = _numbers_of(definition, self._stamp.path)
        self._layouts: LayoutCache[ProtoLayout] | None = None
        if by_layout:
            self._layouts = LayoutCache(partial(find_layout, self._plan), MOST_LAYOUTS)

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch of messages."""
        unrolled = rows_in_portions(messages, self.schema.type, self._portion)
        return with_stamps(unrolled, self._stamp)

    def stamp_ns(self, message: bytes) -> int | None:
        """Read the message's own stamp only; None without one, if it is 0, or if damaged."""
        if self._stamp is None:
            return None
        try:
            if self._stamp_numbers:
                return _time_at(message, self._stamp_numbers)
            stamps = self.rows([message]).stamp_ns
        except (UnrollError, *MISFITS):
            return None
        return (int(stamps[0]) or None) if stamps is not None else None

    def no_stamp(self, message: bytes) -> Any:
        """Return the value at the place of the stamp if it is not a time, else None."""
        if self._stamp is None or self._stamp_numbers or self.stamp_ns(message):
            return None
        try:
            return first_value(self.rows([message]), self._stamp)
        except UnrollError:
            return None

    def _portion(self, messages: Sequence[bytes], lengths: list[int]) -> tuple[Rows, list[int]]:
        if self._layouts is not None and messages:
            try:
                groups, bad = self._layouts.group(messages, lengths)
            except TooManyLayoutsError:
                self._layouts = None
            else:
                if not any(map(_is_mostly_content, groups)):
                    return self._by_layout(groups, bad)
                self._layouts = None
        return self._one_by_one(messages, lengths)

    def _by_layout(
        self, groups: Sequence[LayoutGroup[ProtoLayout]], bad: list[int]
    ) -> tuple[Rows, list[int]]:
        if bad:
            return self._one_by_one([], [])[0], bad
        return self._build(places_of(groups)), []

    def _one_by_one(
        self, messages: Sequence[bytes], lengths: Sequence[int]
    ) -> tuple[Rows, list[int]]:
        walk = Walk(self._plan, b"".join(messages))
        bad, start = [], 0
        for number, length in enumerate(lengths):
            try:
                walk.message(start, start + length)
            except MISFITS:
                bad.append(number)
            start += length
        if bad:
            walk = Walk(self._plan, b"")
        return self._build(walked(walk)), bad

    def _build(self, places: ValuePlaces) -> Rows:
        return _Builder(places).table(self._plan.table)


def _is_mostly_content(group: LayoutGroup[ProtoLayout]) -> bool:
    """Return whether messages consist of few long values, such as images and scans."""
    return group.layout.size > _CONTENT_BYTES * max(len(group.layout.places.rows), 1)


def _numbers_of(definition: ProtoDefinition, path: str) -> tuple[int, ...]:
    """Return the numbers of the fields along a path."""
    numbers, name = [], definition.root
    for part in path.split("/"):
        one = next(one for one in definition.messages[name] if one.name == part)
        if one.kind not in STRUCTURES or one.kind == "group":
            return ()
        numbers.append(one.number)
        name = one.type_name
    return tuple(numbers)


def _time_at(message: bytes, numbers: Sequence[int]) -> int | None:
    """Read the time at a path of fields; raises one of ``MISFITS`` if the message is damaged."""
    start, end = 0, len(message)
    for wanted in numbers:
        found = [f[2:] for f in fields_of(message, start, end) if f[:2] == (wanted, BYTES)]
        if not found:
            return None
        start, end = found[-1]
    parts = {1: 0, 2: 0}
    for number, wire, first, _ in fields_of(message, start, end):
        if wire == VARINT and number in parts:
            value = read_varint(message, first)[0]
            parts[number] = value - (1 << 64) if value >> 63 else value
    seconds = min(max(parts[1], -_MOST_SECONDS), _MOST_SECONDS)
    nanoseconds = (parts[2] + 2**31) % 2**32 - 2**31
    return seconds * NS + nanoseconds or None


class _Builder:
    """Reads the columns of a batch from the places of their values."""

    def __init__(self, places: ValuePlaces) -> None:
        self.places = places
        self.absent: dict[int, NDArray[np.bool_] | None] = {}

    @cached_property
    def bytes(self) -> NDArray[np.uint8]:
        return np.frombuffer(self.places.data, np.uint8)

    def table(self, table: Table) -> Rows:
        count = self.places.counts[table.number]
        columns = {leaf.column.name: self.column(leaf, count) for leaf in table.leaves}
        children = {}
        for path, (slot, child) in table.children.items():
            rows = self.table(child)
            parents = self.places.slots[slot].in_order().rows
            index = np.arange(rows.count, dtype=np.int64) - _offsets(parents, count)[parents]
            children[path] = replace(rows, parent_row=parents, index=index)
        return Rows(count, columns, children)

    def column(self, leaf: Leaf, count: int) -> ColumnData:
        places = self.places.slots[leaf.slot]
        if leaf.column.type.startswith("list<"):
            return self.list(leaf, places.in_order(), count)
        missing = self.missing(leaf.presence, count)
        if leaf.time is not None:
            values: NDArray[Any] = self.times(leaf.time, count)
        elif leaf.kind in NUMBERS:
            found = self.numbers(leaf.kind, self.bytes, places.starts, places.ends)
            values = _scattered(found, places, np.zeros(count, found.dtype))
        else:
            empty = np.full(count, "" if leaf.kind == "string" else b"", object)
            values = _scattered(self.blobs(leaf.kind, places), places, empty)
            if missing is not None:
                values[missing] = None
            return values
        return values if missing is None else np.ma.MaskedArray(values, missing)

    def list(self, leaf: Leaf, places: Places, count: int) -> Ragged:
        if leaf.time is not None and leaf.elements is not None:
            times = self.times(leaf.time, self.places.counts[leaf.elements])
            return Ragged(_offsets(places.rows, count), times)
        if leaf.kind not in NUMBERS:
            return Ragged(_offsets(places.rows, count), self.blobs(leaf.kind, places))
        wire, _ = NUMBERS[leaf.kind]
        lengths = places.ends - places.starts
        joined = join_spans(self.places.data, places.starts, lengths, 1)
        offsets = offsets_of(lengths)
        if wire == VARINT:
            ends = np.flatnonzero(joined < 0x80) + 1
            starts = np.concatenate(([0], ends))[:-1]
            before = np.searchsorted(ends, offsets, "right")
        else:
            starts = np.arange(0, len(joined), WIDTHS[wire])
            ends, before = starts, offsets // WIDTHS[wire]
        values = self.numbers(leaf.kind, joined, starts, ends)
        counts = np.bincount(places.rows, np.diff(before), count).astype(np.int64)
        return Ragged(offsets_of(counts), values)

    def numbers(
        self, kind: str, data: NDArray[np.uint8], starts: IntArray, ends: IntArray
    ) -> NDArray[Any]:
        wire, column_type = NUMBERS[kind]
        dtype = numpy_type(column_type)
        if wire != VARINT:
            numbers = gather(data, starts, WIDTHS[wire]).view(dtype.newbyteorder("<"))
            return numbers.astype(dtype, copy=False)
        values = read_varints(data, starts, ends)
        if kind == "bool":
            return np.not_equal(values, 0)
        if kind == "sint32":
            values &= np.uint64(0xFFFFFFFF)
        if kind in ("sint32", "sint64"):
            values = (values >> np.uint64(1)) ^ (np.uint64(0) - (values & np.uint64(1)))
        return values.astype(dtype)

    def times(self, slots: tuple[int, int], count: int) -> IntArray:
        parts = []
        for kind, slot in zip(("int64", "int32"), slots, strict=True):
            places = self.places.slots[slot]
            found = self.numbers(kind, self.bytes, places.starts, places.ends).astype(np.int64)
            parts.append(_scattered(found, places, np.zeros(count, np.int64)))
        times: IntArray = np.clip(parts[0], -_MOST_SECONDS, _MOST_SECONDS) * NS + parts[1]
        return times

    def blobs(self, kind: str, places: Places) -> NDArray[np.object_]:
        data = self.places.data
        sizes = places.ends - places.starts
        if len(sizes) > 1 and (sizes == sizes[0]).all():  # names and units repeat
            block = gather(data, places.starts, int(sizes[0])).reshape(len(sizes), -1)
            if (block == block[0]).all():
                blob = block[0].tobytes()
                same: Any = blob.decode("utf-8", "replace") if kind == "string" else blob
                repeated = np.empty(len(sizes), object)
                repeated.fill(same)  # ``np.full`` would cut zeros off the end of bytes
                return repeated
        spans = zip(places.starts.tolist(), places.ends.tolist(), strict=True)
        if kind == "string":
            return objects([data[start:end].decode("utf-8", "replace") for start, end in spans])
        return objects([data[start:end] for start, end in spans])

    def missing(self, presence: Presence | None, count: int) -> NDArray[np.bool_] | None:
        """Return which rows of a table have no such value; None if all have one."""
        if presence is None:
            return None
        if presence.slot not in self.absent:
            self.absent[presence.slot] = self._missing(presence, count)
        return self.absent[presence.slot]

    def _missing(self, presence: Presence, count: int) -> NDArray[np.bool_] | None:
        above = self.missing(presence.above, count)
        if not presence.rivals and _is_each(self.places.slots[presence.slot], count):
            return above
        last = self.last(presence.slot, count)
        absent: NDArray[np.bool_] = last < 0
        for rival in presence.rivals:  # of a oneof the member that came last is the one there
            if rival != presence.slot:
                absent |= self.last(rival, count) > last
        if not absent.any():
            return above
        return absent if above is None else absent | above

    def last(self, slot: int, count: int) -> IntArray:
        """Return where the last value of each row begins; -1 where there is none."""
        places = self.places.slots[slot]
        return _scattered(places.starts, places, np.full(count, -1, np.int64))


def _is_each(places: Places, count: int) -> bool:
    """Return whether there is one value for each row, in order."""
    return len(places.rows) == count and bool((places.rows == np.arange(count)).all())


def _scattered(found: NDArray[Any], places: Places, values: NDArray[Any]) -> NDArray[Any]:
    """Put values into their rows; of several for one row the last one counts."""
    if _is_each(places, len(values)):
        return found
    values[places.rows] = found
    return values


def _offsets(rows: IntArray, count: int) -> IntArray:
    """Return the offsets of the elements of each row, given the row of each element, in order."""
    return offsets_of(np.bincount(rows, minlength=count))


def read_varints(data: NDArray[np.uint8], starts: IntArray, ends: IntArray) -> NDArray[np.uint64]:
    """Read varints at places of a buffer; bits beyond 64 are ignored."""
    values = np.zeros(len(starts), np.uint64)
    if not len(starts):
        return values
    lengths = ends - starts
    shortest, longest = int(lengths.min()), int(lengths.max())
    for number in range(longest):
        shift = np.uint64(7 * number)
        if number < shortest:
            values |= (data[starts + number] & np.uint8(0x7F)).astype(np.uint64) << shift
        else:
            longer = np.flatnonzero(lengths > number)
            part = (data[starts[longer] + number] & np.uint8(0x7F)).astype(np.uint64)
            values[longer] |= part << shift
    return values
