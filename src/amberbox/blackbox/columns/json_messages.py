"""JSON and MessagePack messages: infer their schema, decode them, unroll them into flat columns.

Messages are checked against the schema while msgspec decodes them in C.
"""

from __future__ import annotations

import datetime
import json
import re
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from operator import attrgetter
from typing import Annotated, Any, Union

import msgspec
import numpy as np

from amberbox.blackbox.columns import UnrollError, check_places
from amberbox.blackbox.columns.arrays import numpy_type, objects, offsets_of
from amberbox.blackbox.columns.json_schema import (
    Shape,
    ValueNote,
    ValueNotes,
    close,
    column_kind,
    escape,
    from_schema,
    limit_columns,
    notes_of,
    nullable_shape,
    observe,
    places,
    remember_names,
    to_schema,
)
from amberbox.core.names import identifier, readable_identifier, unique_names
from amberbox.core.timestamps import stamp_of
from amberbox.core.types import Column, ColumnData, IntArray, ItemSchema, Ragged, Rows, Schema

_INT64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
_EMPTY = Annotated[list[Any], msgspec.Meta(max_length=0)]
_PLAIN_TYPES: dict[str, Any] = {
    "boolean": bool,
    "integer": _INT64,
    "number": float,
    "string": str,
    "binary": bytes,
    "null": None,
}


_FEW_BYTES = 1 << 20
_MOST_LISTS = 1 << 20
# a map of 4,000 x 4,000 cells is believed; a JSON text of more values is not decoded
_MOST_VALUES = 1 << 24
_HALF = re.compile("[\ud800-\udfff]")
_MOST_DIGITS = 300
_LONG_NUMBER = re.compile(rb"[0-9]{%d}" % _MOST_DIGITS)
# shown for a value that is nested deeper than Python can decode; the message still holds it
TOO_DEEP = "(nested too deep to be shown)"


class UndecodableError(Exception):
    """A message that is not JSON or MessagePack, or that takes too much memory to decode."""


def check_size(message: bytes, encoding: str) -> None:
    """Raise UndecodableError for a JSON text with so many values that they would fill the memory.

    A decoded value takes 50 to 100 times its bytes. Characters in strings are counted as well.
    """
    if encoding != "json" or len(message) <= _FEW_BYTES:
        return
    lists = message.count(b"{") + message.count(b"[")
    if lists > _MOST_LISTS or message.count(b",") > _MOST_VALUES:
        raise UndecodableError("it has more values than can be decoded")


def decode_plain(message: bytes, encoding: str) -> Any:
    """Decode one message of any shape; raises ``MalformedError``.

    Python's ``NaN`` and ``Infinity`` are read although they are not JSON. Keys become strings.
    Numbers beyond all floats are infinite, half surrogates in texts become U+FFFD.
    """
    check_size(message, encoding)
    try:
        if encoding == "json":
            if not _LONG_NUMBER.search(message):
                with suppress(msgspec.DecodeError):
                    return msgspec.json.decode(message)
            return _mended(json.loads(message.decode(), parse_int=_number))
        return plain(msgspec.msgpack.decode(message))
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise UndecodableError(str(error)) from error


def _number(text: str) -> float:
    """Parse a whole number; one with too many digits becomes a float."""
    return int(text) if len(text) < _MOST_DIGITS else float(text)


def _mended(value: Any) -> Any:
    """Replace lone surrogates, which UTF-8 cannot encode, by U+FFFD."""
    match value:
        case str():
            return _HALF.sub("\ufffd", value)
        case dict():
            return {_mended(key): _mended(item) for key, item in value.items()}
        case list():
            return [_mended(item) for item in value]
    return value


def plain(value: Any) -> Any:
    """Convert values that only MessagePack has (keys that are not text, times, extensions)."""
    match value:
        case dict():
            return {_key(key): plain(item) for key, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case datetime.datetime():
            return value.isoformat().replace("+00:00", "Z")
        case msgspec.msgpack.Ext():
            return bytes(value.data)
    return value


def _key(key: Any) -> str:
    return key if isinstance(key, str) else text_of(key) or "null"


def text_of(value: Any) -> str | None:
    """Return a value as text: strings unchanged, bytes as Base64, everything else as JSON."""
    try:
        return _text_of(value)
    except RecursionError:
        return TOO_DEEP


def _text_of(value: Any) -> str | None:
    simple = plain(value)
    if simple is None or isinstance(simple, str):
        return simple
    if isinstance(simple, bytes):
        return b64encode(simple).decode()
    return json.dumps(simple, ensure_ascii=False, separators=(",", ":"), default=_text_of)


def message_type(shape: Shape, exact: bool) -> Any:
    """Return the msgspec type that messages of a shape are decoded into.

    With ``exact``, a message decodes if and only if it would add nothing to the shape. Otherwise
    a place that becomes text accepts any value. Objects become structures whose fields are
    ``f0``, ``f1``... in the order of the properties.
    """
    kinds = shape.kinds
    if not exact and column_kind(shape) == "text":
        return Any
    types = [_PLAIN_TYPES[kind] for kind in sorted(kinds & _PLAIN_TYPES.keys())]
    if "object" in kinds:
        types.append(dict[str, Any] if shape.open else _structure(shape, exact))
    if "array" in kinds:
        types.append(_list(shape, exact))
    return Union[tuple(types)] if types else None  # noqa: UP007  # built from a list


def _structure(shape: Shape, exact: bool) -> Any:
    keys = list(shape.properties)
    fields = [
        (f"f{number}", message_type(shape.properties[key], exact), None)
        for number, key in enumerate(keys)
    ]
    names = {f"f{number}": key for number, key in enumerate(keys)}
    return msgspec.defstruct(
        "Message", fields, rename=names, forbid_unknown_fields=not shape.closed
    )


def _list(shape: Shape, exact: bool) -> Any:
    if shape.items is None:
        return list[Any]
    if not shape.items.kinds:
        return _EMPTY
    if not exact and column_kind(shape) == "list<text>":
        return list[Any]
    return list[message_type(shape.items, exact)]  # type: ignore[misc]  # made at run time


def is_exact(shape: Shape) -> bool:
    """Return whether ``message_type`` can express a shape: not text and binary at one place."""
    if {"string", "binary"} <= shape.kinds:
        return False
    return all(map(is_exact, shape.below()))


def make_decoder(shape: Shape, encoding: str, exact: bool) -> Callable[[bytes], Any]:
    """Return a decoder that raises ``msgspec.ValidationError`` on messages of another shape.

    It raises ``UndecodableError`` for bytes that are not JSON or MessagePack.
    """
    return decoder_into(message_type(shape, exact), encoding)


def decoder_into(target: Any, encoding: str) -> Callable[[bytes], Any]:
    """Return a decoder into a msgspec type that raises the errors of ``make_decoder``."""
    module: Any = msgspec.json if encoding == "json" else msgspec.msgpack
    quick = module.Decoder(target).decode

    def decode(message: bytes) -> Any:
        check_size(message, encoding)
        try:
            return quick(message)
        except (msgspec.MsgspecError, ValueError, TypeError, RecursionError):
            value = decode_plain(message, encoding)
            return msgspec.convert(value, target, builtin_types=(bytes,))

    return decode


def widen_schema(
    schema: Schema | None,
    messages: Sequence[bytes],
    encoding: str,
    name: str,
    sender_notes: ValueNotes | None = None,
    *,
    closes: bool = False,
    letters: bool = False,
) -> tuple[Schema, tuple[int, ...]]:
    """Widen a schema so that all messages unroll under it.

    ``encoding`` is ``json`` or ``msgpack``; ``sender_notes`` are units and labels that the sender
    states; the first schema takes them over. With ``closes`` no object gets further keys; with
    ``letters`` names of columns are transliterated from other scripts. Returns the same object
    when nothing has changed, and the numbers of the messages that are malformed. The kinds of
    value in the schema depend only on which messages were seen, not on their order; column names
    on which came first.
    """
    fits = _checker(schema.data, encoding) if schema is not None else None
    unknown = [n for n, message in enumerate(messages) if fits is None or not fits(message)]
    if not unknown and schema is not None:
        return schema, ()
    shape = from_schema(schema) if schema is not None else nullable_shape()
    shape.letters = shape.letters or letters
    if closes:
        close(shape)
    bad = [n for n in unknown if not _observed(shape, messages[n], encoding)]
    limit_columns(shape)
    remember_names(shape)
    notes = notes_of(schema) if schema is not None else sender_notes
    widened = to_schema(shape, name if schema is None else schema.name, notes)
    same = schema is not None and widened.data == schema.data
    return (schema if same and schema is not None else widened), tuple(bad)


def _observed(shape: Shape, message: bytes, encoding: str) -> bool:
    try:
        value = decode_plain(message, encoding)
        observe(Shape(), value)  # fails before anything is added
        observe(shape, value)
    except (UndecodableError, ValueError):
        return False
    return True


@lru_cache(maxsize=256)
def _checker(data: bytes, encoding: str) -> Callable[[bytes], bool]:
    """Return a fast predicate: does a message fit a schema without widening it?"""
    shape = from_schema(Schema("", "jsonschema", data))
    decode = make_decoder(shape, encoding, exact=True)
    exact = is_exact(shape)

    def fits(message: bytes) -> bool:
        try:
            decode(message)
        except (UndecodableError, msgspec.MsgspecError, ValueError):
            return False
        return exact

    return fits


_STAMPS = ("header/stamp", "header/timestamp", "stamp", "timestamp")
_STAMP_KINDS = {"integer", "number", "string"}
_STAMP_KEYS = {"secs", "sec"}
_MISFITS = (UndecodableError, msgspec.MsgspecError, ValueError)
_NO_NOTE = ValueNote()
_DTYPES = {kind: numpy_type(kind) for kind in ("bool", "int64", "float64")}


class DocumentUnroller:
    """Unrolls the messages of one JSON or MessagePack topic; missing values are nulls."""

    def __init__(self, schema: Schema, encoding: str, stamp: str | None = None) -> None:
        self._shape = from_schema(schema)
        check_places(schema.name, _count(self._shape))
        self._decode = make_decoder(self._shape, encoding, exact=False)
        self._stamp_path = _own_stamp(self._shape, stamp)
        self._decode_stamp = _stamp_decoder(self._stamp_path, encoding)
        self._plain = readable_identifier if self._shape.letters else identifier
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
        """Return the value at the place of the stamp if it is not a time, else None."""
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
    """Return the number of columns of a table and of its child tables."""
    return sum(
        1 + (_count(shape.items) if kind == "children" and shape.items else 0)
        for _, shape, kind in places(table)
    )


def _described(name: str, path: str, kind: str, note: ValueNote) -> Column:
    """Return a column: numbers have their unit, whole numbers their labels."""
    is_whole = "int" in kind
    unit = note.unit if is_whole or "float" in kind else ""
    return Column(name, path, kind, unit, note.labels if is_whole else {})


def _found(
    shape: Shape, values: Sequence[Any], path: str
) -> Iterator[tuple[str, Shape, str, Sequence[Any]]]:
    """Yield the columns and child tables of a table in the order of ``places``, with
    their values.
    """
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
    return offsets_of([len(value) if value else 0 for value in values])


def _column(kind: str, values: Sequence[Any]) -> ColumnData:
    if kind.startswith("list<"):
        items = [item for value in values if value for item in value]
        return Ragged(_offsets(values), _items(kind[5:-1], items))
    if kind in _DTYPES:
        dtype = _DTYPES[kind]
        missing = [value is None for value in values]
        if not any(missing):
            return np.array(values, dtype)
        return np.ma.MaskedArray(np.array([0 if v is None else v for v in values], dtype), missing)
    return objects([text_of(value) for value in values] if kind == "text" else values)


def _items(kind: str, items: Sequence[Any]) -> Any:
    if kind == "float64":
        return np.array([np.nan if item is None else item for item in items], np.float64)
    if kind in _DTYPES:
        return np.array(items, _DTYPES[kind])
    return objects([text_of(item) for item in items] if kind == "text" else items)


def _own_stamp(shape: Shape, stamp: str | None) -> str:
    """Return the path of the message's own stamp; empty until one has been seen."""
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
    """Return a decoder that reads only the stamp of a message."""
    target: Any = Any
    parts = path.split("/")
    for part in reversed(parts):
        target = msgspec.defstruct("Stamp", [("f0", target, None)], rename={"f0": _unescape(part)})
    decode = decoder_into(target, encoding)
    get = attrgetter(".".join(["f0"] * len(parts)))
    return lambda message: plain(get(decode(message)))
