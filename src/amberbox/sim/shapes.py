"""How the shape of a message is written down: JSON Schema with units, built from short words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Shape = dict[str, Any]


def _unit(shape: Shape, unit: str) -> Shape:
    return {**shape, "unit": unit} if unit else shape


def number(unit: str = "") -> Shape:
    """A floating-point number, also where its value happens to be whole."""
    return _unit({"type": "number"}, unit)


def integer(unit: str = "") -> Shape:
    """A whole number."""
    return _unit({"type": "integer"}, unit)


def code(names: Mapping[int, str]) -> Shape:
    """A whole number whose values have names."""
    return {"type": "integer", "labels": {str(value): name for value, name in names.items()}}


def text() -> Shape:
    """A string."""
    return {"type": "string"}


def flag() -> Shape:
    """True or false."""
    return {"type": "boolean"}


def numbers(unit: str = "", count: int | None = None) -> Shape:
    """A list of numbers; of always the same length when ``count`` is given."""
    shape: Shape = {"type": "array", "items": number(unit)}
    return shape if count is None else {**shape, "minItems": count, "maxItems": count}


def record(**fields: Shape) -> Shape:
    """A structure in which every field is always there."""
    return {
        "type": "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }


def xyz(unit: str) -> Shape:
    """A vector."""
    return record(x=number(unit), y=number(unit), z=number(unit))


def pose() -> Shape:
    """A position and an orientation (quaternion)."""
    turn = record(x=number(), y=number(), z=number(), w=number())
    return record(position=xyz("m"), orientation=turn)


def header() -> Shape:
    """The header that every message has: own stamp, frame and a count without holes."""
    stamp = record(sec=integer("s"), nanosec=integer("ns"))
    return record(seq=integer(), stamp=stamp, frame_id=text())


def leaves(shape: Mapping[str, Any], path: str = "") -> list[tuple[str, str, str]]:
    """List the leaves of a shape as (path, type, unit)."""
    if shape["type"] == "object":
        below = shape["properties"].items()
        return [leaf for key, value in below for leaf in leaves(value, f"{path}.{key}".lstrip("."))]
    if shape["type"] == "array":
        size = shape.get("maxItems", "")
        kind = f"{shape['items']['type']}[{size}]"
        return [(path, kind, shape["items"].get("unit", ""))]
    named = ", ".join(f"{value} {name}" for value, name in shape.get("labels", {}).items())
    return [(path, f"{shape['type']} ({named})" if named else shape["type"], shape.get("unit", ""))]
