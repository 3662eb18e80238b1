"""Protobuf descriptors: the FileDescriptorSet of a schema as types, by their full names.

Read from its bytes (``google/protobuf/descriptor.proto``), as MCAP and Foxglove carry it; proto2,
proto3 and editions. Options other than those named here do not change the encoding.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

VARINT, FIXED64, BYTES, GROUP, GROUP_END, FIXED32 = range(6)
LONGEST_VARINT = 10
DEEPEST = 100  # groups in unknown groups, types in types

KINDS = (
    *("", "double", "float", "int64", "uint64", "int32", "fixed64", "fixed32", "bool", "string"),
    *("group", "message", "bytes", "uint32", "enum", "sfixed32", "sfixed64", "sint32", "sint64"),
)
"""Names of field types by their number."""

STRUCTURES = ("message", "group")
_REPEATED = 3
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_FIELD_NUMBERS = range(1, 1 << 29)
_IMPLICIT, _DELIMITED = 2, 2


@dataclass(frozen=True, slots=True)
class ProtoField:
    """A field: its number, its kind (``KINDS``), and for structures and enums the type's name.

    ``has_presence`` is False where a missing value means zero. ``oneof`` is the number of its
    oneof in the message, None for none.
    """

    name: str
    number: int
    kind: str
    type_name: str = ""
    is_repeated: bool = False
    has_presence: bool = False
    oneof: int | None = None


@dataclass(frozen=True, slots=True)
class ProtoDefinition:
    """A message type with all types it needs; labels are the names of the values of enums."""

    root: str
    messages: Mapping[str, tuple[ProtoField, ...]] = field(default_factory=dict)
    labels: Mapping[str, Mapping[int, str]] = field(default_factory=dict)


WireValue: TypeAlias = "tuple[int, int, int, int]"
"""Number of a field, its wire type, and start and end of its value."""


def read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the number at a place and the place behind it; raises ValueError if it is too long."""
    value = shift = 0
    for place in range(at, at + LONGEST_VARINT):
        byte = data[place]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, place + 1
        shift += 7
    raise ValueError("a varint of more than 10 bytes")


def fields_of(data: bytes, at: int, end: int) -> Iterator[WireValue]:
    """Yield the fields of a message; raises ValueError or IndexError if it is damaged.

    A group is yielded with the place of its contents, without the key that ends it.
    """
    while at < end:
        key, at = read_varint(data, at)
        number, wire = key >> 3, key & 7
        start, stop, at = extent(data, at, end, number, wire)
        yield number, wire, start, stop
    if at != end:
        raise ValueError("a message that ends within a field")


def extent(data: bytes, at: int, end: int, number: int, wire: int) -> tuple[int, int, int]:
    """Return start and end of the value at a place, and the place behind it."""
    if number not in _FIELD_NUMBERS or wire not in (VARINT, FIXED64, BYTES, GROUP, FIXED32):
        raise ValueError("a key that protobuf does not have")
    if wire == GROUP:
        stop, behind = _group_end(data, at, end, number)
        return at, stop, behind
    if wire == VARINT:
        start, (_, stop) = at, read_varint(data, at)
    elif wire == BYTES:
        size, start = read_varint(data, at)
        stop = start + size
    else:
        start, stop = at, at + (8 if wire == FIXED64 else 4)
    if stop > end:
        raise ValueError("a field that ends behind its message")
    return start, stop, stop


def _group_end(data: bytes, at: int, end: int, number: int) -> tuple[int, int]:
    """Return the place of the key that ends a group, and the place behind it."""
    inside = [number]
    while at < end:
        place = at
        key, at = read_varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == GROUP:
            inside.append(number)
            if len(inside) > DEEPEST:
                break
        elif wire != GROUP_END:
            _, _, at = extent(data, at, end, number, wire)
        elif inside.pop() != number:
            break
        elif not inside:
            return place, at
    raise ValueError("a group without an end")


def parse_definition(schema: Schema) -> ProtoDefinition:
    """Read a ``protobuf`` schema; raises AmberboxError when it is no set of descriptors, or when
    the message type or one that it needs is missing.
    """
    reader = _Reader(schema.data)
    try:
        for file in reader.parts(0, len(schema.data)).get(1, ()):
            reader.file(*file)
    except (ValueError, IndexError, struct.error, RecursionError) as error:
        raise AmberboxError(
            f"cannot read the definition of {schema.name}: {error}",
            "a protobuf schema is a serialised FileDescriptorSet",
        ) from error
    _check_complete(schema.name, reader.messages, reader.labels)
    return ProtoDefinition(schema.name, reader.messages, reader.labels)


def _check_complete(
    root: str,
    messages: Mapping[str, tuple[ProtoField, ...]],
    labels: Mapping[str, Mapping[int, str]],
) -> None:
    open_types, seen = [root], set()
    while open_types:
        name = open_types.pop()
        if name not in messages:
            raise AmberboxError(
                f"the definition of {root} cannot be unrolled: {name} is missing",
                "the schema has to hold the descriptors of all files that it imports",
            )
        seen.add(name)
        for one in messages[name]:
            if one.kind in STRUCTURES and one.type_name not in seen:
                open_types.append(one.type_name)
            elif one.kind == "enum" and one.type_name not in labels:
                raise AmberboxError(
                    f"the definition of {root} cannot be unrolled: {one.type_name} is missing",
                    "the schema has to hold the descriptors of all files that it imports",
                )


@dataclass(frozen=True, slots=True)
class _Style:
    """What a file says of its fields: missing is zero, structures are groups, it has features."""

    implicit: bool
    delimited: bool
    editions: bool


_Parts: TypeAlias = "dict[int, list[tuple[int, int]]]"


class _Reader:
    """Collects the types of a set of descriptors."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.messages: dict[str, tuple[ProtoField, ...]] = {}
        self.labels: dict[str, Mapping[int, str]] = {}
        self.entries: set[str] = set()  # types of the entries of maps

    def parts(self, start: int, end: int) -> _Parts:
        """Return the places of the values of a message, by the number of their field."""
        parts: _Parts = {}
        for number, _, first, last in fields_of(self.data, start, end):
            parts.setdefault(number, []).append((first, last))
        return parts

    def text(self, parts: _Parts, number: int) -> str:
        start, end = parts.get(number, [(0, 0)])[-1]
        return self.data[start:end].decode("utf-8", "replace")

    def number(self, parts: _Parts, number: int, default: int = 0) -> int:
        places = parts.get(number)
        if not places or places[-1][0] == places[-1][1]:
            return default
        value = read_varint(self.data, places[-1][0])[0]
        return value - (1 << 64) if value >> 63 else value

    def below(self, parts: _Parts, number: int) -> _Parts:
        """Return the parts of a message in a field; of several, those of all."""
        found: _Parts = {}
        for place in parts.get(number, ()):
            for key, places in self.parts(*place).items():
                found.setdefault(key, []).extend(places)
        return found

    def file(self, start: int, end: int) -> None:
        parts = self.parts(start, end)
        package = self.text(parts, 2)
        syntax = self.text(parts, 12) or "proto2"
        features = self.below(self.below(parts, 8), 50)
        implicit = syntax == "proto3" or self.number(features, 1) == _IMPLICIT
        delimited = self.number(features, 5) == _DELIMITED
        style = _Style(implicit, delimited, syntax == "editions")
        above = f"{package}." if package else ""
        for place in parts.get(5, ()):
            self.enum(above, *place)
        for place in parts.get(4, ()):
            self.message(above, style, 0, *place)

    def enum(self, above: str, start: int, end: int) -> None:
        parts = self.parts(start, end)
        labels: dict[int, str] = {}
        for place in parts.get(2, ()):
            value = self.parts(*place)
            labels.setdefault(self.number(value, 2), self.text(value, 1))
        self.labels[above + self.text(parts, 1)] = labels

    def message(self, above: str, style: _Style, depth: int, start: int, end: int) -> None:
        if depth > DEEPEST:
            raise ValueError("types are nested too deeply")
        parts = self.parts(start, end)
        name = above + self.text(parts, 1)
        for place in parts.get(4, ()):
            self.enum(f"{name}.", *place)
        for place in parts.get(3, ()):
            self.message(f"{name}.", style, depth + 1, *place)
        is_entry = bool(self.number(self.below(parts, 7), 7))
        if is_entry:
            self.entries.add(name)
        fields = [self.field(self.parts(*place), style, is_entry) for place in parts.get(2, ())]
        numbers, names = {one.number for one in fields}, {one.name for one in fields}
        if len(numbers) < len(fields) or len(names) < len(fields):
            raise ValueError(f"{name} has two fields of one number or name")
        self.messages[name] = tuple(fields)

    def field(self, parts: _Parts, style: _Style, is_entry: bool) -> ProtoField:
        """Read a field; in the entry of a map a missing key or value is zero."""
        kind = self.number(parts, 5)
        if not 0 < kind < len(KINDS):
            raise ValueError(f"a field of the unknown type {kind}")
        if not _NAME.fullmatch(self.text(parts, 1)) or self.number(parts, 3) not in _FIELD_NUMBERS:
            raise ValueError("a field without a proper name and number")
        features = self.below(self.below(parts, 8), 21)
        presence = self.number(features, 1)
        delimited = self.number(features, 5)
        name, type_name = KINDS[kind], self.text(parts, 6).removeprefix(".")
        if name == "message" and style.editions and type_name not in self.entries:
            name = "group" if (delimited or 2 * style.delimited) == _DELIMITED else name
        oneof = self.number(parts, 9) if 9 in parts else None
        implicit = presence == _IMPLICIT if presence else style.implicit
        return ProtoField(
            self.text(parts, 1),
            self.number(parts, 3),
            name,
            type_name,
            self.number(parts, 4) == _REPEATED,
            name in STRUCTURES or (not is_entry and (oneof is not None or not implicit)),
            None if self.number(parts, 17) else oneof,
        )
