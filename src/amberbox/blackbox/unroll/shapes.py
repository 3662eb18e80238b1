"""What a JSON or MessagePack topic has said so far: the kinds of value seen at each place.

Observing only ever adds kinds, so the shape in the end does not depend on the order of messages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

MOST_PROPERTIES = 256
DEEPEST = 16
"""Objects with more keys, and values nested deeper, are kept as JSON text in one column."""

MOST_COLUMNS = 4096
"""A message with more places has the objects in it kept as text, the deepest ones first."""

_INT64 = range(-(2**63), 2**63)
_UNNAMEABLE = re.compile(r'["\\\x00-\x1f\ud800-\udfff]')


@dataclass(slots=True)
class Shape:
    """Kinds seen at one place, with the shapes below it.

    ``kinds`` holds JSON's types and ``binary``. ``number`` covers ``integer``. An ``open`` shape
    does not look further down, nor does a list without ``items``. A ``closed`` one takes no
    further properties: their values stay in the message alone. ``names`` is used where a table
    begins.
    """

    kinds: set[str] = field(default_factory=set)
    properties: dict[str, Shape] = field(default_factory=dict)
    items: Shape | None = None
    open: bool = False
    closed: bool = False
    names: list[str] = field(default_factory=list)
    letters: bool = False
    """At the top: whether columns are named in Latin letters."""

    def values(self) -> set[str]:
        """Give the kinds without null."""
        return self.kinds - {"null"}


def nullable() -> Shape:
    """Make the shape of a place that may always be missing: the top, or a property."""
    return Shape({"null"})


def close(shape: Shape) -> None:
    """Let no object that has properties get more: its keys are data, such as ids."""
    shape.closed = shape.closed or bool(shape.properties)
    for inner in (*shape.properties.values(), *([shape.items] if shape.items else ())):
        close(inner)


def limit(shape: Shape) -> None:
    """Keep objects as text, the deepest first, until there are ``MOST_COLUMNS`` places at most."""
    depth = DEEPEST
    while depth and _count(shape) > MOST_COLUMNS:
        _open_below(shape, depth)
        depth -= 1


def _count(shape: Shape) -> int:
    inner = (*shape.properties.values(), *([shape.items] if shape.items else ()))
    return 1 + sum(map(_count, inner))


def _open_below(shape: Shape, depth: int) -> None:
    if not depth:
        shape.open = shape.open or bool(shape.properties) or shape.items is not None
        shape.properties, shape.items, shape.closed = {}, None, False
        return
    for inner in (*shape.properties.values(), *([shape.items] if shape.items else ())):
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
            shape.properties[key] = nullable()
        if depth >= DEEPEST or len(shape.properties) > MOST_PROPERTIES or not is_nameable(key):
            shape.open, shape.closed = True, False
            shape.properties, shape.items = {}, None
            return
        observe(shape.properties[key], item, depth + 1)


def is_nameable(key: str) -> bool:
    """Tell whether a property can become a column: one with quotes or control characters cannot.

    The decoder that is made for a shape refuses them; such an object is kept as text.
    """
    return not _UNNAMEABLE.search(key)


def _observe_array(shape: Shape, value: list[Any], depth: int) -> None:
    shape.items = shape.items or Shape()
    shape.items.open = shape.items.open or depth >= DEEPEST
    for item in value:
        # lists in lists become text as a whole: what is in them does not matter
        if isinstance(item, list):
            shape.items.kinds.add("array")
        else:
            observe(shape.items, item, depth + 1)


def column_kind(shape: Shape) -> str:
    """Decide what a place becomes: a column type, ``nested``, ``children``, or '' for nothing.

    Columns of mixed kinds are ``text``: strings as they are, everything else as JSON.
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
    """Write a key as part of a path, as JSON pointers do; an empty one as ``~2``."""
    return key.replace("~", "~0").replace("/", "~1") or "~2"


def places(shape: Shape, path: str = "") -> Iterator[tuple[str, Shape, str]]:
    """List path, shape and kind of the columns and child tables of a table, in schema order.

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
