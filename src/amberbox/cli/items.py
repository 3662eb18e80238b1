"""List what was recorded: data items with rows, rates and times."""

from __future__ import annotations

import argparse

from amberbox.blackbox.journal.reserved import PREFIX
from amberbox.blackbox.query.overview import ItemInfo
from amberbox.cli._output import opened, print_grid, print_json, tell
from amberbox.cli._server import add_where
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.core.units import in_bytes

_HEADER = ("item", "type", "rows", "rate Hz", "first (UTC)", "last (UTC)", "stamp offset s", "size")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("--all", action="store_true", help="the box's own items, too")
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run(args: argparse.Namespace) -> int:
    """Print the items of a record."""
    with opened(args.where) as record:
        items = record.items()
        notes = record.clock().notes if items else []
    if args.json:
        print_json([item.to_json() for item in items])
        return 0
    own = [item for item in items if item.topic.startswith(PREFIX)]
    shown = [item for item in items if args.all or item not in own]
    if shown:
        print_grid(_HEADER, map(_row, shown))
    tell([*notes, *(_raw(item, args.where) for item in shown if item.no_columns)])
    if own and not args.all:
        print(f"and {len(own)} items of the box itself (--all shows them)")
    if not items:
        print("nothing has been recorded yet")
    return 0


def _row(item: ItemInfo) -> tuple[object, ...]:
    return (
        item.name,
        item.type,
        f"~{item.rows}" if item.estimated else item.rows,
        item.rate_hz,
        _short(item.first_ns),
        _short(item.last_ns),
        None if item.stamp_offset_s is None else round(item.stamp_offset_s, 4),
        in_bytes(item.bytes) if item.bytes else None,
    )


def _raw(item: ItemInfo, where: str) -> str:
    """Say why an item has no columns, and how its messages can be had."""
    export = f"amberbox export {where} --format mcap --item {item.name} -o FILE"
    return f"{item.name} has no columns: {item.no_columns}; its messages: {export}"


def _short(time_ns: int) -> str:
    """Milliseconds are enough for the eye."""
    return format_time(time_ns - time_ns % (NS // 1000))[:23]
