"""List what is missing from a record: from when to when, and why."""

from __future__ import annotations

import argparse
from typing import Any

from amberbox.blackbox.segments.parquet import overlaps
from amberbox.cli._output import add_range_only, opened, print_grid, print_json
from amberbox.cli._server import add_where
from amberbox.cli._window import Window, add_window, windows
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.core.types import Gap

_HEADER = ("from (UTC)", "to (UTC)", "seconds", "item", "publisher", "messages", "reason")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("item", nargs="?", metavar="ITEM", help="data item; all when absent")
    add_range_only(parser)
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run(args: argparse.Namespace) -> int:
    """Print the gaps of a record."""
    with opened(args.where) as record:
        if args.item is not None and args.item not in {info.name for info in record.items()}:
            record.variables(args.item)  # a name that is not there is an error, not an empty list
        spans = windows(args, record)
        found = [g for g in record.gaps(args.item) if any(_meets(g, span) for span in spans)]
    if args.json:
        print_json([_as_json(gap) for gap in found])
    elif found:
        print_grid(_HEADER, map(_row, found))
    else:
        print("nothing is missing")
    return 0


def _meets(gap: Gap, window: Window) -> bool:
    return overlaps(gap.from_ns, max(gap.to_ns - 1, gap.from_ns), window)


def _row(gap: Gap) -> tuple[str, ...]:
    seconds = f"{(gap.to_ns - gap.from_ns) / NS:.3f}"
    start, end = (format_time(time_ns)[:23] for time_ns in (gap.from_ns, gap.to_ns))
    count = "-" if gap.count is None else str(gap.count)
    return start, end, seconds, gap.item or _all(gap), gap.peer or "-", count, gap.reason


def _all(gap: Gap) -> str:
    """Name the items of a journal: those of the keeping classes bulk and ring have their own."""
    return f"all of {gap.writer}" if gap.writer in ("bulk", "ring") else "all"


def _as_json(gap: Gap) -> dict[str, Any]:
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
