"""The inferred schema of a JSON or MessagePack topic: its shape, and the shape as JSON Schema.

A shape holds the kinds of value seen at each place so far. Observing a message only adds kinds, so
the shape does not depend on the order of messages. It is written as JSON Schema (draft 2020-12) and
read back; ``viewer_form`` and ``viewer_schema`` reduce a schema to what viewers such as Foxglove
accept. Notes hold units and labels that a sender's own JSON Schema states.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import msgspec

from amberbox.core.names import identifier, readable_identifier
from amberbox.core.types import Schema

MOST_PROPERTIES = 256
# objects with more keys, and values nested deeper, are kept as JSON text in one column
DEEPEST = 16

# a message with more places has the objects in it kept as text, the deepest ones first
MOST_COLUMNS = 4096

_INT64 = range(-(2**63), 2**63)
_UNNAMEABLE = re.compile(r'["\\\x00-\x1f\ud800-\udfff]')


@dataclass(slots=True)
class Shape:
    """Kinds seen at one place, with the shapes below it.

    ``kinds`` holds JSON's types and ``binary``. ``number`` covers ``integer``. An ``open`` shape
    does not describe the places below it, nor does a list without ``items``. A ``closed`` one takes
    no further properties: their values stay in the message alone. ``names`` is used where a table
    begins.
    """

    kinds: set[str] = field(default_factory=set)
    properties: dict[str, Shape] = field(default_factory=dict)
    items: Shape | None = None
    open: bool = False
    closed: bool = False
    names: list[str] = field(default_factory=list)
    letters: bool = False  # at the top: whether columns are named in Latin letters

    def below(self) -> tuple[Shape, ...]:
        """Return the shapes of the properties and of the items."""
        return (*self.properties.values(), *([self.items] if self.items else ()))

    def values(self) -> set[str]:
        """Return the kinds without null."""
        return self.kinds - {"null"}


def nullable_shape() -> Shape:
    """Return the shape of a place that may be missing: the top level, or a property."""
    return Shape({"null"})


def close(shape: Shape) -> None:
    """Accept no further properties in objects that have some: new keys are data, such as ids."""
    shape.closed = shape.closed or bool(shape.properties)
    for inner in shape.below():
        close(inner)


def limit_columns(shape: Shape) -> None:
    """Turn objects into text, the deepest first, until at most ``MOST_COLUMNS`` places are left."""
    depth = DEEPEST
    while depth and _count(shape) > MOST_COLUMNS:
        _open_below(shape, depth)
        depth -= 1


def _count(shape: Shape) -> int:
    return 1 + sum(map(_count, shape.below()))


def _open_below(shape: Shape, depth: int) -> None:
    if not depth:
        shape.open = shape.open or bool(shape.properties) or shape.items is not None
        shape.properties, shape.items, shape.closed = {}, None, False
        return
    for inner in shape.below():
        _open_below(inner, depth - 1)


def observe(shape: Shape, value: Any, depth: int = 0) -> None:
    """Add a decoded value to a shape."""
    kind = _kind(value)
    shape.kinds.add(kind)
    if kind == "number" or "number" in shape.kinds:
        shape.kinds.discard("integer")
    if kind == "object" and not shape.open:
        _observe_object(shape, value, depth)
    elif kind == "array" and not shape.open:
        _observe_array(shape, value, depth)


def _kind(value: Any) -> str:
    match value:
        case None:
            return "null"
        case bool():
            return "boolean"
        case int():
            return "integer" if value in _INT64 else "number"
        case float():
            return "number"
        case str():
            return "string"
        case bytes():
            return "binary"
        case list():
            return "array"
        case _:
            return "object"


def _observe_object(shape: Shape, value: Mapping[str, Any], depth: int) -> None:
    for key, item in value.items():
        if key not in shape.properties:
            if shape.closed:
                continue
            shape.properties[key] = nullable_shape()
        if depth >= DEEPEST or len(shape.properties) > MOST_PROPERTIES or not is_nameable(key):
            shape.open, shape.closed = True, False
            shape.properties, shape.items = {}, None
            return
        observe(shape.properties[key], item, depth + 1)


def is_nameable(key: str) -> bool:
    """Return whether a property can become a column: not with quotes or control characters.

    msgspec refuses such names; the object is kept as text.
    """
    return not _UNNAMEABLE.search(key)


def _observe_array(shape: Shape, value: list[Any], depth: int) -> None:
    shape.items = shape.items or Shape()
    shape.items.open = shape.items.open or depth >= DEEPEST
    for item in value:
        # nested lists become text as a whole, so their elements are not observed
        if isinstance(item, list):
            shape.items.kinds.add("array")
        else:
            observe(shape.items, item, depth + 1)


def column_kind(shape: Shape) -> str:
    """Return the kind of a place: a column type, ``nested``, ``children``, or '' for no column.

    Columns of mixed kinds are ``text``: strings unchanged, all other values as JSON.
    """
    kinds = shape.values()
    if len(kinds) != 1:
        return "text" if kinds else ""
    kind = next(iter(kinds))
    if kind in _SCALARS:
        return _SCALARS[kind]
    if shape.open:
        return "text"
    return "nested" if kind == "object" else _list_kind(shape.items or Shape())


_SCALARS = {
    "boolean": "bool",
    "integer": "int64",
    "number": "float64",
    "string": "string",
    "binary": "binary",
}


def _list_kind(items: Shape) -> str:
    kinds = items.values()
    if not kinds:
        return ""
    if kinds == {"object"}:
        return "text" if items.open else "children"
    if kinds & {"object", "array"}:
        return "text"
    if len(kinds) > 1:
        return "list<text>"
    kind = _SCALARS[next(iter(kinds))]
    if "null" in items.kinds:  # a null among numbers is how JSON writes NaN
        kind = {"bool": "text", "int64": "float64"}.get(kind, kind)
    return f"list<{kind}>"


def escape(key: str) -> str:
    """Escape a key for a path as in a JSON pointer; an empty key becomes ``~2``."""
    return key.replace("~", "~0").replace("/", "~1") or "~2"


def places(shape: Shape, path: str = "") -> Iterator[tuple[str, Shape, str]]:
    """Yield path, shape and kind of the columns and child tables of a table, in schema order.

    A topic whose messages are not objects is one column ``value``.
    """
    kind = column_kind(shape)
    if kind == "nested":
        for key, inner in shape.properties.items():
            yield from places(inner, f"{path}/{escape(key)}" if path else escape(key))
    elif kind:
        yield path or "value", shape, kind


def remember_names(table: Shape) -> None:
    """Append the paths of new columns to ``names``, in this table and those below."""
    known = set(table.names)
    for path, shape, kind in list(places(table)):
        if kind == "children" and shape.items is not None:
            remember_names(shape.items)
        elif path not in known:
            table.names.append(path)


# keyword of schemas in journals: the notes of all paths, also of those that never came
NOTES_KEY = "x-notes"
UNIT, LABELS = "unit", "labels"  # keywords of senders, beside the type of a place


@dataclass(frozen=True, slots=True)
class ValueNote:
    """Unit of the numbers at one place, and labels of its whole numbers."""

    unit: str = ""
    labels: Mapping[int, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.unit or self.labels)


# by path; a place in a list of structures is keyed by the path of the list and its own
ValueNotes: TypeAlias = Mapping[str, ValueNote]


def notes_of(schema: Schema | None) -> ValueNotes:
    """Read the notes of a schema, a sender's or one of ours; unparsable ones are left out."""
    if schema is None or schema.encoding != "jsonschema":
        return {}
    try:
        document = msgspec.json.decode(schema.data)
    except (msgspec.DecodeError, RecursionError):
        return {}
    if not isinstance(document, dict):
        return {}
    kept = document.get(NOTES_KEY)
    if isinstance(kept, dict):
        found = ((path, _note(stated)) for path, stated in kept.items())
    else:
        found = ((path, note) for path, note in _stated_notes(document, ""))
    return {path: note for path, note in found if note}


def notes_json(notes: ValueNotes) -> dict[str, Any]:
    """Return notes as a part of a schema's document; empty without notes."""
    return {NOTES_KEY: {path: _plain(note) for path, note in notes.items()}} if notes else {}


def _stated_notes(document: Any, path: str, depth: int = 0) -> Iterator[tuple[str, ValueNote]]:
    """Yield the notes in a sender's document, as deep as messages are unrolled."""
    if not isinstance(document, dict) or depth > 2 * DEEPEST:  # a list is a step of its own
        return
    yield path or "value", _note(document)
    yield from _stated_notes(document.get("items"), path or "value", depth + 1)
    below = document.get("properties")
    for key, inner in below.items() if isinstance(below, dict) else ():
        yield from _stated_notes(inner, f"{path}/{escape(key)}" if path else escape(key), depth + 1)


def _note(stated: Any) -> ValueNote:
    stated = stated if isinstance(stated, dict) else {}
    unit, labels = stated.get(UNIT), stated.get(LABELS)
    words = labels.items() if isinstance(labels, dict) else ()
    return ValueNote(
        unit if isinstance(unit, str) else "",
        {int(n): w for n, w in words if isinstance(w, str) and _is_whole(n)},
    )


def _is_whole(text: str) -> bool:
    return text.removeprefix("-").isdecimal() and text.isascii()


def _plain(note: ValueNote) -> dict[str, Any]:
    labels = {str(number): word for number, word in note.labels.items()}
    return {key: value for key, value in ((UNIT, note.unit), (LABELS, labels)) if value}


# keyword beside ``contentEncoding``: some of the values are plain text
ALSO_TEXT_KEY = "x-also-text"

_SIMPLE = {"boolean", "integer", "number", "string"}


def viewer_form(document: Any) -> dict[str, Any] | None:
    """Simplify a JSON Schema until viewers such as Foxglove accept it; None if that is impossible.

    They refuse a whole channel for one property with several types, such as ``number or null``,
    but accept a null where they expect a number. A property that cannot be simplified is left
    out: its values are still in the messages.
    """
    if not isinstance(document, Mapping):
        return None
    kinds = [kind for kind in _types(document) if kind != "null"]
    kind = kinds[0] if len(kinds) == 1 else None
    if kind in _SIMPLE:
        encoding = document.get("contentEncoding")
        if document.get(ALSO_TEXT_KEY):
            return None
        return {"type": kind} | ({"contentEncoding": encoding} if encoding else {})
    if kind == "object":
        return _object(document)
    return _array(document) if kind == "array" else None


def _types(document: Mapping[str, Any]) -> list[Any]:
    types = document.get("type")
    return [types] if isinstance(types, str) else list(types or ())


def _object(document: Mapping[str, Any]) -> dict[str, Any]:
    below = {name: viewer_form(inner) for name, inner in document.get("properties", {}).items()}
    return {"type": "object", "properties": {n: p for n, p in below.items() if p is not None}}


def _array(document: Mapping[str, Any]) -> dict[str, Any] | None:
    items = viewer_form(document.get("items"))
    if items is None or items["type"] == "array" or "contentEncoding" in items:
        return None
    if items["type"] == "object" and "null" in _types(document["items"]):
        return None  # they look into each object of a list, and stop at a null
    return {"type": "array", "items": items}


# keyword for the paths of a table's columns in the order they were first seen, where the order of
# the properties differs: names are given in that order and never change
NAMES_KEY = "x-columns"

# keyword for all kinds of value that were seen, where the plain types do not show them. Viewers
# accept no "number or text"; that a value may be missing or null is not stated, because the root
# and every property may.
SHAPE_KEY = "x-shape"

# keyword of a document whose columns are named in Latin letters where paths are of other scripts;
# without it everything but ASCII is ``_`` in a name
LETTERS_KEY = "x-letters"

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
# comment of documents that promise the columns of their messages, as those of others may not
EXACT_COMMENT = "every message fits: amberbox"
_ORDER = ("array", "boolean", "integer", "number", "object", "string", "null")


def to_schema(shape: Shape, name: str, notes: ValueNotes | None = None) -> Schema:
    """Return a shape as a JSON Schema document that viewers accept, with notes on its places."""
    document = {"$schema": _DRAFT, "$comment": EXACT_COMMENT, "title": name}
    document |= _for_viewers(shape) | notes_json(notes or {})
    if shape.letters and _has_other_letters(shape):
        document[LETTERS_KEY] = "latin"
    return Schema(name, "jsonschema", msgspec.json.encode(document))


def _has_other_letters(table: Shape) -> bool:
    """Return whether transliteration changes the name of any column."""
    for path, shape, kind in places(table):
        if kind == "children" and shape.items is not None:
            if _has_other_letters(shape.items):
                return True
        elif readable_identifier(path) != identifier(path):
            return True
    return False


def _for_viewers(shape: Shape) -> dict[str, Any]:
    full = _to_json(shape, table=True)
    plain = viewer_form(full)
    if plain is None or plain["type"] != "object":  # they ask for an object, whatever comes
        plain = {"type": "object", "properties": {}}
    is_complete = _to_json(_nullable(plain, table=True), table=True) == full
    return plain if is_complete else plain | {SHAPE_KEY: full}


def _to_json(shape: Shape, table: bool = False) -> dict[str, Any]:
    types = {kind if kind != "binary" else "string" for kind in shape.kinds}
    document: dict[str, Any] = {"type": [kind for kind in _ORDER if kind in types]}
    if "binary" in shape.kinds:
        document["contentEncoding"] = "base64"
        if "string" in shape.kinds:
            document[ALSO_TEXT_KEY] = True
    if shape.open:
        return document | {"additionalProperties": True}
    if "object" in shape.kinds:
        document["properties"] = {k: _to_json(v) for k, v in shape.properties.items()}
    if shape.closed:  # readers that do not know such shapes keep the whole object as text
        document["additionalProperties"] = True
    if shape.items is not None:
        empty = not shape.items.kinds  # no item was ever seen
        document["items"] = False if empty else _to_json(shape.items, table=True)
    if table and shape.names and shape.names != _natural_names(shape):
        document[NAMES_KEY] = shape.names
    return document


def _natural_names(table: Shape) -> list[str]:
    return [path for path, _, kind in places(table) if kind != "children"]


def from_schema(schema: Schema) -> Shape:
    """Read a shape from the JSON Schema document that ``to_schema`` wrote.

    Schemas of others may promise more than their messages keep; they start an empty shape.
    """
    try:
        document = msgspec.json.decode(schema.data)
    except msgspec.DecodeError:
        return nullable_shape()
    if not is_exact_schema(document):
        return nullable_shape()
    shape = _nullable(document.get(SHAPE_KEY, document), table=True)
    shape.letters = document.get(LETTERS_KEY) == "latin"
    return shape


def is_exact_schema(document: Any) -> bool:
    """Return whether a document was made by ``to_schema``, or is that of a reserved channel."""
    return isinstance(document, dict) and document.get("$comment") == EXACT_COMMENT


def _from_json(document: Mapping[str, Any], table: bool = False) -> Shape:
    types = document.get("type", [])
    shape = Shape({types} if isinstance(types, str) else set(types))
    if "contentEncoding" in document:
        shape.kinds.add("binary")
        if not document.get(ALSO_TEXT_KEY):
            shape.kinds.discard("string")
    properties = document.get("properties", {})
    takes_more = document.get("additionalProperties") is True
    shape.closed = takes_more and bool(properties)
    shape.open = (takes_more and not properties) or not all(map(is_nameable, properties))
    if not shape.open:
        shape.properties = {k: _nullable(v) for k, v in properties.items()}
    if "items" in document:
        shape.items = _from_json(document["items"] or {}, table=True)
    if table:
        shape.names = list(document.get(NAMES_KEY) or _natural_names(shape))
    return shape


def _nullable(document: Mapping[str, Any], table: bool = False) -> Shape:
    shape = _from_json(document, table)
    shape.kinds.add("null")
    return shape


def viewer_schema(schema: Schema | None) -> Schema | None:
    """Return a schema that viewers such as Foxglove read; None if there is none.

    Schemas in journals have this form already; those of older journals are converted.
    """
    if schema is None or schema.encoding != "jsonschema":
        return schema
    try:
        document = msgspec.json.decode(schema.data)
    except msgspec.DecodeError:
        return None
    if is_exact_schema(document):
        return to_schema(from_schema(schema), schema.name, notes_of(schema))
    plain = viewer_form(document)
    if plain is None or plain["type"] != "object":
        return None
    head = {key: document[key] for key in ("$schema", "title") if key in document}
    return Schema(schema.name, schema.encoding, msgspec.json.encode(head | plain))
