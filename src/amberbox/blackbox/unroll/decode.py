"""JSON and MessagePack messages as Python values, checked against a shape in C."""

from __future__ import annotations

import datetime
import json
import re
from base64 import b64encode
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any, Union

import msgspec

from amberbox.blackbox.unroll.shapes import Shape, column_kind

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
_MOST_VALUES = 1 << 24
"""A map of 4,000 x 4,000 cells is believed; a JSON text of more values is not decoded."""
_HALF = re.compile("[\ud800-\udfff]")
_MOST_DIGITS = 300
_LONG_NUMBER = re.compile(rb"[0-9]{%d}" % _MOST_DIGITS)
TOO_DEEP = "(nested too deep to be shown)"
"""Text of a value that is nested deeper than Python can follow; the message has it."""


class MalformedError(Exception):
    """A message that is no JSON or MessagePack, or one that takes too much to decode."""


def check_size(message: bytes, encoding: str) -> None:
    """Raise MalformedError for a JSON text of so many values that they would fill the memory.

    Each takes 50 to 100 times its bytes. What is in strings is counted, too.
    """
    if encoding != "json" or len(message) <= _FEW_BYTES:
        return
    lists = message.count(b"{") + message.count(b"[")
    if lists > _MOST_LISTS or message.count(b",") > _MOST_VALUES:
        raise MalformedError("it has more values than can be decoded")


def decode_plain(message: bytes, encoding: str) -> Any:
    """Decode one message of any shape; raises ``MalformedError``.

    Python's ``NaN`` and ``Infinity`` are read although they are not JSON. Keys become strings.
    Numbers beyond all floats are infinite, half surrogates in texts become U+FFFD.
    """
    check_size(message, encoding)
    try:
        if encoding == "json":
            return _decode_json(message)
        return plain(msgspec.msgpack.decode(message))
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise MalformedError(str(error)) from error


def _decode_json(message: bytes) -> Any:
    if not _LONG_NUMBER.search(message):
        with suppress(msgspec.DecodeError):
            return msgspec.json.decode(message)
    return _mended(json.loads(message.decode(), parse_int=_number))


def _number(text: str) -> float:
    """Read a whole number; one that is so long that no float may hold it as a float."""
    return int(text) if len(text) < _MOST_DIGITS else float(text)


def _mended(value: Any) -> Any:
    """Replace half surrogates, which no text in UTF-8 can hold."""
    match value:
        case str():
            return _HALF.sub("\ufffd", value)
        case dict():
            return {_mended(key): _mended(item) for key, item in value.items()}
        case list():
            return [_mended(item) for item in value]
    return value


def plain(value: Any) -> Any:
    """Replace what only MessagePack has: other keys than text, times, extensions."""
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
    """Write a value of a text column: strings as they are, bytes as Base64, the rest as JSON."""
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
    """Make the type that msgspec decodes messages of a shape into.

    With ``exact``, a message decodes if and only if it would add nothing to the shape. Otherwise
    places that become text take anything, as it came. Objects become structures whose fields are
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
    """Tell whether ``message_type`` can tell all that a shape tells (it cannot for both kinds
    of string at one place)."""
    if {"string", "binary"} <= shape.kinds:
        return False
    below = [*shape.properties.values(), *([shape.items] if shape.items else [])]
    return all(map(is_exact, below))


def make_decoder(shape: Shape, encoding: str, exact: bool) -> Callable[[bytes], Any]:
    """Make a decoder that raises ``msgspec.ValidationError`` on messages of another shape.

    What is no JSON or MessagePack raises ``MalformedError``.
    """
    return decoder_into(message_type(shape, exact), encoding)


def decoder_into(target: Any, encoding: str) -> Callable[[bytes], Any]:
    """Make a decoder into a type of msgspec's, with the same errors."""
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
