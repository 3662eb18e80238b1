"""Find variables by the names people use: column, path, short suffix, ``ranges[17]``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from amberbox.core.errors import UsageError
from amberbox.core.types import Column

_SPLIT = re.compile(r"[/.\[\]]+")
_ELEMENT = re.compile(r"(.+)\[(-?\d+)\]")


@dataclass(frozen=True, slots=True)
class Wanted:
    """A column to show, or one element of a list column, under its output name."""

    name: str
    column: Column
    element: int | None = None


def tokens(path: str) -> tuple[str, ...]:
    """Split a path at ``/``, ``.`` and brackets."""
    return tuple(token for token in _SPLIT.split(path) if token)


def resolve(columns: Sequence[Column], names: Iterable[str], item: str) -> list[Wanted]:
    """Find each name's columns, in the order asked for; each column once.

    A name is a column, an exact path or the end of exactly one path; a path that stands for a
    structure gives all columns below it.
    """
    found: dict[str, Wanted] = {}
    for name in names:
        for wanted in _resolve_one(columns, name, item):
            found.setdefault(wanted.name, wanted)
    return list(found.values())


def _resolve_one(columns: Sequence[Column], name: str, item: str) -> list[Wanted]:
    matches = find(columns, name)
    if matches:
        return [Wanted(column.name, column) for column in matches]
    element = _ELEMENT.fullmatch(name)
    lists = find(columns, element[1]) if element else []
    if element and len(lists) == 1 and lists[0].type.startswith("list<"):
        index = int(element[2])
        return [Wanted(f"{lists[0].name}[{index}]", lists[0], index)]
    raise UsageError(f"{item} has no variable {name!r}", _suggestion(columns, name))


def find(columns: Sequence[Column], name: str) -> list[Column]:
    """Return the columns that a name stands for; none if it is unknown.

    Raises UsageError when the name fits several places.
    """
    by_name = [c for c in columns if c.name == name] or [
        c for c in columns if c.name.lower() == name.lower()
    ]
    if by_name:
        return by_name
    asked = tokens(name)
    roots = _roots(columns, asked)
    exact = roots.get(asked)
    if exact:
        return exact
    leaves = {root: found for root, found in roots.items() if tokens(found[0].path) == root}
    places = leaves or roots
    if len(places) > 1:
        options = " or ".join("/".join(root) for root in list(places)[:4])
        raise UsageError(f"{name!r} is ambiguous: {options}", "name more of the path")
    return next(iter(places.values()), [])


def _roots(
    columns: Sequence[Column], asked: tuple[str, ...]
) -> dict[tuple[str, ...], list[Column]]:
    """Group columns by the place in the message at which the name asked for ends."""
    roots: dict[tuple[str, ...], list[Column]] = {}
    for column in columns if asked else ():
        path = tokens(column.path)
        for end in range(len(asked), len(path) + 1):
            if path[end - len(asked) : end] == asked:
                roots.setdefault(path[:end], []).append(column)
    return roots


def _suggestion(columns: Sequence[Column], name: str) -> str:
    names = [c.name for c in columns]
    candidates = {c.path: c.path for c in columns} | {c.name: c.path for c in columns}
    candidates |= {"/".join(tokens(c.path)[-2:]): c.path for c in columns}
    close = difflib.get_close_matches(name, candidates, n=3, cutoff=0.5)
    if close:
        return "did you mean " + " or ".join(dict.fromkeys(candidates[c] for c in close)) + "?"
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return f"it has {shown}" if names else "it has no variables"


def select(columns: Sequence[Column], names: Sequence[str]) -> list[Column]:
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
        pattern = "/".join(tokens(name))
        return [c for c in columns if fnmatchcase(c.name, name) or _fits(c.path, pattern)]
    by_name = [c for c in columns if c.name == name]
    roots = _roots(columns, tokens(name))
    exact = by_name or roots.get(tokens(name))
    return exact or [column for found in roots.values() for column in found]


def _fits(path: str, pattern: str) -> bool:
    text = "/".join(tokens(path))
    return fnmatchcase(text, pattern) or fnmatchcase(text, f"*/{pattern}")


def closest(name: str, known: Sequence[str]) -> str:
    """Return the known names as a hint, the ones most like ``name`` first."""
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.6)
    close += [other for other in known if name in other and other not in close][:3]
    shown = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
    listing = f"there are: {shown}" if known else "nothing has been recorded yet"
    return f"did you mean {' or '.join(close)}? {listing}" if close else listing
