"""Makes the journals durable every ``sync_s`` in a thread of its own, so that writing goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from amberbox.blackbox.journal.syncmark import SyncMark
from amberbox.blackbox.recorder.pipeline import Pipeline


class Syncer:
    """Starts one ``fdatasync`` after the other, never two at a time."""

    def __init__(self, pipeline: Pipeline, sync_s: float) -> None:
        self._pipeline = pipeline
        self._sync_s = sync_s
        self._due = time.monotonic() + sync_s
        self._thread: threading.Thread | None = None
        self._trouble = ""

    def every(self, sync_s: float) -> None:
        """Sync in this interval from now on."""
        self._due += sync_s - self._sync_s
        self._sync_s = sync_s

    def at_once(self, sync_s: float) -> None:
        """Sync as soon as possible, and then in this interval."""
        self._sync_s, self._due = sync_s, 0.0

    def poke(self) -> None:
        """Start a sync when one is due and none is under way."""
        now = time.monotonic()
        if now < self._due or (self._thread is not None and self._thread.is_alive()):
            return
        self._due = now + self._sync_s
        marks = self._pipeline.mark_sync()
        self._thread = threading.Thread(target=self._wait, args=(marks,), daemon=True)
        self._thread.start()

    def _wait(self, marks: Sequence[SyncMark]) -> None:
        troubles = [trouble for trouble in map(_wait_for, marks) if trouble]
        trouble, before = troubles[0] if troubles else "", self._trouble
        self._trouble = trouble
        if trouble and not before:
            self._pipeline.rotate()  # the kernel reports a page once, then takes it for written
            text = f"the disk does not sync: {trouble}; what came since the last sync may be lost"
            self._pipeline.event("disk", f"{text}, new files begin")
        elif before and not trouble:
            self._pipeline.event("disk", "the disk syncs again")

    def stop(self) -> None:
        """Wait for the sync that is under way."""
        if self._thread is not None:
            self._thread.join()


def _wait_for(mark: SyncMark) -> str:
    """Make a journal durable; return what the disk says against it."""
    try:
        mark.wait()
    except OSError as error:
        return error.strerror or str(error)
    return ""
