"""JSON Schemas as viewers read them: one type per value, nothing they would refuse."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from amberbox.core.types import Schema

_SIMPLE = {"boolean", "integer", "number", "string"}


def viewer_schema(schema: Schema | None) -> Schema | None:
    """Return a schema that Foxglove and its kin read, None where there is none to be had.

    They refuse a whole channel for one property with several types, such as ``number or null``.
    A property that cannot be said otherwise is left out: its values are in the messages anyway.
    """
    if schema is None or schema.encoding != "jsonschema":
        return schema
    try:
        document = msgspec.json.decode(schema.data)
    except msgspec.DecodeError:
        return None
    plain = _plain(document)
    if plain is None or plain.get("type") != "object":
        return None
    head = {key: document[key] for key in ("$schema", "title") if key in document}
    return Schema(schema.name, schema.encoding, msgspec.json.encode(head | plain))


def _plain(document: Any) -> dict[str, Any] | None:
    if not isinstance(document, Mapping):
        return None
    kind = _single_type(document.get("type"))
    if kind in _SIMPLE:
        encoding = document.get("contentEncoding")
        if document.get("x-also-text"):
            return None
        return {"type": kind} | ({"contentEncoding": encoding} if encoding else {})
    if kind == "object":
        return _object(document)
    return _array(document) if kind == "array" else None


def _single_type(types: Any) -> str | None:
    listed = [types] if isinstance(types, str) else list(types or ())
    kinds = [kind for kind in listed if kind != "null"]
    return kinds[0] if len(kinds) == 1 else None


def _object(document: Mapping[str, Any]) -> dict[str, Any]:
    below = {name: _plain(inner) for name, inner in document.get("properties", {}).items()}
    return {"type": "object", "properties": {n: p for n, p in below.items() if p is not None}}


def _array(document: Mapping[str, Any]) -> dict[str, Any] | None:
    items = _plain(document.get("items"))
    if items is None or items["type"] == "array" or "contentEncoding" in items:
        return None
    return {"type": "array", "items": items}
