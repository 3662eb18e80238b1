"""Unroll ROS 1 and CDR messages: by byte layout where messages share one, else one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.arrays import numpy_type, objects
from amberbox.blackbox.columns.diagnostic_values import (
    has_values,
    with_values,
    with_values_schema,
)
from amberbox.blackbox.columns.layout_cache import (
    LayoutCache,
    LayoutGroup,
    TooManyLayoutsError,
    rows_in_portions,
)
from amberbox.blackbox.columns.own_stamp import stamp_column, with_stamps
from amberbox.blackbox.columns.ros_definition import SIZES, parse_definition
from amberbox.blackbox.columns.ros_layout import (
    ByteLayout,
    FieldPlaces,
    FixedPieces,
    ScatteredPlaces,
    compile_walker,
    is_big_endian,
    layout_finder,
    places_of,
    walk_all,
)
from amberbox.blackbox.columns.ros_wire import (
    ChildrenOp,
    FixedOp,
    NumbersOp,
    TextOp,
    TextsOp,
    WirePlan,
    WireTable,
    flatten_definition,
    plan,
)
from amberbox.blackbox.columns.row_tables import join_in_order
from amberbox.core.clock import NS
from amberbox.core.types import Column, ColumnData, IntArray, Ragged, Rows, Schema

_PAIRED = ("time", "duration")
_DTYPES = {kind: numpy_type(kind) for kind in SIZES if kind not in _PAIRED}
_DTYPES["bool"] = np.dtype("u1")
_WIRE = {
    False: {kind: dtype.newbyteorder("<") for kind, dtype in _DTYPES.items()},
    True: {kind: dtype.newbyteorder(">") for kind, dtype in _DTYPES.items()},
}


def build_rows(plan: WirePlan, places: FieldPlaces, count: int) -> Rows:
    """Build all columns and child tables of ``count`` messages; stamps are not filled in."""
    return _Builder(places, plan.cdr).table(plan.table, count)


class _Builder:
    def __init__(self, places: FieldPlaces, cdr: bool) -> None:
        self.places = places
        self.cdr = cdr
        self.wire = _WIRE[places.big_endian]

    def table(self, table: WireTable, count: int, within: FixedPieces | None = None) -> Rows:
        """Build one table; ``within`` are its rows where they are pieces of fixed size."""
        columns: dict[str, ColumnData] = {}
        children: dict[str, Rows] = {}
        for op in table.ops:
            if isinstance(op, ChildrenOp):
                children[op.path] = self.children(op)
            elif isinstance(op, FixedOp):
                pieces = self.places.pieces(op.slot, op.size) if within is None else within
                for run in op.runs:
                    values = self.values(run.kind, pieces, run.offset, len(run.names))
                    columns.update(zip(run.names, values, strict=True))
            else:
                columns[op.name] = self.single(op)
        return Rows(count, columns, children)

    def single(self, op: TextOp | TextsOp | NumbersOp) -> ColumnData:
        if isinstance(op, TextOp):
            return self.places.texts(op.slot, op.slot + 1, op.wide)
        if isinstance(op, TextsOp):
            texts = self.places.texts(op.slot + 1, op.slot + 2, op.wide)
            return Ragged(self.places.offsets(op.slot), texts)
        if op.binary:
            return objects(self.places.blobs(op.slot, op.slot + 1))
        offsets = self.places.offsets(op.slot + 1)
        size = SIZES[op.item]
        spans = self.places.spans(op.slot, op.slot + 1, size)
        if op.item in _PAIRED or op.item == "bool":
            items = self.values(op.item, FixedPieces(spans, 0, size, int(offsets[-1])), 0, 1)[0]
        else:
            items = spans.view(self.wire[op.item]).astype(_DTYPES[op.item], copy=False)
        return Ragged(offsets, items)

    def children(self, op: ChildrenOp) -> Rows:
        offsets = self.places.offsets(op.slot)
        counts = np.diff(offsets)
        total = int(offsets[-1])
        within = None
        if op.stride is not None:
            spans = self.places.spans(op.slot + 1, op.slot, op.stride)
            within = FixedPieces(spans, 0, op.stride, total)
        rows = self.table(op.table, total, within)
        parent_row = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
        index = np.arange(total, dtype=np.int64) - offsets[parent_row]
        return Rows(total, rows.columns, rows.children, None, parent_row, index)

    def values(self, kind: str, pieces: FixedPieces, offset: int, columns: int) -> NDArray[Any]:
        """Read ``columns`` neighbouring values in each piece; one array row per column."""
        if kind in _PAIRED:
            return self.times(kind, pieces, offset, columns)
        buffer, start, stride, count = pieces
        dtype = _DTYPES[kind]
        if not count:
            read: NDArray[Any] = np.empty((columns, 0), dtype)
        else:
            wire, strides = self.wire[kind], (dtype.itemsize, stride)
            view = np.ndarray((columns, count), wire, buffer, start + offset, strides)
            read = view.astype(dtype, "C")
        return np.not_equal(read, 0) if kind == "bool" else read

    def times(self, kind: str, pieces: FixedPieces, offset: int, columns: int) -> IntArray:
        """Read pairs of 32 bit: seconds are unsigned in a ROS 1 time, nanoseconds in ROS 2."""
        buffer, start, stride, count = pieces
        if not count:
            return np.empty((columns, 0), np.int64)
        wire = self.wire["uint32" if kind == "time" and not self.cdr else "int32"]
        shape, strides = (2, columns, count), (4, 8, stride)
        pairs = np.ndarray(shape, wire, buffer, start + offset, strides).astype(np.int64, "C")
        times: IntArray = pairs[0]
        times *= NS
        times += pairs[1] & 0xFFFFFFFF if self.cdr else pairs[1]
        return times


class RosUnroller:
    """Unrolls messages of one ROS type.

    With ``by_layout`` False no layouts are used; the rows are the same either way.
    """

    def __init__(
        self, schema: Schema, cdr: bool, stamp: str | None = None, by_layout: bool = True
    ) -> None:
        table = flatten_definition(parse_definition(schema), schema.name, not cdr)
        self._stamp = stamp_column(table.schema, stamp)
        self.schema = replace(table.schema, stamp=self._stamp.path if self._stamp else "")
        self._has_values = has_values(self.schema)
        if self._has_values:
            self.schema = with_values_schema(self.schema)
        self._plan = plan(table, cdr)
        self._walker = compile_walker(self._plan)
        self._layouts = LayoutCache(layout_finder(self._plan)) if by_layout else None
        self._quick_stamp = _stamp_reader(self._plan, self._stamp)

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch of messages."""
        unrolled = rows_in_portions(messages, self.schema.type, self._portion)
        rows = with_stamps(unrolled, self._stamp)
        return with_values(rows) if self._has_values else rows

    def stamp_ns(self, message: bytes) -> int | None:
        """Read the message's own stamp only; None without one, if it is 0, or if damaged."""
        if self._stamp is None:
            return None
        if self._quick_stamp is not None:
            return self._quick_stamp(message)
        try:
            stamps = self.rows([message]).stamp_ns
        except UnrollError:
            return None
        return (int(stamps[0]) or None) if stamps is not None else None

    def no_stamp(self, message: bytes) -> Any:
        """Return the value at the place of the stamp if it is not a time, else None.

        A ROS time of zero means that there is no stamp.
        """
        if self._stamp is None or self._stamp.type == "time" or self.stamp_ns(message):
            return None
        try:
            found = self.rows([message]).columns[self._stamp.name]
        except UnrollError:
            return None
        return found[0].item() if isinstance(found[0], np.generic) else found[0]

    def _portion(self, messages: Sequence[bytes], lengths: list[int]) -> tuple[Rows, list[int]]:
        if self._layouts is not None and messages:
            try:
                return self._by_layout(*self._layouts.group(messages, lengths))
            except TooManyLayoutsError:
                self._layouts = None
        return self._one_by_one(messages)

    def _by_layout(
        self, groups: Sequence[LayoutGroup[ByteLayout]], bad: list[int]
    ) -> tuple[Rows, list[int]]:
        if bad:
            return self._nothing(), bad
        parts = [build_rows(self._plan, places_of(group), len(group.members)) for group in groups]
        return join_in_order(parts, [group.members for group in groups]), []

    def _one_by_one(self, messages: Sequence[bytes]) -> tuple[Rows, list[int]]:
        members, bad = self._by_byte_order(messages)
        parts = []
        for big_endian, numbers in members.items():
            part = [messages[number] for number in numbers]
            data, sizes = b"".join(part), [len(message) for message in part]
            slots, misfits = walk_all(self._walker, self._plan, data, sizes, big_endian)
            bad += [numbers[misfit] for misfit in misfits]
            if not bad:
                parts.append(
                    build_rows(self._plan, ScatteredPlaces(data, slots, big_endian), len(part))
                )
        if bad:
            return self._nothing(), bad
        return join_in_order(
            parts, [np.array(numbers, np.int64) for numbers in members.values()]
        ), []

    def _by_byte_order(self, messages: Sequence[bytes]) -> tuple[dict[bool, list[int]], list[int]]:
        members: dict[bool, list[int]] = {}
        bad = []
        for number, message in enumerate(messages):
            try:
                members.setdefault(is_big_endian(self._plan, message), []).append(number)
            except ValueError:
                bad.append(number)
        return members or {False: []}, bad

    def _nothing(self) -> Rows:
        slots: list[list[int]] = [[] for _ in range(self._plan.slots)]
        return build_rows(self._plan, ScatteredPlaces(b"", slots, False), 0)


def _stamp_reader(plan: WirePlan, stamp: Column | None) -> Callable[[bytes], int | None] | None:
    """Return a reader for a stamp at a fixed offset in every message; None if the offset varies."""
    place = _fixed_place(plan, stamp.name) if stamp and stamp.type == "time" else None
    if place is None:
        return None
    readers = {
        big: Struct((">" if big else "<") + ("iI" if plan.cdr else "II")).unpack_from
        for big in (False, True)
    }

    def read(message: bytes) -> int | None:
        if len(message) < place + 8:
            return None
        seconds, rest = readers[plan.cdr and message[1] == 0](message, place)
        return (seconds * NS + rest) or None

    return read


def _fixed_place(plan: WirePlan, name: str) -> int | None:
    """Return the offset of a column in the first piece of a message, else None."""
    first = plan.table.ops[0]
    if not isinstance(first, FixedOp):
        return None
    for run in first.runs:
        if name in run.names:
            return 4 * plan.cdr + run.offset + SIZES[run.kind] * run.names.index(name)
    return None
