"""Places of fields in, columns out: numpy reads all rows of a column at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.unroll.definition import SIZES
from amberbox.blackbox.unroll.places import Pieces, Places, objects
from amberbox.blackbox.unroll.wire import (
    ChildrenOp,
    FixedOp,
    NumbersOp,
    Plan,
    TextOp,
    TextsOp,
    WireTable,
)
from amberbox.core.types import ColumnData, IntArray, Ragged, Rows

_NS = 1_000_000_000
_DTYPES: dict[str, np.dtype[Any]] = {
    "bool": np.dtype("u1"),
    "int8": np.dtype("i1"),
    "uint8": np.dtype("u1"),
    "int16": np.dtype("i2"),
    "uint16": np.dtype("u2"),
    "int32": np.dtype("i4"),
    "uint32": np.dtype("u4"),
    "int64": np.dtype("i8"),
    "uint64": np.dtype("u8"),
    "float32": np.dtype("f4"),
    "float64": np.dtype("f8"),
}
_WIRE = {
    False: {kind: dtype.newbyteorder("<") for kind, dtype in _DTYPES.items()},
    True: {kind: dtype.newbyteorder(">") for kind, dtype in _DTYPES.items()},
}
_PAIRED = ("time", "duration")


def build_rows(plan: Plan, places: Places, count: int) -> Rows:
    """Build all columns and child tables of ``count`` messages; stamps are not filled in."""
    return _Builder(places, plan.cdr).table(plan.table, count)


class _Builder:
    def __init__(self, places: Places, cdr: bool) -> None:
        self.places = places
        self.cdr = cdr
        self.wire = _WIRE[places.big_endian]

    def table(self, table: WireTable, count: int, within: Pieces | None = None) -> Rows:
        """Build one table; ``within`` are its rows when they are pieces that are known already."""
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
            items = self.values(op.item, Pieces(spans, 0, size, int(offsets[-1])), 0, 1)[0]
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
            within = Pieces(spans, 0, op.stride, total)
        rows = self.table(op.table, total, within)
        parent_row = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
        index = np.arange(total, dtype=np.int64) - offsets[parent_row]
        return Rows(total, rows.columns, rows.children, None, parent_row, index)

    def values(self, kind: str, pieces: Pieces, offset: int, columns: int) -> NDArray[Any]:
        """Read ``columns`` neighbours of a kind in each piece; one contiguous row for each."""
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

    def times(self, kind: str, pieces: Pieces, offset: int, columns: int) -> IntArray:
        """Read pairs of 32 bit: seconds are unsigned in a ROS 1 time, nanoseconds in ROS 2."""
        buffer, start, stride, count = pieces
        if not count:
            return np.empty((columns, 0), np.int64)
        wire = self.wire["uint32" if kind == "time" and not self.cdr else "int32"]
        shape, strides = (2, columns, count), (4, 8, stride)
        pairs = np.ndarray(shape, wire, buffer, start + offset, strides).astype(np.int64, "C")
        times: IntArray = pairs[0]
        times *= _NS
        times += pairs[1] & 0xFFFFFFFF if self.cdr else pairs[1]
        return times
