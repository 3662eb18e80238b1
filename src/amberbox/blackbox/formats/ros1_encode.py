"""Documents as ROS 1 messages: nested values become the bytes that were once on the wire."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from struct import Struct, error, pack
from typing import Any, TypeAlias

from amberbox.blackbox.unroll.definition import Definition, FieldType
from amberbox.core.stamps import time_of

_CODES = {
    "int8": "b", "byte": "b", "uint8": "B", "char": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_BYTES = {"int8", "byte", "uint8", "char"}
_NS = 1_000_000_000
_REFUSED = (error, OverflowError, TypeError, ValueError)

Write: TypeAlias = Callable[[Any, list[bytes]], None]
"""Appends the bytes of a value; raises MisfitError if it cannot be one of the type."""


class MisfitError(Exception):
    """A document that is no message of the type; the text names the place and what is wrong."""


def compile_encoder(definition: Definition) -> Callable[[Any], bytes]:
    """Make a function from a document to the bytes of a ROS 1 message.

    A document fits if it has all fields of the type and no others, and each value is one of its
    field's type. It raises MisfitError for those that do not. Whole numbers stand for floats and
    the other way round where nothing is lost.
    """
    write = _structure(definition, definition.root)

    def encode(document: Any) -> bytes:
        pieces: list[bytes] = []
        write(document, pieces)
        return b"".join(pieces)

    return encode


def _structure(definition: Definition, name: str) -> Write:
    fields = definition.structures[name].fields
    names = {field for field, _ in fields}
    steps: list[Write] = []
    for plain, group in groupby(fields, key=lambda item: _is_number(item[1])):
        if plain:
            steps.append(_numbers(list(group)))
        else:
            steps += [_field(field, _value(definition, kind)) for field, kind in group]

    def write(value: Any, pieces: list[bytes]) -> None:
        if not isinstance(value, dict):
            raise MisfitError(f"is no structure but {_named(value)}")
        if value.keys() != names:
            raise MisfitError(_difference(names, value))
        for step in steps:
            step(value, pieces)

    return write


def _is_number(kind: FieldType) -> bool:
    return kind.count is None and kind.base in _CODES


def _difference(names: set[str], value: Mapping[str, Any]) -> str:
    lacking, unknown = sorted(names - value.keys()), sorted(map(str, value.keys() - names))
    parts = [f"lacks {', '.join(lacking)}"] if lacking else []
    return " and ".join([*parts, f"has {', '.join(unknown)} too"] if unknown else parts)


def _numbers(fields: Sequence[tuple[str, FieldType]]) -> Write:
    """Write neighbouring numbers of a structure at once."""
    names = [name for name, _ in fields]
    codes = [_CODES[kind.base] for _, kind in fields]
    packed = Struct("<" + "".join(codes)).pack
    get: Callable[[Any], tuple[Any, ...]] = (
        itemgetter(*names) if len(names) > 1 else lambda value: (value[names[0]],)
    )

    def write(value: Any, pieces: list[bytes]) -> None:
        try:
            pieces.append(packed(*get(value)))
        except _REFUSED:  # one by one: a whole number may stand as a float
            for name, code in zip(names, codes, strict=True):
                pieces.append(_number(name, code, value[name]))

    return write


def _number(name: str, code: str, value: Any) -> bytes:
    try:
        return pack("<" + code, _as_number(code, value))
    except _REFUSED:
        raise MisfitError(f"{name} is {_named(value)}") from None


def _as_number(code: str, value: Any) -> Any:
    """Turn 3.0 into 3 where a whole number is wanted."""
    whole = isinstance(value, float) and code not in "fd" and value.is_integer()
    return int(value) if whole else value


def _field(name: str, write: Write) -> Write:
    def write_field(value: Any, pieces: list[bytes]) -> None:
        try:
            write(value[name], pieces)
        except MisfitError as misfit:
            text = str(misfit)
            inner = text.startswith(("is ", "has ", "lacks "))
            raise MisfitError(f"{name}{' ' if inner else '/'}{text}") from None

    return write_field


def _value(definition: Definition, kind: FieldType) -> Write:
    if kind.count is None:
        return _single(definition, kind.base)
    if kind.base in _CODES:
        return _number_array(kind)
    return _array(kind, _single(definition, kind.base))


def _single(definition: Definition, base: str) -> Write:
    return _SIMPLE[base] if base in _SIMPLE else _structure(definition, base)


def _array(kind: FieldType, write: Write) -> Write:
    def write_array(value: Any, pieces: list[bytes]) -> None:
        _begin(kind, value, pieces)
        for element in value:
            write(element, pieces)

    return write_array


def _begin(kind: FieldType, value: Any, pieces: list[bytes]) -> None:
    if not isinstance(value, list):
        raise MisfitError(f"is no list but {_named(value)}")
    _begin_counted(kind, len(value), pieces)


def _begin_counted(kind: FieldType, count: int, pieces: list[bytes]) -> None:
    if kind.count == FieldType.SEQUENCE:
        pieces.append(count.to_bytes(4, "little"))
    elif count != kind.count:
        raise MisfitError(f"has {count} elements instead of {kind.count}")


def _number_array(kind: FieldType) -> Write:
    code = _CODES[kind.base]

    def write(value: Any, pieces: list[bytes]) -> None:
        if isinstance(value, bytes) and kind.base in _BYTES:
            _begin_counted(kind, len(value), pieces)
            pieces.append(value)
            return
        _begin(kind, value, pieces)
        try:
            pieces.append(pack(f"<{len(value)}{code}", *value))
        except _REFUSED:
            pieces += [_number(f"element {n}", code, item) for n, item in enumerate(value)]

    return write


def _write_bool(value: Any, pieces: list[bytes]) -> None:
    if not isinstance(value, int | float) or value not in (0, 1):
        raise MisfitError(f"is {_named(value)} and not true or false")
    pieces.append(b"\1" if value else b"\0")


def _write_text(value: Any, pieces: list[bytes]) -> None:
    if not isinstance(value, str | bytes):
        raise MisfitError(f"is no text but {_named(value)}")
    data = value.encode() if isinstance(value, str) else value
    pieces += [len(data).to_bytes(4, "little"), data]


def _write_time(value: Any, pieces: list[bytes]) -> None:
    try:
        if isinstance(value, dict):
            pieces.append(pack("<II", *_pair(value)))
        else:
            pieces.append(pack("<II", *divmod(_epoch_ns(value), _NS)))
    except _REFUSED:
        raise MisfitError(f"is no time but {_named(value)}") from None


def _epoch_ns(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    stamp_ns = time_of(value)
    if value and not stamp_ns:
        raise ValueError
    return stamp_ns


def _write_duration(value: Any, pieces: list[bytes]) -> None:
    try:
        if not isinstance(value, dict):
            raise TypeError
        pieces.append(pack("<ii", *_pair(value)))
    except _REFUSED:
        raise MisfitError(f"is no duration but {_named(value)}") from None


def _pair(value: Mapping[str, Any]) -> tuple[Any, Any]:
    if value.keys() == {"secs", "nsecs"}:
        return _as_number("i", value["secs"]), _as_number("i", value["nsecs"])
    if value.keys() == {"sec", "nsec"}:
        return _as_number("i", value["sec"]), _as_number("i", value["nsec"])
    raise ValueError


_SIMPLE: Mapping[str, Write] = {
    "bool": _write_bool,
    "string": _write_text,
    "time": _write_time,
    "duration": _write_duration,
}


def _named(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
