"""Run the whole box on a robot: record, keep, monitor, and start again whatever dies."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from amberbox.blackbox.folder.folder import load_folder
from amberbox.blackbox.store import create_store
from amberbox.core.errors import UsageError
from amberbox.core.files import keep_to_group
from amberbox.robot.supervisor.child import children_of
from amberbox.robot.supervisor.supervisor import Box, Supervisor

_EXIT = "exit status: 0 after an orderly end, 2 wrong usage or configuration at the start"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument("--quiet", action="store_true", help="print troubles only, not what the "
                        "monitors find")  # fmt: skip
    parser.epilog = _EXIT


def run(args: argparse.Namespace) -> int:
    """Run everything until SIGTERM or Ctrl-C; a second one hurries."""
    keep_to_group()
    if not Path(args.folder).is_dir():
        raise UsageError(f"'{args.folder}' is no folder", "run takes a robot folder")
    supervisor = Supervisor(box_of(args.folder, quiet=args.quiet))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: supervisor.stop())
    hung_up = supervisor.stop if sys.stdin and sys.stdin.isatty() else supervisor.reload
    signal.signal(signal.SIGHUP, lambda *_: hung_up())
    supervisor.run()
    return 0


def box_of(folder: str, *, quiet: bool) -> Box:
    """Read a robot folder; raises ConfigurationError with all that is wrong."""
    loaded = load_folder(folder)
    if not loaded.blocks:
        raise UsageError(
            f"{loaded.path} names no source that can be recorded",
            f"amberbox check {loaded.path} tells what its black_box.yaml holds",
        )
    path = loaded.path.resolve()
    children = children_of(path, loaded.robot.store.write_s, quiet=quiet)
    return Box(path, create_store(loaded.store_path), loaded.config_hash, children)
