"""The items of a robot: what there is of each, and what its columns are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.catalogue import union
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.fleet.data.forms import column_json
from amberbox.fleet.data.look import Look
from amberbox.fleet.data.rows import files_of


@dataclass(frozen=True, slots=True)
class Held:
    """What there is of an item: rows and times of receipt of a file, or of a waiting journal."""

    first_ns: int
    last_ns: int
    rows: int


def items_json(look: Look) -> list[dict[str, Any]]:
    """List the items that have rows, the box's own at the end."""
    found = [_info(look, name) for name in sorted(look.schemas)]
    listed = [info for info in found if info["rows"]]
    return sorted(listed, key=lambda info: bool(info["source"] == reserved.SOURCE))


def described_json(look: Look) -> list[dict[str, Any]]:
    """Describe all items that have rows, each with its columns, the box's own at the end."""
    return [{**info, **_columns(look, info["name"])} for info in items_json(look)]


def item_json(look: Look, name: str) -> dict[str, Any] | None:
    """Describe an item and its columns; None where there is none of this name."""
    known = {table.casefold(): table for table in look.schemas}
    table = name if name in look.schemas else known.get(name.casefold())
    if table is None:
        return None
    children = [t for t, versions in look.schemas.items() if versions[-1].parent == table]
    return {**_info(look, table), **_columns(look, table), "children": sorted(children)}


def _columns(look: Look, table: str) -> dict[str, Any]:
    schema = union(look.schemas[table])
    return {
        "stamp": schema.stamp, "parent": schema.parent,
        "chosen": list(look.selection.get(table, [])),
        "columns": [column_json(column) for column in schema.columns],
    }  # fmt: skip


def _info(look: Look, table: str) -> dict[str, Any]:
    schema, held = union(look.schemas[table]), list(_held(look, table))
    count = sum(one.rows for one in held)
    first = min((one.first_ns for one in held), default=None)
    last = max((one.last_ns for one in held), default=None)
    return {
        "name": table, "source": schema.source, "topic": schema.topic, "type": schema.type,
        "rows": count, "first": None if first is None else format_time(first),
        "last": None if last is None else format_time(last), "rate_hz": _rate_hz(held),
    }  # fmt: skip


def _held(look: Look, table: str) -> Iterator[Held]:
    for version in look.reader.schemas.get(table, ())[:1]:
        yield from (Held(*file) for file in files_of(look, version, None))
    for one in look.only_in_journals(table):
        rows = one.journal.items.get(table, 0)
        if rows:
            yield Held(one.row.start_ns, one.row.end_ns, rows)


def _rate_hz(held: list[Held]) -> float | None:
    """Rows per second of recording: time between files does not count."""
    pairs = [(one.rows - 1, one.last_ns - one.first_ns) for one in held if one.rows > 1]
    lasted_s = sum(ns for _, ns in pairs) / NS
    return sum(rows for rows, _ in pairs) / lasted_s if lasted_s > 0 else None
