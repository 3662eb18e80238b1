"""Resolve the names of items and variables: column, path, end of a path, ``ranges[17]``, ``*``.

Recorder (``select_columns``), queries (``resolve_columns``, ``configured_columns``) and monitors
(``find_addresses``) follow rules of their own on the same paths.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal, NamedTuple

from amberbox.core.errors import UsageError
from amberbox.core.names import child_name, identifier
from amberbox.core.types import Column, ItemSchema

_INDEX = re.compile(r"\[(\d+)\]")


def select_columns(
    schema: ItemSchema, patterns: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Select columns and child tables; also return the entries that match nothing.

    An entry (with ``/``, ``.`` or ``[3]`` between its parts) selects the path or column of exactly
    that name, else every path that ends in it, with all below. No entries select everything. The
    result is in schema order: names of columns, then paths of child tables.
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
    """Return each path with an empty text, and each child table with every path in it."""
    inside = [(path, below) for path, child in schema.children.items() for below in _paths(child)]
    return [(path, "") for path in everything] + inside


def _paths(schema: ItemSchema) -> list[str]:
    own = [column.path for column in schema.columns]
    return own + [
        f"{path}/{below}" for path, child in schema.children.items() for below in _paths(child)
    ]


_SPLIT = re.compile(r"[/.\[\]]+")
_ELEMENT = re.compile(r"(.+)\[(-?\d+)\]")


@dataclass(frozen=True, slots=True)
class SelectedColumn:
    """A column to show, or one element of a list column, under its output name."""

    name: str
    column: Column
    element: int | None = None


def path_tokens(path: str) -> tuple[str, ...]:
    """Split a path at ``/``, ``.`` and brackets."""
    return tuple(token for token in _SPLIT.split(path) if token)


def resolve_columns(
    columns: Sequence[Column], names: Iterable[str], item: str
) -> list[SelectedColumn]:
    """Return the columns of each name, in the order of the names; each column once.

    A name is a column, an exact path or the end of exactly one path; the path of a structure
    selects all columns below it.
    """
    found: dict[str, SelectedColumn] = {}
    for name in names:
        for wanted in _resolve_one(columns, name, item):
            found.setdefault(wanted.name, wanted)
    return list(found.values())


def _resolve_one(columns: Sequence[Column], name: str, item: str) -> list[SelectedColumn]:
    matches = find_columns(columns, name)
    if matches:
        return [SelectedColumn(column.name, column) for column in matches]
    element = _ELEMENT.fullmatch(name)
    lists = find_columns(columns, element[1]) if element else []
    if element and len(lists) == 1 and lists[0].type.startswith("list<"):
        index = int(element[2])
        return [SelectedColumn(f"{lists[0].name}[{index}]", lists[0], index)]
    raise UsageError(f"{item} has no variable {name!r}", _suggestion(columns, name))


def find_columns(columns: Sequence[Column], name: str) -> list[Column]:
    """Return the columns that a name matches; none if it is unknown.

    Raises UsageError when the name fits several places.
    """
    by_name = [c for c in columns if c.name == name] or [
        c for c in columns if c.name.lower() == name.lower()
    ]
    if by_name:
        return by_name
    asked = path_tokens(name)
    roots = _roots(columns, asked)
    exact = roots.get(asked)
    if exact:
        return exact
    leaves = {root: found for root, found in roots.items() if path_tokens(found[0].path) == root}
    places = leaves or roots
    if len(places) > 1:
        options = " or ".join("/".join(root) for root in list(places)[:4])
        raise UsageError(f"{name!r} is ambiguous: {options}", "name more of the path")
    return next(iter(places.values()), [])


def _roots(
    columns: Sequence[Column], asked: tuple[str, ...]
) -> dict[tuple[str, ...], list[Column]]:
    """Group columns by the path in the message at which the requested name ends."""
    roots: dict[tuple[str, ...], list[Column]] = {}
    for column in columns if asked else ():
        path = path_tokens(column.path)
        for end in range(len(asked), len(path) + 1):
            if path[end - len(asked) : end] == asked:
                roots.setdefault(path[:end], []).append(column)
    return roots


def _suggestion(columns: Sequence[Column], name: str) -> str:
    names = [c.name for c in columns]
    candidates = {c.path: c.path for c in columns} | {c.name: c.path for c in columns}
    candidates |= {"/".join(path_tokens(c.path)[-2:]): c.path for c in columns}
    close = difflib.get_close_matches(name, candidates, n=3, cutoff=0.5)
    if close:
        return "did you mean " + " or ".join(dict.fromkeys(candidates[c] for c in close)) + "?"
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return f"it has {shown}" if names else "it has no variables"


def configured_columns(columns: Sequence[Column], names: Sequence[str]) -> list[Column]:
    """Apply an item's configured ``variable_names``: all when empty.

    An entry is a column, an exact path, else every path ending in it, structures included; it
    may hold ``*`` and ``?``.
    """
    if not names:
        return list(columns)
    chosen: dict[str, Column] = {}
    for name in names:
        for column in _selected(columns, name):
            chosen.setdefault(column.name, column)
    return list(chosen.values())


def _selected(columns: Sequence[Column], name: str) -> list[Column]:
    if any(mark in name for mark in "*?"):
        pattern = "/".join(path_tokens(name))
        return [c for c in columns if fnmatchcase(c.name, name) or _fits(c.path, pattern)]
    by_name = [c for c in columns if c.name == name]
    roots = _roots(columns, path_tokens(name))
    exact = by_name or roots.get(path_tokens(name))
    return exact or [column for found in roots.values() for column in found]


def _fits(path: str, pattern: str) -> bool:
    text = "/".join(path_tokens(path))
    return fnmatchcase(text, pattern) or fnmatchcase(text, f"*/{pattern}")


def suggest_names(name: str, known: Sequence[str]) -> str:
    """Return a hint with the known names, those most similar to ``name`` first."""
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.6)
    close += [other for other in known if name in other and other not in close][:3]
    shown = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
    listing = f"there are: {shown}" if known else "nothing has been recorded yet"
    return f"did you mean {' or '.join(close)}? {listing}" if close else listing


def item_named(known: Collection[str], name: str) -> str | None:
    """Return the item of a name, else the first that differs in case only, else None."""
    folded = name.casefold()
    return name if name in known else next((k for k in known if k.casefold() == folded), None)


class ColumnAddress(NamedTuple):
    """A column of an item or of its child table.

    ``number`` is the element of a list column, or the row of a child table.
    """

    item: str
    variable: str
    number: int | None = None
    kind: Literal["variable", "list"] = "variable"

    @property
    def address(self) -> str:
        """Return the address as text."""
        return f"{self.item}.{self.variable}" + ("" if self.number is None else f"[{self.number}]")


def find_addresses(schema: ItemSchema, item: str, text: str) -> list[ColumnAddress]:
    """Return the addresses that a name matches; several if it is ambiguous, else one or none.

    A name matches a column, else an exact path, else every path with this ending. A number is an
    element of a list or a row of a child table; ``*`` matches any part of a path.
    """
    named = [column for column in schema.columns if column.name == text]
    if named:
        return [_place(item, named[0])]
    asked = path_tokens(text)
    everything = list(_places(schema, item))
    exact = _matching(everything, asked, whole=True)
    return exact or _matching(everything, asked, whole=False)


def names_of(schema: ItemSchema) -> list[str]:
    """Return the columns of an item, and the paths of its child tables."""
    return [column.name for column in schema.columns] + [
        f"{path}/0/{name}" for path, child in schema.children.items() for name in names_of(child)
    ]


def tables_of(item: str, schema: ItemSchema) -> dict[str, ItemSchema]:
    """Return the child tables of an item by name, those of its child tables too."""
    found: dict[str, ItemSchema] = {}
    for path, child in schema.children.items():
        name = child_name(item, path)
        found |= {name: child, **tables_of(name, child)}
    return found


def guessed_column(item: str, text: str) -> ColumnAddress:
    """Return the most likely address of a name of an item without a known schema.

    A number within a path is a row of a child table: messages hold lists of structures.
    """
    parts = path_tokens(text)
    row = next((place for place, part in enumerate(parts) if part.isdigit()), 0)
    if 0 < row < len(parts) - 1:
        table = child_name(item, "_".join(parts[:row]))
        return ColumnAddress(table, identifier("_".join(parts[row + 1 :])), int(parts[row]))
    path, bracket, number = text.strip("./").partition("[")
    index = int(number[:-1]) if bracket and number[:-1].isdigit() else None
    rest = "" if index is not None or not bracket else f"_{number[:-1]}"
    return ColumnAddress(item, identifier("_".join(path_tokens(path)) + rest), index)


class _Candidate(NamedTuple):
    path: tuple[str, ...]
    place: ColumnAddress
    rows: int | None
    """Position of the row number of a child table in the path."""


def _places(schema: ItemSchema, item: str) -> Iterator[_Candidate]:
    for column in schema.columns:
        yield _Candidate(path_tokens(column.path), _place(item, column), None)
    for path, child in schema.children.items():
        above = path_tokens(path)
        for column in child.columns:
            place = _place(child_name(item, path), column)
            yield _Candidate((*above, "", *path_tokens(column.path)), place, len(above))


def _place(item: str, column: Column) -> ColumnAddress:
    kind: Literal["variable", "list"] = "list" if column.type.startswith("list<") else "variable"
    return ColumnAddress(item, column.name, None, kind)


def _matching(
    all_: Sequence[_Candidate], asked: tuple[str, ...], whole: bool
) -> list[ColumnAddress]:
    found = (_match(candidate, asked, whole) for candidate in all_)
    return [place for place in found if place is not None]


def _match(candidate: _Candidate, asked: tuple[str, ...], whole: bool) -> ColumnAddress | None:
    """Compare the path with the end of a candidate, or if ``whole`` with all of it."""
    path, place, rows = candidate
    if rows is not None:
        start = len(path) - len(asked)
        if start < 0 or (whole and start > 0) or start > rows:
            return None
        row = asked[rows - start]
        parts = zip(asked, path[start:], strict=True)
        others = [part for n, part in enumerate(parts) if n != rows - start]
        if not row.isdigit() or not all(fnmatchcase(b, a) for a, b in others):
            return None
        return ColumnAddress(place.item, place.variable, int(row), place.kind)
    if _ends(path, asked, whole):
        return place
    is_element = place.kind == "list" and len(asked) > 1 and asked[-1].isdigit()
    if is_element and _ends(path, asked[:-1], whole):
        return ColumnAddress(place.item, place.variable, int(asked[-1]))
    return None


def _ends(path: tuple[str, ...], asked: tuple[str, ...], whole: bool) -> bool:
    if len(asked) > len(path) or (whole and len(asked) != len(path)) or not asked:
        return False
    end = path[len(path) - len(asked) :]
    return all(fnmatchcase(there, wanted) for wanted, there in zip(asked, end, strict=True))


def is_same_or_below(name: str, entry: str) -> bool:
    """Return whether a name is a configured entry, ends with it, or is below it.

    Used for items of which only the configured entries are known.
    """
    flat, wanted = "_".join(path_tokens(entry)), "_".join(path_tokens(name))
    return (
        flat == wanted
        or flat.endswith(f"_{wanted}")
        or wanted.startswith(f"{flat}_")
        or wanted.endswith(f"_{flat}")
        or f"_{flat}_" in wanted
    )
