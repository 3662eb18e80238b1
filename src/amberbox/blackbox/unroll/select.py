"""Which columns a list of variable names means: full paths, endings of paths, column names."""

from __future__ import annotations

import re
from collections.abc import Sequence

from amberbox.core.types import ItemSchema

_INDEX = re.compile(r"\[(\d+)\]")


def select(
    schema: ItemSchema, patterns: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Choose columns and child tables; also return the entries that match nothing.

    An entry (with ``/``, ``.`` or ``[3]`` between its parts) means the path or column of exactly
    that name, else every path that ends in it; what lies below is included. No entries mean
    everything. The result is in schema order: names of columns, then paths of child tables.
    """
    places = {column.path: column.name for column in schema.columns}
    everything = {**places, **{path: path for path in schema.children}}
    if not patterns:
        return tuple(everything.values()), ()
    matches = {pattern: _matches(everything, schema, pattern) for pattern in patterns}
    chosen = {path for paths in matches.values() for path in paths}
    names = tuple(name for path, name in everything.items() if path in chosen)
    return names, tuple(pattern for pattern, paths in matches.items() if not paths)


def _matches(everything: dict[str, str], schema: ItemSchema, pattern: str) -> set[str]:
    wanted = _INDEX.sub(r"/\1", pattern).replace(".", "/").strip("/")
    if not wanted:
        return set()
    exact = {path for path in everything if path == wanted or path.startswith(f"{wanted}/")}
    named = {column.path for column in schema.columns if column.name == pattern}
    return exact | named or {
        path
        for path, child in _with_children(everything, schema)
        if f"/{wanted}/" in f"/{path}/{child}/"
    }


def _with_children(everything: dict[str, str], schema: ItemSchema) -> list[tuple[str, str]]:
    """Pair each path with nothing, and each child table with every path in it."""
    inside = [(path, below) for path, child in schema.children.items() for below in _paths(child)]
    return [(path, "") for path in everything] + inside


def _paths(schema: ItemSchema) -> list[str]:
    own = [column.path for column in schema.columns]
    return own + [
        f"{path}/{below}" for path, child in schema.children.items() for below in _paths(child)
    ]
