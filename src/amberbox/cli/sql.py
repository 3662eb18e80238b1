"""Ask the record in SQL: one view per data item (DuckDB)."""

from __future__ import annotations

import argparse

from amberbox.cli._output import opened, tell
from amberbox.cli._server import add_where
from amberbox.cli.query import add_format, chosen_format, write


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("statement", metavar="SQL", help='such as "select ... from ros_odom"')
    add_format(parser)


def run(args: argparse.Namespace) -> int:
    """Print the answer to a SELECT."""
    form = chosen_format(args.format, args.output)
    with opened(args.where) as record:
        table = record.sql(args.statement)
    write(table, form, args.output)
    tell(table.notes)
    return 0
