"""Clocks: the machine's own, and the one a run of the recorder stamps with."""

from __future__ import annotations

import ctypes
import time
from pathlib import Path
from typing import Protocol

NS = 1_000_000_000


class Clock(Protocol):
    """What the recorder asks of a clock; ``amberbox.testing`` has one that is moved by hand."""

    def wall_ns(self) -> int:
        """Nanoseconds since the Unix epoch; may step."""

    def boot_ns(self) -> int:
        """Nanoseconds since boot, suspend included; never steps."""

    def boot_id(self) -> str:
        """Identify the boot that ``boot_ns`` counts from."""

    def synchronised(self) -> bool | None:
        """Tell whether wall time is disciplined by a reference; None if nobody can know."""


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


class RunClock:
    """Log time: wall time when the epoch began plus boot time since; it never steps.

    ``new_epoch`` starts again from wall time, after a step that is too large to live with.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.new_epoch()

    def new_epoch(self) -> None:
        """Take wall time as it is now for the start of log time."""
        self._base_ns = self.clock.wall_ns() - self.clock.boot_ns()

    def now_ns(self) -> int:
        """Log time now, nanoseconds."""
        return self._base_ns + self.clock.boot_ns()

    def boot_ns(self, log_ns: int) -> int:
        """Nanoseconds since boot at a log time of this epoch."""
        return log_ns - self._base_ns

    def offset_ns(self) -> int:
        """Wall minus log time: 0 until the wall clock is stepped or slewed."""
        return self.clock.wall_ns() - self.now_ns()

    def synchronised(self) -> bool | None:
        """Tell whether the wall clock is disciplined; None if nobody can know."""
        return self.clock.synchronised()
