"""Making a journal durable beside the thread that writes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from amberbox.blackbox.journal.syncmark import SyncMark

SYNC_S = 1.0
"""What need not be durable at once is so after this long."""


class SyncThread:
    """Flushes what was written, one flush at a time; ``see_to`` is called after each write."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._thread: threading.Thread | None = None
        self._due_s = 0.0
        self._is_urgent = False
        self._failure: OSError | None = None

    def see_to(self, mark: Callable[[], SyncMark], *, urgent: bool) -> None:
        """Begin to flush if it is time, or urgent, and no flush is under way.

        ``mark`` closes a link of the journal's chain; it is called where a flush begins. Raises
        OSError when the flush before failed.
        """
        self._is_urgent = self._is_urgent or urgent
        if self._thread is not None and self._thread.is_alive():
            return
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        if self._is_urgent or self._clock() >= self._due_s:
            self._is_urgent, self._due_s = False, self._clock() + SYNC_S
            self._thread = threading.Thread(target=self._flush, args=(mark(),), daemon=True)
            self._thread.start()

    def _flush(self, mark: SyncMark) -> None:
        try:
            mark.wait()
        except OSError as error:
            self._failure = error

    def finish(self) -> None:
        """Wait for the flush that is under way."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
