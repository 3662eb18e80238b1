"""Which variables of a data item a change filter looks at, and the dead band of each."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.unroll.select import select
from amberbox.core.source import ChangeOptions
from amberbox.core.types import Column, ItemSchema

NUMBERS = ("int", "uint", "float")
TIMES = {"time": 1e9, "duration": 1e9}
"""Dead bands of these are given in seconds, their values are nanoseconds."""

HEADER_FIELDS = ("header/stamp", "header/seq")
"""What a header counts up by itself, wherever in the message it stands."""


@dataclass(frozen=True, slots=True)
class Band:
    """The dead band of one variable: zero when any difference is a change."""

    absolute: float = 0.0
    relative: float = 0.0

    def __bool__(self) -> bool:
        return self.absolute > 0 or self.relative > 0


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """The dead bands of some variables, side by side."""

    absolute: NDArray[np.float64]
    relative: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Group:
    """Columns that can be compared at once: of one type, all with a dead band or all without."""

    names: tuple[str, ...]
    bands: Bands | None
    is_list: bool = False


@dataclass(frozen=True, slots=True)
class Watched:
    """The columns of one table to look at, and its child tables; a list column is a group."""

    groups: tuple[Group, ...]
    children: Mapping[str, Watched]


@dataclass(frozen=True, slots=True)
class _Place:
    """A column of a table; ``table`` is the path of child tables down to it."""

    table: tuple[str, ...]
    column: Column
    is_stamp: bool

    @property
    def path(self) -> str:
        return "/".join([*self.table, self.column.path])

    @property
    def element(self) -> str:
        return self.column.type.removeprefix("list<").removesuffix(">")


def watched(schema: ItemSchema, options: ChangeOptions) -> tuple[Watched, tuple[str, ...]]:
    """Return what to look at, and those names of ``options`` that fit no variable.

    Without ``options.variables`` everything is looked at except the message's own time stamp and
    what headers count up (``header/stamp``, ``header/seq``); so too when none of its names fits,
    as a misspelt name must not throw everything away. A name, or a band, brings these in as well.
    """
    places = {place.path: place for place in _places(schema)}
    named, unknown = _select(places, options.variables) if options.variables else ((), ())
    watch = named or [path for path, place in places.items() if not place.is_stamp]
    general = {path: _general(places[path], options) for path in watch}
    bands, unfit = _own_bands(places, options.bands)
    return _tree(places, general | bands, ()), (*unknown, *unfit)


def _places(schema: ItemSchema, table: tuple[str, ...] = ()) -> Iterator[_Place]:
    for column in schema.columns:
        yield _Place(table, column, _is_stamp(column.path, schema.stamp))
    for path, child in schema.children.items():
        yield from _places(child, (*table, path))


def _is_stamp(path: str, stamp: str) -> bool:
    own = bool(stamp) and (path == stamp or path.startswith(f"{stamp}/"))
    return own or any(f"/{path}/".find(f"/{field}/") >= 0 for field in HEADER_FIELDS)


def _select(
    places: Mapping[str, _Place], patterns: Sequence[str]
) -> tuple[Sequence[str], Sequence[str]]:
    """Find paths by the rule for ``variable_names``, across child tables too."""
    columns = tuple(
        # Names are unique within one table only; paths are unique altogether.
        replace(place.column, name=path if place.table else place.column.name, path=path)
        for path, place in places.items()
    )
    by_name = {column.name: column.path for column in columns}
    names, unmatched = select(ItemSchema("", columns), tuple(patterns))
    return [by_name[name] for name in names], unmatched


def _general(place: _Place, options: ChangeOptions) -> Band:
    if not _has_band(place):
        return Band()
    return Band(options.absolute * TIMES.get(place.element, 1.0), options.relative)


def _has_band(place: _Place) -> bool:
    return place.element in TIMES or place.element.startswith(NUMBERS)


def _own_bands(
    places: Mapping[str, _Place], bands: Mapping[str, float]
) -> tuple[dict[str, Band], list[str]]:
    """Return the bands given by name, and the names that fit no variable that is a number."""
    found: dict[str, Band] = {}
    unfit = []
    for pattern, width in bands.items():
        paths = [path for path in _select(places, [pattern])[0] if _has_band(places[path])]
        found |= {path: Band(width * TIMES.get(places[path].element, 1.0)) for path in paths}
        unfit += [] if paths else [pattern]
    return found, unfit


def _tree(
    places: Mapping[str, _Place], bands: Mapping[str, Band], table: tuple[str, ...]
) -> Watched:
    here = [path for path in bands if places[path].table == table]
    below = _next_tables((places[path].table for path in bands), table)
    return Watched(
        tuple(_groups([places[path].column for path in here], [bands[path] for path in here])),
        {path: _tree(places, bands, (*table, path)) for path in below},
    )


def _groups(columns: Sequence[Column], bands: Sequence[Band]) -> Iterator[Group]:
    alike: dict[tuple[str, bool, str], list[tuple[str, Band]]] = {}
    for column, band in zip(columns, bands, strict=True):
        is_list = column.type.startswith("list<")
        key = (column.type, bool(band), column.name if is_list else "")
        alike.setdefault(key, []).append((column.name, band))
    for (_, has_band, list_name), members in alike.items():
        names = tuple(name for name, _ in members)
        side_by_side = _side_by_side([band for _, band in members]) if has_band else None
        yield Group(names, side_by_side, bool(list_name))


def _side_by_side(bands: Sequence[Band]) -> Bands:
    return Bands(
        np.array([band.absolute for band in bands]), np.array([band.relative for band in bands])
    )


def _next_tables(tables: Iterator[tuple[str, ...]], table: tuple[str, ...]) -> Collection[str]:
    depth = len(table)
    inner = (other[depth] for other in tables if len(other) > depth and other[:depth] == table)
    return dict.fromkeys(inner)
