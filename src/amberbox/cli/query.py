"""Rows of a record: the variables of a data item, or the answer to a SQL query."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import IO

from amberbox.blackbox.columns.table_text import write_grid
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.table import Table
from amberbox.cli._arguments import add_range, add_where, add_window, missions_of, opened, window_of
from amberbox.cli._output import grid_width, print_notes, text_output, writable
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time

FORMATS = ("table", "csv", "json", "parquet")
_MORE = "name some, or --format csv"


def configure_query(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("item", metavar="ITEM", help="data item; 'amberbox items' lists them")
    parser.add_argument(
        "variables", metavar="VAR", nargs="*",
        help="column, path or end of a path, ranges[17], received, seq",
    )  # fmt: skip
    add_range(parser)
    add_window(parser)
    parser.add_argument(
        "--points", type=int, metavar="N", help="thin out to N rows, keeping extremes"
    )
    parser.add_argument("--follow", action="store_true", help="go on with rows as they come")
    add_format(parser)


def add_format(parser: argparse.ArgumentParser) -> None:
    """Add ``--format``, ``--json`` and ``-o``."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--format", choices=FORMATS, help="default: by the ending of -o, else table")
    group.add_argument(
        "--json", dest="format", action="store_const", const="json", help="--format json"
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="write to a file")


def run_query(args: argparse.Namespace) -> int:
    """Print rows, and with ``--follow`` further ones until stopped."""
    form = chosen_format(args.format, args.output)
    with opened(args.where) as record:
        if args.follow:
            return _follow(record, args, form)
        missions = missions_of(args, record)
        span = (None, None) if missions else window_of(args, record)
        table = record.query(
            args.item, args.variables or None, *span, args.by, args.points, missions=missions
        )
        notes = [note.replace("fetch URL", f"fetch {args.where}") for note in table.notes]
        if not len(table):
            notes.append(_nothing(record, table.item))
    write(table, form, args.output)
    print_notes(notes)
    return 0


def _nothing(record: Record, item: str) -> str:
    """Return why a result is empty: the rows that the item has, or why it has none."""
    known = next((info for info in record.items() if info.name == item), None)
    if known is None or known.no_columns:
        why = "nothing of it can be read" if known is None else known.no_columns
        return f"{item} has no rows: {why}"
    first, last = format_time(known.first_ns), format_time(known.last_ns)
    return f"no rows in this range; {item} has {known.rows} from {first} to {last}"


def chosen_format(named: str | None, output: str | None) -> str:
    """Return the named format, else that of the file's suffix."""
    ending = output.rpartition(".")[2] if output else ""
    form = named or (ending if ending in FORMATS else "table")
    if form == "parquet" and output is None:
        raise UsageError("Parquet needs a file", "add -o rows.parquet")
    return form


def write(table: Table, form: str, output: str | None) -> None:
    """Write a table in one of ``FORMATS``."""
    if form == "parquet":
        table.to_parquet(writable(str(output)))
        return
    with text_output(output) as file:
        _WRITERS[form](table, file)


def _write_grid(table: Table, file: IO[str]) -> None:
    write_grid(file, table.fields, table.columns, room=grid_width(file, _MORE))


_WRITERS: dict[str, Callable[[Table, IO[str]], None]] = {
    "table": _write_grid,
    "csv": lambda table, file: table.to_csv(file),
    "json": lambda table, file: table.to_json(file),
}


def _follow(record: Record, args: argparse.Namespace, form: str) -> int:
    """Print rows as they arrive; JSON as one object per line."""
    if is_url(args.where):
        hint = "amberbox status URL --watch shows what is live"
        raise UsageError("a server gets rows journal by journal: there is nothing to follow", hint)
    ended = args.points is not None or args.to is not None or args.incident is not None
    if form == "parquet" or ended:
        hint = "leave out parquet, --points, --to, --incident"
        raise UsageError("--follow prints rows as they come", hint)
    if args.by != "received" or args.mission is not None:
        raise UsageError("--follow goes by time of receipt", "leave out --by and --mission")
    from amberbox.blackbox.query.record import follow_tables  # for --follow only

    with text_output(args.output) as file:
        first = True
        for table in follow_tables(record, args.item, args.variables or None, args.from_):
            if form == "json":
                table.to_json(file, lines=True)
            elif form == "csv":
                table.to_csv(file, header=first)
            else:
                space = grid_width(file, _MORE)
                write_grid(file, table.fields, table.columns, header=first, steady=True, room=space)
            file.flush()
            first = False
    return 0


def configure_sql(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("statement", metavar="SQL", help='such as "select ... from ros_odom"')
    add_format(parser)


def run_sql(args: argparse.Namespace) -> int:
    """Print the answer to a SELECT."""
    form = chosen_format(args.format, args.output)
    with opened(args.where) as record:
        table = record.sql(args.statement)
    write(table, form, args.output)
    print_notes(table.notes)
    return 0
