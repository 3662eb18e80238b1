"""Import recordings: bags, MCAP, ULog, CSV and mongodump folders become part of a store."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from amberbox.blackbox.folder.folder import store_of
from amberbox.blackbox.formats.options import ReadOptions
from amberbox.blackbox.importing import ImportReport, import_recordings
from amberbox.cli._progress import progress_bar
from amberbox.core.source import TopicOptions
from amberbox.core.timetext import parse_time


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT",
                        help="ROS bag, MCAP, ULog or CSV file, mongodump folder")  # fmt: skip
    parser.add_argument("--store", required=True, type=Path, metavar="DIR",
                        help="store or robot folder; made if it is not there")  # fmt: skip
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC",
                        help="import only these topics")  # fmt: skip
    parser.add_argument("--source", metavar="NAME",
                        help="first word of item names (default: as live)")  # fmt: skip
    parser.add_argument("--msg", type=Path, metavar="DIR",
                        help="folder of .msg files for the types of mongodump folders")  # fmt: skip
    parser.add_argument("--time", metavar="COLUMN", help="time column of CSV files")
    parser.add_argument("--start", metavar="TIME",
                        help="when CSV and ULog files begin whose times are no dates")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Import and report; 1 if anything in the inputs was damaged."""
    started = time.monotonic()
    progress = progress_bar(wanted=not args.json)
    store = store_of(args.store) or args.store
    reports = import_recordings(
        args.inputs,
        store,
        topics=[TopicOptions(name) for name in args.topics],
        source=args.source,
        progress=progress,
        options=ReadOptions(args.msg, args.time, _start_ns(args.start)),
    )
    if args.json:
        print(json.dumps([_as_json(report) for report in reports], indent=2))
    else:
        print("\n".join(line for report in reports for line in report.lines()))
        total = sum(report.messages for report in reports)
        print(f"{total} messages in {time.monotonic() - started:.1f} s, now in {store}")
    return 1 if any(report.damage for report in reports) else 0


def _start_ns(text: str | None) -> int | None:
    return None if text is None else parse_time(text, time.time_ns, lambda: None)


def _as_json(report: ImportReport) -> dict[str, object]:
    return {
        "path": str(report.path),
        "messages": report.messages,
        "items": report.items,
        "kinds": report.kinds,
        "accounts": report.accounts,
        "notes": report.notes,
        "damage": report.damage,
        "already_imported": report.known,
    }
