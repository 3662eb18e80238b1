"""Variables by the names that people write: column, path, the end of a path, elements of lists."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Literal, NamedTuple

from amberbox.core.names import child_name, identifier
from amberbox.core.types import Column, ItemSchema

_SPLIT = re.compile(r"[/.\[\]]+")


class Place(NamedTuple):
    """A column of an item or of its child table.

    ``number`` is the element of a list column, or the row of a child table.
    """

    item: str
    variable: str
    number: int | None = None
    kind: Literal["variable", "list"] = "variable"

    @property
    def address(self) -> str:
        """How it is written."""
        return f"{self.item}.{self.variable}" + ("" if self.number is None else f"[{self.number}]")


def tokens(text: str) -> tuple[str, ...]:
    """Split a path at ``/``, ``.`` and brackets."""
    return tuple(token for token in _SPLIT.split(text) if token)


def find_places(schema: ItemSchema, item: str, text: str) -> list[Place]:
    """Return what a name stands for; several if it is ambiguous, none if it is unknown.

    A column, else an exact path, else every path that ends so. A number is an element of a list
    or a row of a child table; ``*`` stands for any part of a path.
    """
    named = [column for column in schema.columns if column.name == text]
    if named:
        return [_place(item, named[0])]
    asked = tokens(text)
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


def guessed(item: str, text: str) -> Place:
    """Return what a name most likely stands for where nothing is known of the item.

    A number within a path is a row of a child table: messages hold lists of structures.
    """
    parts = tokens(text)
    row = next((place for place, part in enumerate(parts) if part.isdigit()), 0)
    if 0 < row < len(parts) - 1:
        table = child_name(item, "_".join(parts[:row]))
        return Place(table, identifier("_".join(parts[row + 1 :])), int(parts[row]))
    path, bracket, number = text.strip("./").partition("[")
    index = int(number[:-1]) if bracket and number[:-1].isdigit() else None
    rest = "" if index is not None or not bracket else f"_{number[:-1]}"
    return Place(item, identifier("_".join(tokens(path)) + rest), index)


class _Candidate(NamedTuple):
    path: tuple[str, ...]
    place: Place
    rows: int | None
    """Where in the path the row of a child table stands."""


def _places(schema: ItemSchema, item: str) -> Iterator[_Candidate]:
    for column in schema.columns:
        yield _Candidate(tokens(column.path), _place(item, column), None)
    for path, child in schema.children.items():
        above = tokens(path)
        for column in child.columns:
            place = _place(child_name(item, path), column)
            yield _Candidate((*above, "", *tokens(column.path)), place, len(above))


def _place(item: str, column: Column) -> Place:
    kind: Literal["variable", "list"] = "list" if column.type.startswith("list<") else "variable"
    return Place(item, column.name, None, kind)


def _matching(all_: Sequence[_Candidate], asked: tuple[str, ...], whole: bool) -> list[Place]:
    found = (_match(candidate, asked, whole) for candidate in all_)
    return [place for place in found if place is not None]


def _match(candidate: _Candidate, asked: tuple[str, ...], whole: bool) -> Place | None:
    """Compare the asked path with a candidate's end, or with all of it."""
    place, path = candidate.place, candidate.path
    if candidate.rows is not None:
        return _match_row(candidate, asked, whole)
    if _ends(path, asked, whole):
        return place
    is_element = place.kind == "list" and len(asked) > 1 and asked[-1].isdigit()
    if is_element and _ends(path, asked[:-1], whole):
        return Place(place.item, place.variable, int(asked[-1]))
    return None


def _match_row(candidate: _Candidate, asked: tuple[str, ...], whole: bool) -> Place | None:
    path, rows = candidate.path, candidate.rows
    start = len(path) - len(asked)
    assert rows is not None, "only candidates of child tables come here"
    if start < 0 or (whole and start > 0) or start > rows:
        return None
    row = asked[rows - start]
    parts = zip(asked, path[start:], strict=True)
    others = [part for n, part in enumerate(parts) if n != rows - start]
    if not row.isdigit() or not all(fnmatchcase(b, a) for a, b in others):
        return None
    place = candidate.place
    return Place(place.item, place.variable, int(row), place.kind)


def _ends(path: tuple[str, ...], asked: tuple[str, ...], whole: bool) -> bool:
    if len(asked) > len(path) or (whole and len(asked) != len(path)) or not asked:
        return False
    end = path[len(path) - len(asked) :]
    return all(fnmatchcase(there, wanted) for wanted, there in zip(asked, end, strict=True))
