"""Examples of what a schema describes: the same each time, and short."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_DEEPEST = 5
_KNOWN: Mapping[str, Any] = {
    "robot": "ropod_001",
    "role": "operator",
    "scopes": ["read:status"],
    "groups": ["ward"],
    "what": "there is no robot 'ropod_01'; did you mean 'ropod_001'?",
    "hint": "",
}
_PLAIN: Mapping[str, Any] = {
    "string": "...",
    "integer": 1,
    "number": 1.5,
    "boolean": True,
    "null": None,
}


def example(openapi: Mapping[str, Any], schema: Mapping[str, Any], deep: int = 0) -> Any:
    """Return a value that fits a schema of an OpenAPI document, by and large."""
    if deep > _DEEPEST:
        return "..."
    for key in ("example", "const", "default"):
        if schema.get(key) not in (None, "", []):
            return schema[key]
    if "enum" in schema:
        return schema["enum"][0]
    if "$ref" in schema:
        return example(openapi, _referred(openapi, schema["$ref"]), deep + 1)
    for key in ("anyOf", "oneOf", "allOf"):
        if schema.get(key):
            return example(openapi, schema[key][0], deep + 1)
    return _of_type(openapi, schema, deep)


def _of_type(openapi: Mapping[str, Any], schema: Mapping[str, Any], deep: int) -> Any:
    kind = schema.get("type")
    if kind == "array":
        return [example(openapi, schema.get("items", {}), deep + 1)]
    if kind == "object":
        inner = schema.get("properties", {})
        return {
            name: _KNOWN.get(name, example(openapi, form, deep + 1)) for name, form in inner.items()
        }
    return _PLAIN.get(str(kind), "...")


def _referred(openapi: Mapping[str, Any], reference: str) -> Mapping[str, Any]:
    found: Any = openapi
    for step in reference.removeprefix("#/").split("/"):
        found = found[step]
    return dict(found)
