"""Raw frames of a bus as columns, by a layout: where each value is, and what its number means.

A layout is the schema of a topic: its encoding is ``amberbox_layout``, its data the layout as JSON.
Messages of such a topic have the encoding ``frame`` and are the bytes as they were on the bus.

Bits are counted as they are sent. In a ``little`` field bit 0 is the lowest bit of byte 0, bit 8
the lowest of byte 1, and ``bit`` is the lowest bit of the value. In a ``big`` field bit 0 is the
highest bit of byte 0, bit 8 the highest of byte 1, and ``bit`` is the highest bit of the value: a
start bit ``s`` of a big-endian signal in a DBC file is ``s // 8 * 8 + 7 - s % 8`` here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from amberbox.blackbox.columns import UnrollError, check_places
from amberbox.blackbox.columns.arrays import numpy_type, objects
from amberbox.blackbox.columns.own_stamp import first_value, stamp_column, with_stamps
from amberbox.core.errors import AmberboxError
from amberbox.core.names import unique_names
from amberbox.core.types import Column, IntArray, ItemSchema, Rows, Schema

MESSAGE_ENCODING = "frame"
SCHEMA_ENCODING = "amberbox_layout"

_TEXTS = {"text": "string", "bytes": "binary"}
_FLOATS = {16: "float16", 32: "float32", 64: "float64"}
_LAST_BIT = 1 << 34  # of a frame of 2 GB


class Switch(msgspec.Struct, frozen=True, omit_defaults=True):
    """The number of another field that tells whether a field is in the frame (a multiplexer)."""

    field: str
    values: tuple[int, ...]


class FrameField(msgspec.Struct, frozen=True, omit_defaults=True):
    """One value of a frame; its number times ``scale`` plus ``offset`` is in ``unit``.

    ``name`` is a path (``drive/2/speed``). ``bits`` of a text or of bytes are a multiple of 8, or
    0 for all up to the end of the frame. ``labels`` name values of numbers that are not scaled.
    """

    name: str
    bit: Annotated[int, Meta(ge=0, lt=_LAST_BIT)]
    bits: Annotated[int, Meta(ge=0, lt=_LAST_BIT)]
    kind: Literal["uint", "int", "float", "bool", "text", "bytes"] = "uint"
    byte_order: Literal["little", "big"] = "little"
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    labels: Mapping[int, str] = {}
    when: Switch | None = None

    @property
    def is_scaled(self) -> bool:
        """Return whether the number in the frame is not the value."""
        return self.scale != 1.0 or self.offset != 0.0

    @property
    def column_type(self) -> str:
        """Return the type of the column."""
        if self.kind in _TEXTS:
            return _TEXTS[self.kind]
        if self.kind == "bool":
            return "bool"
        if self.is_scaled or (self.kind == "float" and self.bits == 64):
            return "float64"
        if self.kind == "float":
            return "float32"
        return f"{self.kind}{max(8, 1 << (self.bits - 1).bit_length())}"


class FrameLayout(msgspec.Struct, frozen=True, omit_defaults=True):
    """The fields of a frame. Frames of another ``size`` in bytes do not fit; 0 accepts any size:
    values beyond the end of a shorter frame are null.
    """

    fields: tuple[FrameField, ...]
    size: Annotated[int, Meta(ge=0)] = 0

    def to_schema(self, name: str) -> Schema:
        """Return the schema of a topic with this layout."""
        return Schema(name, SCHEMA_ENCODING, msgspec.json.encode(self))


def read_layout(schema: Schema) -> FrameLayout:
    """Read the layout in a schema; keys of newer versions are ignored.

    Raises AmberboxError for one that is no layout or contradicts itself.
    """
    try:
        layout = msgspec.json.decode(schema.data, type=FrameLayout)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise _wrong(schema.name, str(error)) from error
    check_places(schema.name, len(layout.fields))
    for problem in _problems(layout):
        raise _wrong(schema.name, problem)
    return layout


def _wrong(name: str, why: str) -> AmberboxError:
    return AmberboxError(
        f"cannot read the layout of {name}: {why}",
        "docs/reference/unrolling.md describes layouts of frames",
    )


def _problems(layout: FrameLayout) -> Iterator[str]:
    known: dict[str, FrameField] = {}
    for one in layout.fields:
        if not one.name.strip("/"):
            yield "a field has no name"
        if one.name in known:
            yield f"{one.name} is there twice"
        if one.kind in _TEXTS:
            if one.bit % 8 or one.bits % 8:
                yield f"{one.name} does not begin and end with a byte"
        elif one.kind == "float" and one.bits not in _FLOATS:
            yield f"{one.name} has {one.bits} bits; floats have 16, 32 or 64"
        elif not 1 <= one.bits <= 64:
            yield f"{one.name} has {one.bits} bits; numbers have 1 to 64"
        switch = known.get(one.when.field) if one.when else None
        if one.when and (switch is None or switch.kind not in ("uint", "int", "bool")):
            yield f"{one.name} depends on {one.when.field}, which is no whole number before it"
        known[one.name] = one


class FrameUnroller:
    """Unrolls the frames of one layout."""

    def __init__(self, schema: Schema, stamp: str | None = None) -> None:
        self._layout = read_layout(schema)
        self._names = unique_names(one.name for one in self._layout.fields)
        columns = tuple(_column(one, self._names[one.name]) for one in self._layout.fields)
        self._stamp = stamp_column(ItemSchema(schema.name, columns), stamp)
        own = self._stamp.path if self._stamp else ""
        self.schema = ItemSchema(schema.name, columns, stamp=own)

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch of frames."""
        size = self._layout.size
        bad = [n for n, frame in enumerate(messages) if size and len(frame) != size]
        if bad:
            raise UnrollError(self.schema.type, bad, len(messages))
        lengths = np.fromiter(map(len, messages), np.int64, len(messages))
        table = _FrameTable(messages, lengths)
        raw: dict[str, NDArray[Any]] = {}
        columns = {}
        for one, column in zip(self._layout.fields, self.schema.columns, strict=True):
            there = lengths * 8 >= one.bit + max(one.bits, 1)
            if one.when is not None:
                switch = raw[one.when.field]
                there &= np.isin(np.ma.getdata(switch), one.when.values)
                there &= ~np.ma.getmaskarray(switch)
            values = table.values(one, there)
            if one.kind in _TEXTS:
                columns[column.name] = values
                continue
            values = values if there.all() else np.ma.MaskedArray(values, ~there)
            raw[one.name] = values
            if one.is_scaled:
                values = values.astype(np.float64) * one.scale + one.offset
            columns[column.name] = values.astype(numpy_type(column.type), copy=False)
        return with_stamps(Rows(len(messages), columns), self._stamp)

    def stamp_ns(self, message: bytes) -> int | None:
        """Read the frame's own stamp; None without one, or if it is no time."""
        if self._stamp is None or (self._layout.size and len(message) != self._layout.size):
            return None
        stamps = self.rows([message]).stamp_ns
        return (int(stamps[0]) or None) if stamps is not None else None

    def no_stamp(self, message: bytes) -> Any:
        """Return the value at the place of the stamp if it is not a time, else None."""
        if self._stamp is None or self.stamp_ns(message):
            return None
        try:
            return first_value(self.rows([message]), self._stamp)
        except UnrollError:
            return None


def _column(one: FrameField, name: str) -> Column:
    kind = one.column_type
    unit = one.unit if kind not in ("string", "binary", "bool") else ""
    return Column(name, one.name, kind, unit, dict(one.labels) if "int" in kind else {})


class _FrameTable:
    """The frames of a batch, and their bytes as one table for each length."""

    def __init__(self, frames: Sequence[bytes], lengths: IntArray) -> None:
        self.frames = frames
        self.blocks: list[tuple[IntArray, NDArray[np.uint8]]] = []
        for length in np.unique(lengths).tolist():
            members = np.flatnonzero(lengths == length)
            joined = b"".join([frames[member] for member in members.tolist()])
            block = np.frombuffer(joined, np.uint8).reshape(len(members), length)
            self.blocks.append((members, block))

    def values(self, one: FrameField, there: NDArray[np.bool_]) -> NDArray[Any]:
        """Read a field of all frames, as it is in them; nothing where it is not ``there``."""
        if one.kind in _TEXTS:
            return objects(
                _text(frame, one) if is_there else None
                for frame, is_there in zip(self.frames, there.tolist(), strict=True)
            )
        numbers = np.zeros(len(self.frames), np.uint64)
        for members, block in self.blocks:
            if block.shape[1] * 8 >= one.bit + one.bits:
                numbers[members] = _bits(block, one)
        if one.kind == "bool":
            return np.not_equal(numbers, 0)
        if one.kind == "float":
            return numbers.astype(f"uint{one.bits}").view(_FLOATS[one.bits])
        if one.kind == "int":
            unused = 64 - one.bits
            return (numbers << np.uint64(unused)).view(np.int64) >> np.int64(unused)
        return numbers


def _text(frame: bytes, one: FrameField) -> str | bytes:
    start = one.bit // 8
    part = frame[start : start + one.bits // 8] if one.bits else frame[start:]
    return part if one.kind == "bytes" else part.partition(b"\0")[0].decode("utf-8", "replace")


def _bits(block: NDArray[np.uint8], one: FrameField) -> NDArray[np.uint64]:
    """Read a field of at most 64 bits, which may lie in nine bytes, from frames of one length."""
    first, last = one.bit // 8, (one.bit + one.bits - 1) // 8
    part = block[:, first : last + 1]
    if one.byte_order == "big":
        part, shift = part[:, ::-1], 7 - (one.bit + one.bits - 1) % 8
    else:
        shift = one.bit % 8
    numbers = np.zeros(len(block), np.uint64)
    for place in range(min(part.shape[1], 8)):
        numbers |= part[:, place].astype(np.uint64) << np.uint64(8 * place)
    numbers >>= np.uint64(shift)
    if part.shape[1] == 9:
        numbers |= part[:, 8].astype(np.uint64) << np.uint64(64 - shift)
    return numbers & np.uint64((1 << one.bits) - 1)
