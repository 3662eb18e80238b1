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
        for mark in marks:
            try:
                mark.wait()
            except OSError as error:
                text = f"the disk does not sync: {error.strerror}"
                self._pipeline.event("disk", text)

    def stop(self) -> None:
        """Wait for the sync that is under way."""
        if self._thread is not None:
            self._thread.join()
