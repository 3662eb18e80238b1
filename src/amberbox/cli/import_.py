"""Import recordings: ROS 1 and ROS 2 bags and MCAP files become part of a store."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from amberbox.blackbox.folder.folder import store_of
from amberbox.blackbox.importing import ImportReport, import_recordings
from amberbox.cli._progress import progress_bar


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT",
                        help="bag file, folder of a ROS 2 bag, or MCAP file")  # fmt: skip
    parser.add_argument("--store", required=True, type=Path, metavar="DIR",
                        help="store or robot folder; made if it is not there")  # fmt: skip
    parser.add_argument("--source", default="ros", metavar="NAME",
                        help="first word of the item names (default: ros)")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Import and report; 1 if anything in the inputs was damaged."""
    started = time.monotonic()
    progress = progress_bar(wanted=not args.json)
    store = store_of(args.store) or args.store
    reports = import_recordings(args.inputs, store, source=args.source, progress=progress)
    if args.json:
        print(json.dumps([_as_json(report) for report in reports], indent=2))
    else:
        print("\n".join(line for report in reports for line in report.lines()))
        total = sum(report.messages for report in reports)
        print(f"{total} messages in {time.monotonic() - started:.1f} s, now in {store}")
    return 1 if any(report.damage for report in reports) else 0


def _as_json(report: ImportReport) -> dict[str, object]:
    return {
        "path": str(report.path),
        "messages": report.messages,
        "items": report.items,
        "notes": report.notes,
        "damage": report.damage,
        "already_imported": report.known,
    }
