"""How late the watcher evaluates what is recorded, measured and written by a thread of its own."""

from __future__ import annotations

import threading

from amberbox.blackbox.store import Store
from amberbox.core.clock import NS, Clock
from amberbox.monitoring.messages.pulse import OVERLOADED_S, write_pulse

PERIOD_S = 1.0
STARTING_NS = 60 * NS
"""A watcher that has just begun may take so long to catch up with the record."""


class Lateness:
    """Measures the time from the writing of rows to the end of their evaluation.

    Everything recorded before a look at the record ``began`` is evaluated once it ``ended``. Time
    is that since the computer's start: a stop of this process counts, so does a suspend.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self._begun_ns = self._done_ns = clock.boot_ns()
        self._is_starting = True
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sign of life", daemon=True)
        self.is_overloaded = False

    def began(self) -> None:
        """Take note that a look at the record begins."""
        self._begun_ns = self._clock.boot_ns()

    def ended(self) -> float | None:
        """Take note that all that the look found is evaluated.

        Returns how late that was, in seconds, when monitoring has become overloaded, 0.0 when it
        is no more; None if neither.
        """
        late_s, was_overloaded = self.delay_s(), self.is_overloaded
        self._done_ns, self._is_starting = self._begun_ns, False
        self.is_overloaded = late_s > OVERLOADED_S
        if self.is_overloaded == was_overloaded:
            return None
        return late_s if self.is_overloaded else 0.0

    def delay_s(self) -> float:
        """Return how old the oldest rows may be that are not evaluated yet, in seconds."""
        late_ns = self._clock.boot_ns() - self._done_ns
        return 0.0 if self._is_starting and late_ns < STARTING_NS else late_ns / NS

    def start(self) -> None:
        """Begin to give signs of life."""
        self._thread.start()

    def close(self) -> None:
        """Give no signs of life any more."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(PERIOD_S)

    def _run(self) -> None:
        while not self._end.is_set():
            write_pulse(self._store, self._clock, self.delay_s())
            self._end.wait(PERIOD_S)
