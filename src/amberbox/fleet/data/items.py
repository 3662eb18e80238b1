"""The items of a robot: what there is of each, and what its columns are."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.follow.batching import UNDECODABLE
from amberbox.blackbox.follow.read import KEPT_RAW, with_columns
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.catalogue import union
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.core.types import Gap, Topic
from amberbox.fleet.archive.journal import GapFact, decode
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
    """List the items that have messages, the box's own at the end.

    Of one with ``no_columns`` the messages are there as they came only; it says why.
    """
    found = [_info(look, name) for name in look.schemas]
    listed = [info for info in found if info["rows"]]
    listed += _without_columns(look, {info["name"] for info in listed})
    listed.sort(key=lambda info: str(info["name"]))
    return sorted(listed, key=lambda info: bool(info["source"] == reserved.SOURCE))


def described_json(look: Look) -> list[dict[str, Any]]:
    """Describe all items that have columns, each with these, the box's own at the end."""
    found = (info for info in items_json(look) if not info["no_columns"])
    return [{**info, **_columns(look, info["name"])} for info in found]


def item_json(look: Look, name: str) -> dict[str, Any] | None:
    """Describe an item and its columns, none where it has none; None for an unknown name."""
    known = {table.casefold(): table for table in look.schemas}
    table = name if name in look.schemas else known.get(name.casefold())
    if table is None:
        raws = (info for info in _without_columns(look, look.schemas) if info["name"] == name)
        raw = next(raws, None)
        none = {"stamp": "", "parent": "", "chosen": [], "columns": [], "children": []}
        return None if raw is None else {**raw, **none}
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
        "no_columns": "",
    }  # fmt: skip


def _without_columns(look: Look, named: Collection[str]) -> Iterator[dict[str, Any]]:
    """Describe items of which no message can be unrolled, by what is noted of their journals.

    Topic and type are known of journals only whose columns are still to come.
    """
    found: dict[str, list[Gap | GapFact]] = {}
    topics: dict[str, Topic] = {}
    for source in look.reader.sources:
        for row in look.catalogue.journals(source):
            for fact in decode(row.facts).gaps:
                if fact.reason.startswith((KEPT_RAW, UNDECODABLE)):
                    found.setdefault(fact.item, []).append(fact)
    for one in look.readable:
        told: list[Gap] = []
        with_columns(one.journal, told.append)
        for gap in told:
            found.setdefault(gap.item, []).append(gap)
        topics |= {stream.item: stream.topic for stream in one.journal.streams.values()}
    for item in found.keys() - set(named):
        gaps, topic = sorted(found[item], key=lambda gap: gap.from_ns), topics.get(item)
        first, last = gaps[0].from_ns, max(gap.to_ns for gap in gaps) - 1
        yield {
            "name": item, "source": item.partition("_")[0],
            "topic": topic.name if topic else "",
            "type": topic.schema.name if topic and topic.schema else "",
            "rows": sum(gap.count or 0 for gap in gaps), "first": format_time(first),
            "last": format_time(last), "rate_hz": None,
            "no_columns": gaps[-1].reason.partition(": ")[2],
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
