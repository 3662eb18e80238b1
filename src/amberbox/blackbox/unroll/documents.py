"""JSON and MessagePack messages as flat columns, under a schema made by ``infer.widen``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.unroll.contract import UnrollError, check_places
from amberbox.blackbox.unroll.decode import (
    MalformedError,
    decoder_into,
    make_decoder,
    plain,
    text_of,
)
from amberbox.blackbox.unroll.jsonschema import from_schema
from amberbox.blackbox.unroll.notes import Note, notes_of
from amberbox.blackbox.unroll.places import objects
from amberbox.blackbox.unroll.shapes import Shape, column_kind, escape, places
from amberbox.core.names import identifier, readable, unique_names
from amberbox.core.stamps import stamp_of
from amberbox.core.types import Column, ColumnData, IntArray, ItemSchema, Ragged, Rows, Schema

_STAMPS = ("header/stamp", "header/timestamp", "stamp", "timestamp")
_STAMP_KINDS = {"integer", "number", "string"}
_STAMP_KEYS = {"secs", "sec"}
_MISFITS = (MalformedError, msgspec.MsgspecError, ValueError)
_NO_NOTE = Note()
_DTYPES: Mapping[str, Any] = {"bool": np.bool_, "int64": np.int64, "float64": np.float64}


class DocumentUnroller:
    """Unrolls the messages of one JSON or MessagePack topic; missing values are nulls."""

    def __init__(self, schema: Schema, encoding: str, stamp: str | None = None) -> None:
        self._shape = from_schema(schema)
        check_places(schema.name, _count(self._shape))
        self._decode = make_decoder(self._shape, encoding, exact=False)
        self._stamp_path = _own_stamp(self._shape, stamp)
        self._decode_stamp = _stamp_decoder(self._stamp_path, encoding)
        self._plain = readable if self._shape.letters else identifier
        self._names: dict[int, dict[str, str]] = {}
        self._notes = notes_of(schema)
        self.schema = self._item_schema(self._shape, schema.name, stamp=self._stamp_path)

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch of messages."""
        values, bad = [], []
        for number, message in enumerate(messages):
            try:
                values.append(self._decode(message))
            except _MISFITS:
                bad.append(number)
        if bad:
            raise UnrollError(self.schema.type, bad, len(messages))
        rows = self._table(self._shape, values)
        return Rows(rows.count, rows.columns, rows.children, self._stamps(messages))

    def stamp_ns(self, message: bytes) -> int | None:
        """Read the message's own stamp only; None without one, or if it is no time."""
        if not self._stamp_path:
            return None
        try:
            return stamp_of(self._decode_stamp(message)) or None
        except (*_MISFITS, AttributeError):
            return None

    def no_stamp(self, message: bytes) -> Any:
        """Return what stands where the stamp belongs and is no time; None if nothing does."""
        try:
            found = self._decode_stamp(message) if self._stamp_path else None
        except (*_MISFITS, AttributeError):
            return None
        is_unset = not found or (isinstance(found, dict) and not any(found.values()))
        return None if is_unset or stamp_of(found) else found

    def _stamps(self, messages: Sequence[bytes]) -> IntArray | None:
        if not self._stamp_path:
            return None
        return np.array([self.stamp_ns(message) or 0 for message in messages], np.int64)

    def _item_schema(
        self, table: Shape, type_name: str, above: str = "", stamp: str = ""
    ) -> ItemSchema:
        names = self._names[id(table)] = unique_names(table.names, plain=self._plain)
        columns = []
        children = {}
        for path, shape, kind in places(table):
            if kind == "children" and shape.items is not None:
                children[path] = self._item_schema(
                    shape.items, f"{type_name}/{path}", f"{above}{path}/"
                )
            else:
                note = self._notes.get(f"{above}{path}", _NO_NOTE)
                columns.append(_described(names[path], path, kind.replace("text", "string"), note))
        return ItemSchema(type_name, tuple(columns), children, stamp)

    def _table(self, table: Shape, values: Sequence[Any]) -> Rows:
        columns: dict[str, ColumnData] = {}
        children: dict[str, Rows] = {}
        names = self._names[id(table)]
        for path, shape, kind, found in _found(table, values, ""):
            if kind == "children" and shape.items is not None:
                children[path] = self._child(shape.items, found)
            else:
                columns[names[path]] = _column(kind, found)
        return Rows(len(values), columns, children)

    def _child(self, items: Shape, values: Sequence[Any]) -> Rows:
        offsets = _offsets(values)
        rows = self._table(items, [item for value in values if value for item in value])
        counts = np.diff(offsets)
        parent_row = np.repeat(np.arange(len(values), dtype=np.int64), counts)
        index = np.arange(rows.count, dtype=np.int64) - offsets[parent_row]
        return Rows(rows.count, rows.columns, rows.children, None, parent_row, index)


def _count(table: Shape) -> int:
    """Count the columns of a table and of those below it."""
    return sum(
        1 + (_count(shape.items) if kind == "children" and shape.items else 0)
        for _, shape, kind in places(table)
    )


def _described(name: str, path: str, kind: str, note: Note) -> Column:
    """Return a column with its unit if it holds numbers, with labels if these are whole."""
    is_whole = "int" in kind
    unit = note.unit if is_whole or "float" in kind else ""
    return Column(name, path, kind, unit, note.labels if is_whole else {})


def _found(
    shape: Shape, values: Sequence[Any], path: str
) -> Iterator[tuple[str, Shape, str, Sequence[Any]]]:
    """Go through the places of a table as ``shapes.places`` does, with the values found there."""
    kind = column_kind(shape)
    if kind == "nested":
        for number, (key, inner) in enumerate(shape.properties.items()):
            below = f"{path}/{escape(key)}" if path else escape(key)
            yield from _found(inner, _field(values, f"f{number}"), below)
    elif kind:
        yield path or "value", shape, kind, values


def _field(values: Sequence[Any], name: str) -> Sequence[Any]:
    get = attrgetter(name)
    return [None if value is None else get(value) for value in values]


def _offsets(values: Sequence[Any]) -> IntArray:
    offsets = np.zeros(len(values) + 1, np.int64)
    np.cumsum([len(value) if value else 0 for value in values], out=offsets[1:])
    return offsets


def _column(kind: str, values: Sequence[Any]) -> ColumnData:
    if kind.startswith("list<"):
        items = [item for value in values if value for item in value]
        return Ragged(_offsets(values), _items(kind[5:-1], items))
    if kind in _DTYPES:
        return _masked(values, _DTYPES[kind])
    return objects([text_of(value) for value in values] if kind == "text" else values)


def _items(kind: str, items: Sequence[Any]) -> Any:
    if kind == "float64":
        return np.array([np.nan if item is None else item for item in items], np.float64)
    if kind in _DTYPES:
        return np.array(items, _DTYPES[kind])
    return objects([text_of(item) for item in items] if kind == "text" else items)


def _masked(values: Sequence[Any], dtype: Any) -> ColumnData:
    missing = [value is None for value in values]
    if not any(missing):
        return np.array(values, dtype)
    return np.ma.MaskedArray(np.array([0 if v is None else v for v in values], dtype), missing)


def _own_stamp(shape: Shape, stamp: str | None) -> str:
    """Find the path of the own stamp; one that has not been seen yet is none."""
    wanted = _STAMPS if stamp is None else (stamp.strip("/").replace(".", "/"),)
    return next((path for path in wanted if path and _may_be_stamp(shape, path)), "")


def _may_be_stamp(shape: Shape, path: str) -> bool:
    place: Shape | None = shape
    for part in path.split("/"):
        place = place.properties.get(_unescape(part)) if place else None
    if place is None:
        return False
    return bool(place.kinds & _STAMP_KINDS or _STAMP_KEYS & place.properties.keys())


def _unescape(part: str) -> str:
    return "" if part == "~2" else part.replace("~1", "/").replace("~0", "~")


def _stamp_decoder(path: str, encoding: str) -> Callable[[bytes], Any]:
    """Make a decoder that skips everything but the stamp."""
    target: Any = Any
    parts = path.split("/")
    for part in reversed(parts):
        target = msgspec.defstruct("Stamp", [("f0", target, None)], rename={"f0": _unescape(part)})
    decode = decoder_into(target, encoding)
    get = attrgetter(".".join(["f0"] * len(parts)))
    return lambda message: plain(get(decode(message)))
