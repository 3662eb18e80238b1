"""List what happened to the box: starts, recoveries, sources in trouble, a full disk."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from amberbox.cli._output import add_range_only, opened
from amberbox.cli._server import add_where
from amberbox.cli._text import print_lines
from amberbox.cli._window import add_window, window_of
from amberbox.core.terminal import for_data
from amberbox.core.timetext import format_time


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    add_range_only(parser)
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run(args: argparse.Namespace) -> int:
    """Print the events of a record, one line each."""
    with opened(args.where) as record:
        table = record.events(*window_of(args, record))
    if args.json:
        table.to_json(for_data(sys.stdout))
        print()
        return 0
    print_lines(_line(row) for row in table.rows())
    return 0


def _line(row: dict[str, Any]) -> str:
    source = f" [{row['source']}]" if row["source"] else ""
    return f"{format_time(row['timestamp'])[:23]} {row['kind']}{source}: {row['text']}"
