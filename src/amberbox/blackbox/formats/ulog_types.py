"""Message formats of ULog as ROS 1 definitions: both are packed and little endian.

So the bytes of a ULog message are those of a ROS 1 message, but for texts (``char`` arrays) and
padding inside a structure, which are rewritten.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from amberbox.core.errors import AmberboxError
from amberbox.core.names import identifier
from amberbox.core.types import Schema

PACKAGE = "ulog"
TIME = "timestamp"
"""Field of every message: microseconds since the start of the autopilot."""
UTC = "time_utc_usec"
"""Field of GPS messages: the same moment in UTC, 0 without a fix."""
_TYPES = {
    "int8_t": ("int8", 1), "uint8_t": ("uint8", 1), "int16_t": ("int16", 2),
    "uint16_t": ("uint16", 2), "int32_t": ("int32", 4), "uint32_t": ("uint32", 4),
    "int64_t": ("int64", 8), "uint64_t": ("uint64", 8), "float": ("float32", 4),
    "double": ("float64", 8), "bool": ("bool", 1), "char": ("string", 1),
}  # fmt: skip
_FIELD = re.compile(r"\s*(\w+)(?:\[(\d+)\])?\s+(\w+)\s*")
_DEEPEST = 8
_LARGEST = 0xFFFF


@dataclass(frozen=True, slots=True)
class Field:
    """One field; ``count`` is None unless it is an array."""

    base: str
    count: int | None
    name: str

    @property
    def is_padding(self) -> bool:
        """Tell whether the field only fills up the structure."""
        return self.name.startswith("_padding")


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message of ULog that can be unrolled.

    ``size`` is that without padding at its end, ``largest`` with it. The offsets are -1 where
    there is no such field. ``rewrite`` makes a ROS 1 message, None if it is one already.
    """

    schema: Schema
    size: int
    largest: int
    time_at: int
    utc_at: int
    rewrite: Callable[[bytes], bytes] | None


def parse_format(text: str) -> tuple[str, tuple[Field, ...]]:
    """Read ``name:type field;type[n] field;``; raises ValueError."""
    name, colon, rest = text.partition(":")
    if not colon or not name:
        raise ValueError(f"no format: {text[:40]!r}")
    return name, tuple(_parse_field(part) for part in rest.split(";") if part)


def _parse_field(text: str) -> Field:
    match = _FIELD.fullmatch(text)
    if match is None:
        raise ValueError(f"no field: {text[:40]!r}")
    base, count, name = match.groups()
    return Field(base, None if count is None else int(count), name)


Formats = Mapping[str, Sequence[Field]]


def compile_type(name: str, formats: Formats) -> MessageType:
    """Lay out a message type; raises AmberboxError when a format in it is missing or absurd."""
    fields = list(_fields(name, formats))
    largest = _size(fields, formats)
    while fields and fields[-1].is_padding:
        fields.pop()
    pieces = _merged(_pieces(fields, formats, 0))
    size = _size(fields, formats)
    whole = pieces == [(0, size, False)]
    return MessageType(
        Schema(f"{PACKAGE}/{name}", "ros1msg", _definition(name, fields, formats).encode()),
        size,
        largest,
        _offset_of(TIME, fields, formats),
        _offset_of(UTC, fields, formats),
        None if whole else partial(_rewrite, pieces),
    )


def _fields(name: str, formats: Formats, depth: int = 0) -> Sequence[Field]:
    if name not in formats or depth > _DEEPEST:
        what = "is missing" if name not in formats else "contains itself"
        raise AmberboxError(f"the format {name} {what}", "its messages are kept as they are")
    for field in formats[name]:
        if field.base not in _TYPES:
            _fields(field.base, formats, depth + 1)
    return formats[name]


def _size(fields: Sequence[Field], formats: Formats) -> int:
    size = sum(_field_size(field, formats) for field in fields)
    if size > _LARGEST:
        raise AmberboxError(f"a format of {size} bytes", "its messages are kept as they are")
    return size


def _field_size(field: Field, formats: Formats) -> int:
    count = 1 if field.count is None else field.count
    if field.base in _TYPES:
        return count * _TYPES[field.base][1]
    return count * _size(formats[field.base], formats)


def _offset_of(name: str, fields: Sequence[Field], formats: Formats) -> int:
    at = 0
    for field in fields:
        if (field.name, field.base, field.count) == (name, "uint64_t", None):
            return at
        at += _field_size(field, formats)
    return -1


# -- the definition


def _definition(name: str, fields: Sequence[Field], formats: Formats) -> str:
    texts = [_structure(fields)]
    needed, done = [f.base for f in fields], {name}
    while needed:
        base = needed.pop(0)
        if base in _TYPES or base in done:
            continue
        done.add(base)
        texts.append(f"MSG: {PACKAGE}/{base}\n{_structure(formats[base])}")
        needed += [field.base for field in formats[base]]
    return ("=" * 80 + "\n").join(texts)


def _structure(fields: Sequence[Field]) -> str:
    names = {field.name for field in fields}
    lines = [_line(field, names) for field in fields if not field.is_padding]
    return "".join(lines)


def _line(field: Field, names: set[str]) -> str:
    base = _TYPES[field.base][0] if field.base in _TYPES else f"{PACKAGE}/{field.base}"
    array = "" if field.count is None or field.base == "char" else f"[{field.count}]"
    return f"{base}{array} {_name(field, names)}\n"


def _name(field: Field, names: set[str]) -> str:
    """Name a field; ``timestamp`` is what rows have already, so this one says what it counts."""
    if field.name == TIME and f"{TIME}_us" not in names:
        return f"{TIME}_us"
    return identifier(field.name.lstrip("_") or field.name)


# -- the bytes

_Piece = tuple[int, int, bool]
"""From and to which byte, and whether that is a text."""


def _pieces(fields: Sequence[Field], formats: Formats, at: int) -> Iterator[_Piece]:
    for field in fields:
        size = _field_size(field, formats)
        if field.base in _TYPES:
            if not field.is_padding:
                yield at, at + size, field.base == "char"
            at += size
            continue
        inner = formats[field.base]
        for _ in range(1 if field.count is None else field.count):
            yield from _pieces(inner, formats, at)
            at += _size(inner, formats)


def _merged(pieces: Iterator[_Piece]) -> list[_Piece]:
    merged: list[_Piece] = []
    for start, end, is_text in pieces:
        if merged and not is_text and not merged[-1][2] and merged[-1][1] == start:
            merged[-1] = (merged[-1][0], end, False)
        else:
            merged.append((start, end, is_text))
    return merged


def _rewrite(pieces: Sequence[_Piece], message: bytes) -> bytes:
    return b"".join(
        _text(message[start:end]) if is_text else message[start:end]
        for start, end, is_text in pieces
    )


def _text(characters: bytes) -> bytes:
    """Write a text as ROS 1 does; in ULog it ends at its first NUL."""
    text = characters.partition(b"\0")[0]
    return len(text).to_bytes(4, "little") + text
