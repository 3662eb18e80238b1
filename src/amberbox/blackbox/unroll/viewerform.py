"""The part of JSON Schema that viewers take: one type per value, nothing they would refuse."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ALSO_TEXT = "x-also-text"
"""Keyword beside ``contentEncoding``: some of the values are plain text."""

_SIMPLE = {"boolean", "integer", "number", "string"}


def viewer_form(document: Any) -> dict[str, Any] | None:
    """Simplify a JSON Schema until Foxglove and its kin take it, None where that cannot be.

    They refuse a whole channel for one property with several types, such as ``number or null``,
    but do not mind a null where they expect a number. A property that cannot be said otherwise
    is left out: its values are in the messages anyway.
    """
    if not isinstance(document, Mapping):
        return None
    kind = _single_type(document)
    if kind in _SIMPLE:
        encoding = document.get("contentEncoding")
        if document.get(ALSO_TEXT):
            return None
        return {"type": kind} | ({"contentEncoding": encoding} if encoding else {})
    if kind == "object":
        return _object(document)
    return _array(document) if kind == "array" else None


def _types(document: Mapping[str, Any]) -> list[Any]:
    types = document.get("type")
    return [types] if isinstance(types, str) else list(types or ())


def _single_type(document: Mapping[str, Any]) -> str | None:
    kinds = [kind for kind in _types(document) if kind != "null"]
    return kinds[0] if len(kinds) == 1 else None


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
