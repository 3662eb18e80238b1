"""Contents of a record: its data items, its gaps, and the events of the recorder."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from amberbox.blackbox.journal.channels import PREFIX
from amberbox.blackbox.query.overview import ItemInfo
from amberbox.blackbox.store.segment_file import overlaps
from amberbox.cli._arguments import (
    Window,
    add_range_only,
    add_where,
    add_window,
    opened,
    window_of,
    windows,
)
from amberbox.cli._output import print_grid, print_json, print_lines, print_notes
from amberbox.core.clock import NS
from amberbox.core.safe_text import data_stream
from amberbox.core.timestamps import format_time
from amberbox.core.types import Gap
from amberbox.core.units import bytes_text

_ITEMS_HEADER = (
    "item",
    "type",
    "rows",
    "rate Hz",
    "first (UTC)",
    "last (UTC)",
    "stamp offset s",
    "size",
)


def configure_items(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("--all", action="store_true", help="the box's own items, too")
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run_items(args: argparse.Namespace) -> int:
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
        print_grid(_ITEMS_HEADER, map(_item_row, shown))
    print_notes(
        [*notes, *(_raw_export_hint(item, args.where) for item in shown if item.no_columns)]
    )
    if own and not args.all:
        print(f"and {len(own)} items of the box itself (--all shows them)")
    if not items:
        print("nothing has been recorded yet")
    return 0


def _item_row(item: ItemInfo) -> tuple[object, ...]:
    return (
        item.name,
        item.type,
        f"~{item.rows}" if item.estimated else item.rows,
        item.rate_hz,
        _millisecond_text(item.first_ns),
        _millisecond_text(item.last_ns),
        None if item.stamp_offset_s is None else round(item.stamp_offset_s, 4),
        bytes_text(item.bytes) if item.bytes else None,
    )


def _raw_export_hint(item: ItemInfo, where: str) -> str:
    """Return why an item has no columns, and how to export its messages."""
    export = f"amberbox export {where} --format mcap --item {item.name} -o FILE"
    return f"{item.name} has no columns: {item.no_columns}; its messages: {export}"


def _millisecond_text(time_ns: int) -> str:
    """Return a time as text with milliseconds."""
    return format_time(time_ns - time_ns % (NS // 1000))[:23]


_GAPS_HEADER = ("from (UTC)", "to (UTC)", "seconds", "item", "publisher", "messages", "reason")


def configure_gaps(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("item", nargs="?", metavar="ITEM", help="data item; all when absent")
    add_range_only(parser)
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run_gaps(args: argparse.Namespace) -> int:
    """Print the gaps of a record."""
    with opened(args.where) as record:
        if args.item is not None and args.item not in {info.name for info in record.items()}:
            record.variables(args.item)  # raises for an unknown item, instead of an empty list
        spans = windows(args, record)
        found = [g for g in record.gaps(args.item) if any(_is_in_window(g, span) for span in spans)]
    if args.json:
        print_json([_gap_json(gap) for gap in found])
    elif found:
        print_grid(_GAPS_HEADER, map(_gap_row, found))
    else:
        print("nothing is missing")
    return 0


def _is_in_window(gap: Gap, window: Window) -> bool:
    return overlaps(gap.from_ns, max(gap.to_ns - 1, gap.from_ns), window)


def _gap_row(gap: Gap) -> tuple[str, ...]:
    seconds = f"{(gap.to_ns - gap.from_ns) / NS:.3f}"
    start, end = (format_time(time_ns)[:23] for time_ns in (gap.from_ns, gap.to_ns))
    count = "-" if gap.count is None else str(gap.count)
    return (
        start,
        end,
        seconds,
        gap.item or _items_of_writer(gap),
        gap.peer or "-",
        count,
        gap.reason,
    )


def _items_of_writer(gap: Gap) -> str:
    """Return a name for the items of a journal; keeping classes bulk and ring have their own."""
    return f"all of {gap.writer}" if gap.writer in ("bulk", "ring") else "all"


def _gap_json(gap: Gap) -> dict[str, Any]:
    return {
        "item": gap.item or None,
        "publisher": gap.peer or None,
        "from": format_time(gap.from_ns),
        "to": format_time(gap.to_ns),
        "count": gap.count,
        "reason": gap.reason,
        "writer": gap.writer,
        "run": gap.run,
    }


def configure_events(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    add_range_only(parser)
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run_events(args: argparse.Namespace) -> int:
    """Print the events of a record, one line each."""
    with opened(args.where) as record:
        table = record.events(*window_of(args, record))
    if args.json:
        table.to_json(data_stream(sys.stdout))
        print()
        return 0
    print_lines(_event_line(row) for row in table.rows())
    return 0


def _event_line(row: dict[str, Any]) -> str:
    source = f" [{row['source']}]" if row["source"] else ""
    return f"{format_time(row['timestamp'])[:23]} {row['kind']}{source}: {row['text']}"
