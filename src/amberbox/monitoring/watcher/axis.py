"""The log time of the recorder that is followed, as the watcher's own journal goes by it."""

from __future__ import annotations

from dataclasses import dataclass, field

from amberbox.core.clock import Clock
from amberbox.monitoring.watcher.epoch import Epoch


@dataclass(slots=True)
class RecordAxis:
    """Stamps what the watcher writes: on the epoch's axis, after everything evaluated so far.

    A record of another boot, or one whose time does not count from the computer's start, has no
    time that passes by itself: there it is right after what was evaluated last.
    """

    clock: Clock
    epoch: Epoch
    same_boot: bool
    _passed_ns: int = field(default=0)

    def passed(self, until_ns: int) -> None:
        """Take note that everything up to an instant is evaluated."""
        self._passed_ns = max(self._passed_ns, until_ns)

    def now_ns(self) -> int:
        """Log time now, always after what is evaluated."""
        now_ns = self.epoch.base_ns + self.clock.boot_ns() if self._runs else 0
        return max(now_ns, self._passed_ns + 1)

    def boot_ns(self, log_ns: int) -> int | None:
        """Time since the computer's start at a log time; None if that is not known."""
        return log_ns - self.epoch.base_ns if self._runs else None

    def offset_ns(self) -> int:
        """Wall minus log time."""
        return self.clock.wall_ns() - self.now_ns() if self._runs else 0

    def synchronised(self) -> bool | None:
        """Tell whether the wall clock is disciplined; None if nobody can know."""
        return self.clock.synchronised()

    @property
    def _runs(self) -> bool:
        return self.same_boot and self.epoch.counts_from_boot
