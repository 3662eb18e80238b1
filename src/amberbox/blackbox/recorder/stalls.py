"""When the recorder itself was held up: what came meanwhile is stamped late, or is lost."""

from __future__ import annotations

import threading
from collections.abc import Callable

from amberbox.core.clock import NS

BEAT_S = 0.05
LATE_NS = NS // 10
"""A thread that wakes later than this was held up, and so were those of the sources."""

Stall = tuple[int, int]
"""From when to when, nanoseconds since the computer's start."""


class StallMeter:
    """Measures how late a thread of the recorder wakes: for lack of a processor, a stop, a suspend.

    ``boot_ns`` is the time since the computer's start, suspend included.
    """

    def __init__(self, boot_ns: Callable[[], int]) -> None:
        self._boot_ns = boot_ns
        self._beat_ns = boot_ns()
        self._stall: Stall | None = None
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stalls", daemon=True)

    def beat(self) -> None:
        """Note that the thread has woken."""
        with self._lock:
            self._note(self._boot_ns())

    def take(self) -> Stall | None:
        """Return the stall since the last call, one that still goes on included; None without."""
        with self._lock:
            now_ns = self._boot_ns()
            if now_ns - self._beat_ns > _LIMIT_NS:
                self._note(now_ns)
            stall, self._stall = self._stall, None
        return stall

    def start(self) -> None:
        """Begin to measure."""
        self._beat_ns = self._boot_ns()
        self._thread.start()

    def close(self) -> None:
        """Measure no more."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()

    def _note(self, now_ns: int) -> None:
        if now_ns - self._beat_ns > _LIMIT_NS:
            from_ns = self._beat_ns if self._stall is None else self._stall[0]
            self._stall = from_ns, now_ns
        self._beat_ns = now_ns

    def _run(self) -> None:
        while not self._end.wait(BEAT_S):
            self.beat()


_LIMIT_NS = round(BEAT_S * NS) + LATE_NS
