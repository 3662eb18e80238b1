"""Clocks: wall and boot time of the machine, and the log time of a recorder's run."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

NS = 1_000_000_000


class Clock(Protocol):
    """The clock interface of the recorder; ``amberbox.testing`` has one that tests move by hand."""

    def wall_ns(self) -> int:
        """Return nanoseconds since the Unix epoch; may step."""

    def boot_ns(self) -> int:
        """Return nanoseconds since boot, suspend included; never steps."""

    def boot_id(self) -> str:
        """Return the id of the boot that ``boot_ns`` counts from."""

    def synchronised(self) -> bool | None:
        """Return whether wall time is disciplined by a reference; None if not known."""


class SystemClock:
    """The machine's clocks (CLOCK_REALTIME, CLOCK_BOOTTIME, adjtimex)."""

    def wall_ns(self) -> int:
        return time.time_ns()

    def boot_ns(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def boot_id(self) -> str:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()

    def synchronised(self) -> bool | None:
        buffer = ctypes.create_string_buffer(256)  # struct timex, larger than any ABI's
        try:
            state = int(ctypes.CDLL(None).adjtimex(buffer))
        except (OSError, AttributeError):
            return None
        time_error = 5  # TIME_ERROR: the clock is not synchronised
        return None if state < 0 else state != time_error


_TRIES, _EXACT_NS = 5, 50_000


class StampConverter:
    """Converts stamps of the kernel into log time: those of datagrams, frames and input events.

    ``clock_id`` is the clock of the stamps: CLOCK_REALTIME for SO_TIMESTAMPNS and packet rings,
    often CLOCK_MONOTONIC for input devices. A step of the wall clock between stamp and call moves a
    time by the step, but neither into the future nor before an earlier one. One converter per
    stream: its times never decrease.
    """

    def __init__(self, now_ns: Callable[[], int], clock_id: int = time.CLOCK_REALTIME) -> None:
        """``now_ns`` returns log time, as ``Sink.now_ns`` does."""
        self._now_ns = now_ns
        self._clock_id = clock_id
        self._last_ns = 0

    def log_ns(self, stamp_ns: int) -> int:
        """Return the log time of a stamp, ns."""
        for _ in range(_TRIES):
            before_ns = time.clock_gettime_ns(self._clock_id)
            now_ns = self._now_ns()
            after_ns = time.clock_gettime_ns(self._clock_id)
            if after_ns - before_ns < _EXACT_NS:  # else this thread was interrupted amid it
                break
        age_ns = max(0, (before_ns + after_ns) // 2 - stamp_ns)
        self._last_ns = min(max(now_ns - age_ns, self._last_ns), now_ns)
        return self._last_ns


class LogClock(Protocol):
    """The source of log time for records: a RunClock, or the log time of another recorder."""

    def now_ns(self) -> int:
        """Log time now."""

    def boot_ns(self, log_ns: int) -> int | None:
        """Return nanoseconds since boot at a log time; None if that does not count from boot."""

    def offset_ns(self) -> int:
        """Wall minus log time."""

    def synchronised(self) -> bool | None:
        """Return whether the wall clock is disciplined; None if not known."""


class RunClock:
    """Log time in ns: wall time when the epoch began plus boot time since; it never steps.

    ``new_epoch`` starts again from wall time, after a step that is too large to tolerate.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.new_epoch()

    def new_epoch(self) -> None:
        """Start log time again from the present wall time."""
        self._base_ns = self.clock.wall_ns() - self.clock.boot_ns()

    def now_ns(self) -> int:
        """Return log time now, nanoseconds."""
        return self._base_ns + self.clock.boot_ns()

    def boot_ns(self, log_ns: int) -> int:
        """Nanoseconds since boot at a log time of this epoch."""
        return log_ns - self._base_ns

    def offset_ns(self) -> int:
        """Return wall minus log time, nanoseconds: 0 until the wall clock is stepped or slewed."""
        return self.clock.wall_ns() - self.now_ns()

    def synchronised(self) -> bool | None:
        """Return whether the wall clock is disciplined; None if not known."""
        return self.clock.synchronised()
