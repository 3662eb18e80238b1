"""From readings to a state that counts: it has lasted, and a long time on battery is low."""

from __future__ import annotations

from dataclasses import dataclass

from amberbox.core.source import Power


@dataclass(frozen=True, slots=True)
class Limits:
    """How long a change must last, and how long the battery is trusted."""

    for_s: float = 1.0
    low_after_s: float | None = None


@dataclass
class Judge:
    """Keeps the state that counts, on a monotonic clock.

    A run that begins with ``low`` is on battery until it has been better: the run before has
    ended because of it, and one that is started again shall record and not end at once.
    """

    limits: Limits
    state: Power | None = None
    _candidate: Power | None = None
    _since_s: float = 0.0
    _on_battery_s: float | None = None
    _was_better: bool = False

    def heard(self, state: Power, now_s: float) -> bool:
        """Take what the supplies say now; tell whether the state that counts has changed.

        The first state counts at once.
        """
        self._was_better = self._was_better or state != "low"
        state = self._after_long(state, now_s) if self._was_better else "battery"
        if state != self._candidate:
            self._candidate, self._since_s = state, now_s
        has_lasted = self.state is None or now_s - self._since_s >= self.limits.for_s
        if state == self.state or not has_lasted:
            return False
        self.state = state
        return True

    def _after_long(self, state: Power, now_s: float) -> Power:
        if state == "mains":
            self._on_battery_s = None
            return state
        if self._on_battery_s is None:
            self._on_battery_s = now_s
        limit = self.limits.low_after_s
        return "low" if limit is not None and now_s - self._on_battery_s >= limit else state
