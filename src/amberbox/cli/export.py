"""Export a view of a record: CSV, Parquet, MCAP, or a ROS 1 bag."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from amberbox.blackbox.exporting import FORMS, ExportOptions, ExportReport, View, export
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.variables import closest
from amberbox.cli._output import add_range, opened, print_json, writable
from amberbox.cli._progress import progress_bar
from amberbox.cli._server import add_where
from amberbox.cli._window import add_window, windows
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError
from amberbox.core.units import in_bytes

JOURNALS = "journals"
_ENDINGS = {".csv": "csv", ".parquet": "parquet", ".mcap": "mcap", ".bag": "bag"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument(
        "-o", "--output", metavar="TARGET",
        help="file, or for csv and parquet a folder; CSV goes to stdout without",
    )  # fmt: skip
    parser.add_argument(
        "--format",
        choices=(*FORMS, JOURNALS),
        help="default: by the ending of TARGET; journals of servers only",
    )
    _add_choice(parser)
    parser.add_argument(
        "--raw-text", action="store_true",
        help="CSV: leave text as it is, also what a spreadsheet would calculate",
    )  # fmt: skip
    parser.add_argument(
        "--compression", choices=("none", "bz2", "lz4"), default="none",
        help="of the chunks of a ROS 1 bag",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def _add_choice(parser: argparse.ArgumentParser) -> None:
    """Add what says which rows and columns are wanted."""
    parser.add_argument(
        "--item", action="append", default=[], metavar="NAME",
        help="data item, again for more; all without",
    )  # fmt: skip
    parser.add_argument(
        "--variable", action="append", default=[], metavar="ITEM.VAR",
        help="only these variables of an item (csv, parquet, mcap-json)",
    )  # fmt: skip
    parser.add_argument(
        "--all-variables", action="store_true",
        help="also variables that black_box.yaml does not choose",
    )  # fmt: skip
    parser.add_argument("--received", action="store_true", help="add the columns received and seq")
    add_range(parser)
    add_window(parser)
    parser.add_argument(
        "--with-box", action="store_true",
        help="add what the box wrote about itself: events, gaps, clock",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Export and report; 1 if something that was asked for is not in it."""
    target = None if args.output in (None, "-") else writable_target(args.output)
    form = chosen_form(args.format, target)
    if target is None and args.json:
        raise UsageError("the report and the rows would both go to stdout", "add -o TARGET")
    if is_url(args.where):
        from amberbox.cli._remote_export import export_remote

        with opened(args.where) as remote:
            variables = _variables(remote, args.variable)
        return export_remote(args, form, target, variables)
    if form == JOURNALS:
        raise UsageError("a store has its journals in it", f"copy {args.where}")
    options = ExportOptions(args.raw_text, args.compression)
    started = time.monotonic()
    with opened(args.where) as record:
        view = _view(record, args)
        progress = progress_bar(wanted=target is not None and not args.json)
        report = export(record, view, target, form, progress, options)
    if args.json:
        print_json(report.to_json())
    else:
        _tell(report, time.monotonic() - started)
    return 1 if report.missing else 0


def writable_target(path: str) -> Path:
    """Return a target whose folder exists; raises UsageError when it cannot be written."""
    target = Path(path)
    return target if target.is_dir() else writable(path)


def chosen_form(named: str | None, target: Path | None) -> str:
    """Return the format that was named, else the one that the target's ending says."""
    if named:
        return named
    if target is None:
        return "csv"
    form = _ENDINGS.get(target.suffix)
    if form is None:
        endings = ", ".join(_ENDINGS)
        raise UsageError(f"{target} does not say its format", f"add --format, or one of {endings}")
    return form


def _view(record: Record, args: argparse.Namespace) -> View:
    return View(
        items=args.item,
        variables=_variables(record, args.variable),
        windows=windows(args, record),
        by=args.by,
        all_variables=args.all_variables,
        received=args.received,
        with_box=args.with_box,
    )


def _variables(record: Record, texts: Sequence[str]) -> dict[str, list[str]]:
    """Sort ``ITEM.VAR`` by item."""
    chosen: dict[str, list[str]] = {}
    known = [info.name for info in record.items()] if texts else []
    for text in texts:
        item = max((n for n in known if text.startswith(f"{n}.")), key=len, default=None)
        if item is None:
            raise UsageError(f"{text!r} is no ITEM.VAR", closest(text.partition(".")[0], known))
        chosen.setdefault(item, []).append(text[len(item) + 1 :])
    return chosen


def _tell(report: ExportReport, seconds: float) -> None:
    """Print the report, on stderr where the rows went to stdout."""
    output = sys.stdout if report.target else sys.stderr
    what = "messages" if report.form in ("mcap", "bag") else "rows"
    into = f", {in_bytes(report.bytes)} in {report.target}" if report.target else ""
    lines = report.lines() if report.target else [f"note: {text}" for text in report.notes]
    lines += [] if report.target else [f"missing: {text}" for text in report.missing]
    for line in [*lines, f"{report.total} {what} in {seconds:.1f} s{into}"]:
        print(line, file=output)
