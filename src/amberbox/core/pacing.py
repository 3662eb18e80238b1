"""Pacing: backoff with jitter between attempts, and token buckets for bytes or requests."""

from __future__ import annotations

import random
import threading
from dataclasses import dataclass, field


@dataclass(slots=True)
class Backoff:
    """Waits between attempts: doubled each time, then random from half to all of that."""

    chance: random.Random = field(default_factory=random.Random)
    least_s: float = 0.5
    most_s: float = 30.0
    _failures: int = 0

    def failed(self) -> float:
        """Return how many seconds to wait after one more failure."""
        whole_s = min(self.least_s * 2.0 ** min(self._failures, 16), self.most_s)
        self._failures += 1
        return max(self.least_s, whole_s * self.chance.uniform(0.5, 1.0))

    def succeeded(self) -> None:
        """Reset to the shortest wait."""
        self._failures = 0


@dataclass(slots=True)
class TokenBucket:
    """Limits a rate: ``rate`` tokens a second, 0 for no limit; ``burst`` at once, else 1/4 s."""

    rate: float
    burst: float = 0.0
    _tokens: float = 0.0
    _at_s: float | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def take(self, count: float, now_s: float) -> float:
        """Take tokens; return the seconds to wait before they may be used.

        More than the burst may be taken at once: the next one waits longer.
        """
        if not self.rate:
            return 0.0
        with self._lock:  # threads share one
            self._fill(now_s)
            self._tokens -= count
            return max(0.0, -self._tokens / self.rate)

    def take_one(self, now_s: float) -> float:
        """Take a token if one is available; return 0, or the seconds until there is one."""
        with self._lock:
            self._fill(now_s)
            if self._tokens < 1.0:
                return (1.0 - self._tokens) / self.rate
            self._tokens -= 1.0
            return 0.0

    def _fill(self, now_s: float) -> None:
        burst = self.burst or self.rate / 4
        if self._at_s is None:
            self._tokens = burst
        else:
            self._tokens = min(burst, self._tokens + max(now_s - self._at_s, 0.0) * self.rate)
        self._at_s = now_s
