"""How far the server's clock is from the robot's: from the quickest of its answers."""

from __future__ import annotations

from dataclasses import dataclass

STEP_NS = 50_000_000
"""A robot's wall clock that moved more than this against its time since boot was set."""


@dataclass(slots=True)
class OffsetEstimate:
    """Server's clock minus robot's wall clock in this boot, by the least round trip.

    The answer may have been delayed either way, so the error is at most half of ``round_ns``.
    """

    offset_ns: int | None = None
    round_ns: int | None = None
    _base_ns: int | None = None

    def add(self, sent_ns: int, received_ns: int, server_ns: int, wall_ns: int) -> None:
        """Take one answer: times since boot when asked and answered, both wall clocks.

        ``wall_ns`` is the robot's when the answer came. Once it has been set, what was measured
        before is forgotten.
        """
        round_ns, base_ns = received_ns - sent_ns, wall_ns - received_ns
        if round_ns < 0:
            return
        if self._base_ns is not None and abs(base_ns - self._base_ns) > STEP_NS:
            self.round_ns = None
        if self.round_ns is None or round_ns < self.round_ns:
            self.offset_ns = server_ns - (wall_ns - round_ns // 2)
            self.round_ns, self._base_ns = round_ns, base_ns
