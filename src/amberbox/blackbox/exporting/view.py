"""What is taken out of a record: which items, which variables, from when to when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.catalogue import Catalogue
from amberbox.blackbox.query.record import By
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.core.errors import UsageError

Window: TypeAlias = tuple[int | None, int | None]
"""``[from, to)`` in nanoseconds; None is open."""


@dataclass(frozen=True)
class View:
    """What is chosen of a record.

    Without ``items`` these are all that the robot's buses have said; with ``with_box`` also what
    the box wrote about itself. ``variables`` names the columns per table, as a query does; the
    rest have those chosen in ``black_box.yaml``, or with ``all_variables`` every one.
    ``received`` adds the columns ``received`` and ``seq``. Several ``windows``, such as missions,
    follow each other in one export.
    """

    items: Sequence[str] = ()
    variables: Mapping[str, Sequence[str]] = field(default_factory=dict)
    windows: Sequence[Window] = ((None, None),)
    by: By = "received"
    all_variables: bool = False
    received: bool = False
    with_box: bool = False


def ordered_windows(windows: Sequence[Window]) -> list[Window]:
    """Put windows in order of time; those that overlap or touch become one.

    Raises UsageError for a window that ends before it begins.
    """
    merged: list[Window] = []
    for from_ns, to_ns in sorted(windows, key=lambda w: (w[0] is not None, w[0] or 0)):
        if from_ns is not None and to_ns is not None and from_ns >= to_ns:
            raise UsageError("the range ends before it begins", "exchange --from and --to")
        if merged and _reaches(merged[-1][1], from_ns):
            merged[-1] = merged[-1][0], _later(merged[-1][1], to_ns)
        else:
            merged.append((from_ns, to_ns))
    return merged


def _reaches(end_ns: int | None, from_ns: int | None) -> bool:
    return end_ns is None or from_ns is None or from_ns <= end_ns


def _later(first_ns: int | None, second_ns: int | None) -> int | None:
    return None if first_ns is None or second_ns is None else max(first_ns, second_ns)


def chosen_tables(catalogue: Catalogue, view: View) -> list[TableSchema]:
    """Return the tables of a view, child tables behind their items.

    An item brings its child tables along, unless its variables are named. Raises UsageError for
    an item that is not there, and where nothing is left.
    """
    named = [*dict.fromkeys([*view.items, *view.variables])]
    schemas = {name: catalogue.schema(name) for name in sorted(catalogue.schemas)}
    if not named:
        found = [s for s in schemas.values() if view.with_box or s.source != reserved.SOURCE]
    else:
        tops = [catalogue.schema(name) for name in named]
        found = [table for top in tops for table in _with_children(top, schemas, view)]
        boxes = [s for s in schemas.values() if view.with_box and s.source == reserved.SOURCE]
        found += [schema for schema in boxes if schema not in found]
    if not found:
        raise UsageError("there is nothing to export", "'amberbox items WHERE' lists what there is")
    return found


def _with_children(
    top: TableSchema, schemas: Mapping[str, TableSchema], view: View
) -> list[TableSchema]:
    if top.parent or top.item in view.variables:
        return [top]
    return [top, *(schema for schema in schemas.values() if schema.parent == top.item)]


def chosen_items(catalogue: Catalogue, view: View) -> frozenset[str] | None:
    """Return the items whose messages are in a view; None for all.

    A child table's messages are those of its item. Raises UsageError for an item that is not
    there, and for variables: messages are whole.
    """
    if view.variables:
        raise UsageError(
            "messages are exported whole, not single variables",
            "name items only, or choose csv, parquet or mcap-json",
        )
    if view.by != "received":
        raise UsageError("messages are exported by time of receipt", "leave out --by timestamp")
    if not view.items:
        return None
    raw = {stream.item for j in catalogue.journals(skip=()) for stream in j.streams.values()}
    return frozenset(name if name in raw else _item_of(catalogue, name) for name in view.items)


def _item_of(catalogue: Catalogue, name: str) -> str:
    schema = catalogue.schema(name)
    return schema.parent or schema.item
