"""Shapes of JSON and MessagePack topics written as JSON Schema (draft 2020-12), and read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from amberbox.blackbox.unroll.notes import Notes, notes_json
from amberbox.blackbox.unroll.shapes import Shape, is_nameable, nullable, places
from amberbox.blackbox.unroll.viewerform import ALSO_TEXT, viewer_form
from amberbox.core.names import identifier, readable
from amberbox.core.types import Schema

NAMES = "x-columns"
"""Keyword for the paths of a table's columns in the order they were first seen, where the
properties alone do not tell: names are given in that order and never change."""

SHAPE = "x-shape"
"""Keyword for all kinds of value that were seen, where the plain types do not tell. What viewers
take has no way to say "number or text"; whether a value may be missing or null goes unsaid,
because the root and every property may."""

LETTERS = "x-letters"
"""Keyword of a document whose columns are named in Latin letters where paths are of other scripts;
without it everything but ASCII is ``_`` in a name."""

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
OURS = "every message fits: amberbox"
"""Comment of documents that promise the columns of their messages, as those of others may not."""
_ORDER = ("array", "boolean", "integer", "number", "object", "string", "null")


def to_schema(shape: Shape, name: str, notes: Notes | None = None) -> Schema:
    """Write a shape as a JSON Schema document that viewers take, with notes on its places."""
    document = {"$schema": _DRAFT, "$comment": OURS, "title": name}
    document |= _for_viewers(shape) | notes_json(notes or {})
    if shape.letters and _has_other_letters(shape):
        document[LETTERS] = "latin"
    return Schema(name, "jsonschema", msgspec.json.encode(document))


def _has_other_letters(table: Shape) -> bool:
    """Tell whether any column has another name in Latin letters."""
    for path, shape, kind in places(table):
        if kind == "children" and shape.items is not None:
            if _has_other_letters(shape.items):
                return True
        elif readable(path) != identifier(path):
            return True
    return False


def _for_viewers(shape: Shape) -> dict[str, Any]:
    full = _to_json(shape, table=True)
    plain = viewer_form(full)
    if plain is None or plain["type"] != "object":  # they ask for an object, whatever comes
        plain = {"type": "object", "properties": {}}
    tells_all = _to_json(_nullable(plain, table=True), table=True) == full
    return plain if tells_all else plain | {SHAPE: full}


def _to_json(shape: Shape, table: bool = False) -> dict[str, Any]:
    types = {kind if kind != "binary" else "string" for kind in shape.kinds}
    document: dict[str, Any] = {"type": [kind for kind in _ORDER if kind in types]}
    if "binary" in shape.kinds:
        document["contentEncoding"] = "base64"
        if "string" in shape.kinds:
            document[ALSO_TEXT] = True
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
        document[NAMES] = shape.names
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
        return nullable()
    if not is_ours(document):
        return nullable()
    shape = _nullable(document.get(SHAPE, document), table=True)
    shape.letters = document.get(LETTERS) == "latin"
    return shape


def is_ours(document: Any) -> bool:
    """Tell the documents that ``to_schema`` wrote, and those of the box's own channels."""
    return isinstance(document, dict) and document.get("$comment") == OURS


def _from_json(document: Mapping[str, Any], table: bool = False) -> Shape:
    types = document.get("type", [])
    shape = Shape({types} if isinstance(types, str) else set(types))
    if "contentEncoding" in document:
        shape.kinds.add("binary")
        if not document.get(ALSO_TEXT):
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
        shape.names = list(document.get(NAMES) or _natural_names(shape))
    return shape


def _nullable(document: Mapping[str, Any], table: bool = False) -> Shape:
    shape = _from_json(document, table)
    shape.kinds.add("null")
    return shape
