"""The keeper: turns finished journals into segments and trims the ring, beside the recorder.

It runs as a process of its own at low priority, so that nothing it does can hold up recording.
Only the keeper deletes.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Container, Sequence
from contextlib import suppress

from amberbox.blackbox.follow.read import JournalFile, journal_file
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.segments.build import build_segments, can_build, merge_small
from amberbox.blackbox.store import Store, WriterLock, is_locked
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError

PATIENCE_S = 10.0
"""After the recorder was killed its keeper lives on for a moment; the next one waits for it."""


class Keeper:
    """Keeps one store; ``step`` does what there is to do now."""

    def __init__(self, store: Store, options: KeeperOptions | None = None) -> None:
        self._store = store
        self._options = options or KeeperOptions()
        self._with_segments = can_build()
        self._refused: set[str] = set()

    def step(self, stop: threading.Event) -> None:
        """Build the segments of sealed journals, then trim the ring."""
        if self._with_segments:
            self._build(stop)
        self._trim_ring()

    def _build(self, stop: threading.Event) -> None:
        from amberbox.blackbox.segments import manifest

        done = manifest.read(self._store.path).journals
        built = 0
        for journal in self.sealed("main", skip={*done, *self._refused}):
            if stop.is_set():
                return
            built += self._build_one(journal)
        if built:
            merge_small(self._store.path)

    def _build_one(self, journal: JournalFile) -> int:
        try:
            build_segments(self._store.path, journal)
        except Exception as error:  # whatever it is: the other journals go on
            self._refused.add(journal.name)  # its rows stay readable in the journal
            print(f"amberbox keeper: {journal.name}: no segments: {error}", file=sys.stderr)
            return 0
        return 1

    def sealed(self, writer: str, skip: Container[str] = ()) -> list[JournalFile]:
        """Return the journal files that nobody writes any more, but those named in ``skip``."""
        paths = self._store.journal_files(writer)
        if is_locked(self._store, writer):
            paths = paths[:-1]
        names = {path: f"{path.parent.name}/{path.name}" for path in paths}
        files = [journal_file(path, name) for path, name in names.items() if name not in skip]
        return [journal for journal in files if journal.rows]

    def _trim_ring(self) -> None:
        """Delete ring files that ended longer ago than the ring is long."""
        files = self.sealed("ring")
        for journal, age_ns in zip(files, ages(files), strict=True):
            if age_ns > self._options.ring_s * NS:
                journal.path.unlink(missing_ok=True)


def ages(files: Sequence[JournalFile]) -> list[int]:
    """Tell how long before the end of the last file each one ended, in ns.

    Files of a run follow each other without a pause: where their times do not, the clock was set.
    """
    found: list[int] = []
    age_ns = 0
    for journal, after in zip(reversed(files), [None, *reversed(files)], strict=False):
        if after is not None:
            pause_ns = after.start_ns - journal.end_ns if after.run != journal.run else 0
            age_ns += max(0, pause_ns) + max(0, after.end_ns - after.start_ns)
        found.append(age_ns)
    return found[::-1]


def wait_for_lock(store: Store, patience_s: float, stop: threading.Event) -> WriterLock:
    """Become the keeper of a store; raises UsageError when another one stays."""
    end = time.monotonic() + patience_s
    while True:
        try:
            return WriterLock(store, "keeper")
        except UsageError:
            if time.monotonic() >= end or stop.wait(0.2):
                raise


def seal(store: Store) -> None:
    """Build what can be built once, as an import does at its end."""
    if can_build():
        with suppress(UsageError):  # another keeper is at work here: it builds them, too
            lock = wait_for_lock(store, PATIENCE_S, threading.Event())
            Keeper(store, KeeperOptions(ring_s=float("inf"))).step(threading.Event())
            lock.release()
