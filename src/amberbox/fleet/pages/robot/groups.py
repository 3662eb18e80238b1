"""Components that are alike, side by side: all wheels of a robot, all its lasers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from amberbox.fleet.state.views import Component, Output

COLUMNS = 3
"""Outputs that are compared; the tree has all of them."""
_FEW = 2
_FIRST = re.compile(r"[^\W\d_]+")

Key = tuple[str, str]
"""Mode and output."""


@dataclass(frozen=True, slots=True)
class Member:
    """One of those that are alike; ``rest`` is what its name has beyond that of the group."""

    component: Component
    rest: str
    outputs: Mapping[Key, Output]


@dataclass(frozen=True, slots=True)
class Group:
    """Components of one name that have outputs in common."""

    name: str
    columns: Sequence[Key]
    members: Sequence[Member]


def groups(components: Sequence[Component]) -> list[Group]:
    """Return groups of at least two components that begin with one word and share outputs."""
    by_word: dict[str, list[Component]] = {}
    for component in components:
        if found := _FIRST.match(component.component):
            by_word.setdefault(found[0], []).append(component)
    return [
        Group(word, columns, [_member(word, one) for one in found])
        for word, found in by_word.items()
        if len(found) >= _FEW and (columns := _common(found))
    ]


def _common(components: Sequence[Component]) -> list[Key]:
    """Return the outputs that all have, numbers first: they are what one compares."""
    every = [set(_outputs(one)) for one in components]
    known = _outputs(components[0])
    shared = [key for key in known if all(key in keys for keys in every)]
    shared.sort(key=lambda key: known[key].type not in ("float", "int"))
    return shared[:COLUMNS]


def _member(word: str, component: Component) -> Member:
    rest = component.component.removeprefix(word).strip("_-. ").replace("_", " ")
    return Member(component, rest or component.component, _outputs(component))


def _outputs(component: Component) -> dict[Key, Output]:
    return dict(_each(component))


def _each(component: Component) -> Iterator[tuple[Key, Output]]:
    for mode in component.modes:
        yield from (((mode.mode, output.name), output) for output in mode.outputs)
