"""Run the maintenance process of a store until it is stopped, or until its recorder is gone."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from amberbox.blackbox.retention.maintenance import LOCK_TIMEOUT_S, RetentionService, wait_for_lock
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import REQUESTS, Store, open_to_write
from amberbox.core.errors import UsageError

PERIOD_S = 2.0
_PAUSE_S = 0.2


def main(arguments: Sequence[str] | None = None) -> int:
    """Maintain a store until stopped, or until the recorder that started this is gone."""
    parser = argparse.ArgumentParser(prog="python -m amberbox.blackbox.keeper")
    parser.add_argument("store", type=Path)
    parser.add_argument("--options", default="{}", help="KeeperOptions as JSON")
    parser.add_argument("--parent", type=int, default=0)
    parser.add_argument("--once", action="store_true")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        store = open_to_write(options.store)
        lock = wait_for_lock(store, LOCK_TIMEOUT_S if options.parent else 0.0, stop)
    except UsageError as error:
        print(f"amberbox keeper: {error}", file=sys.stderr)
        return error.exit_code
    keeper = RetentionService(store, RetentionOptions.from_json(options.options))
    keeper.start_space_thread()  # at normal priority: the next call affects this thread only
    os.nice(10)
    # load slow modules (a second) before any segment is to be built
    if can_build():
        import pyarrow.parquet  # noqa: F401  # only to have it loaded
    known = _times_of_change(store)
    keeper.step(stop)
    while not options.once and _pause(stop, options.parent, store, known):
        known = _times_of_change(store)
        keeper.step(stop)
    keeper.close()
    lock.release()
    return 0


def _times_of_change(store: Store) -> tuple[int, ...]:
    """Return when journal files and requests were last added or removed, in ns."""
    folders = (store.folder("main"), store.folder("bulk"), store.path / REQUESTS)
    return tuple(folder.stat().st_mtime_ns if folder.exists() else 0 for folder in folders)


def _pause(stop: threading.Event, parent: int, store: Store, known: tuple[int, ...]) -> bool:
    """Wait for the next step, or until files were added since; False when it is time to go."""
    end_s = time.monotonic() + PERIOD_S
    while time.monotonic() < end_s:
        if stop.wait(_PAUSE_S) or (parent and os.getppid() != parent):
            return False
        if _times_of_change(store) != known:
            return True
    return True


if __name__ == "__main__":
    sys.exit(main())
