"""The watcher's process: ``python -m amberbox.monitoring.watcher FOLDER``."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from amberbox.blackbox.folder.folder import load_folder
from amberbox.blackbox.store import create_store
from amberbox.core.errors import AmberboxError
from amberbox.monitoring.configuration import load_plan
from amberbox.monitoring.watcher.watcher import Watch, Watcher


def main(arguments: Sequence[str] | None = None) -> int:
    """Watch the record of a robot folder until told to stop."""
    parser = argparse.ArgumentParser(prog="python -m amberbox.monitoring.watcher")
    parser.add_argument("folder", type=Path)
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        folder = load_folder(options.folder)
        plan, _ = load_plan(folder)
        Watcher(Watch(plan, create_store(folder.store_path), folder)).run(stop)
    except AmberboxError as error:
        print(f"amberbox watcher: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
