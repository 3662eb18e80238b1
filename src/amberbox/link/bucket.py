"""A token bucket: at most so many bytes a second, a short burst allowed."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field


@dataclass(slots=True)
class TokenBucket:
    """Says how long to wait before sending; ``rate`` in bytes/s, 0 for no limit."""

    rate: float
    burst: float = 0.0
    _tokens: float = 0.0
    _at_s: float | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def take(self, size: int, now_s: float) -> float:
        """Take bytes that are about to be sent; return the seconds to wait before.

        More than the burst may be taken at once: whoever comes next waits longer.
        """
        if not self.rate:
            return 0.0
        burst = self.burst or self.rate / 4
        with self._lock:  # rows and journals share one
            elapsed = burst / self.rate if self._at_s is None else now_s - self._at_s
            self._tokens = min(burst, self._tokens + max(elapsed, 0.0) * self.rate)
            self._at_s = now_s
            self._tokens -= size
            return max(0.0, -self._tokens / self.rate)
