"""Make a robot report to a server, by the line that the server printed for it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from amberbox.cli._output import print_json, tell
from amberbox.cli._text import print_lines
from amberbox.core.errors import UsageError

_EXIT = "exit status: 0 joined, 1 written down but the server cannot be reached now, 2 refused"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument("line", metavar="LINE", help="what 'amberbox serve add-robot' printed, in "
                        "quotes; - reads it from standard input, so that no shell remembers "
                        "it")  # fmt: skip
    parser.add_argument("--replace", action="store_true", help="leave another server for this one")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.epilog = _EXIT


def run(args: argparse.Namespace) -> int:
    """Check the line, write it down, try it."""
    from amberbox.link.joining import read_join_line
    from amberbox.robot.joining.join import join

    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "join takes a robot folder")
    line = read_join_line(sys.stdin.readline() if args.line == "-" else args.line)
    joined = join(Path(args.folder), line, replace=args.replace)
    if args.json:
        print_json({"url": line.url, "reached": joined.reached, "said": list(joined.lines)})
    else:
        print_lines(joined.lines)
        tell([f"amberbox run {args.folder} keeps it linked"])
    return 0 if joined.reached else 1
