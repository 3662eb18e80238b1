"""A recorder that says nothing: then nothing is known, whatever was known before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.types import Status

GONE_S = 2.0
"""Without a recorder the record ends; statuses are said to be unknown after this long."""
STUCK_S = 3.0
"""A recorder writes once a second at least, however silent its sources are."""
_PERIOD_S = 1.0


@dataclass(slots=True)
class Silence:
    """Watches by the machine's steady clock whether the record goes on.

    Silence reaches from when the record went on last to when it was looked at last: how long the
    watcher took for what it found there, or was held up, is not the recorder's silence. One look
    that finds nothing proves none.
    """

    clock_s: Callable[[], float]
    _heard_s: float = field(init=False)
    _looked_s: float = field(init=False)
    _told_s: float | None = None
    _empty: int = 0
    """How many looks in a row have found nothing."""

    def __post_init__(self) -> None:
        self._heard_s = self._looked_s = self.clock_s()

    def looked(self) -> None:
        """Take note that the record is being looked at."""
        self._looked_s, self._empty = self.clock_s(), self._empty + 1

    def heard(self) -> None:
        """Take note that the record has gone on."""
        self._heard_s, self._told_s, self._empty = self.clock_s(), None, 0

    def due(self, *, is_recording: bool) -> float:
        """Return for how many seconds nothing has come, once a second; 0 if that is no matter."""
        now_s = self._looked_s
        silent_s = now_s - self._heard_s
        if self._empty < 2 or silent_s <= (STUCK_S if is_recording else GONE_S):
            return 0.0
        if self._told_s is not None and now_s - self._told_s < _PERIOD_S:
            return 0.0
        self._told_s = now_s
        return silent_s


def silent(silent_s: float) -> str:
    """Say that the recorder is silent."""
    return f"the recorder has written nothing for {silent_s:.0f} s"


def unknown(
    statuses: Sequence[Status], now_ns: int, silent_s: float, reason: str
) -> Iterator[Status]:
    """Say of everything that it is not known; a replay cannot see that."""
    since_ns = now_ns - round(silent_s * 1e9)
    for status in statuses:
        yield replace(
            status, level="unknown", state="unknown", outputs=dict.fromkeys(status.outputs),
            measured_ns=now_ns, since_ns=since_ns, reason=reason, blocked_by=(), live_only=True,
        )  # fmt: skip
