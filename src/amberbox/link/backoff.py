"""How long to wait before trying again: longer each time, and never all robots at once."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from amberbox.link.limits import BACKOFF_S


@dataclass(slots=True)
class Backoff:
    """Waits between attempts: doubled each time, between half and the whole of it at random."""

    chance: random.Random = field(default_factory=random.Random)
    least_s: float = BACKOFF_S[0]
    most_s: float = BACKOFF_S[1]
    _failures: int = 0

    def failed(self) -> float:
        """Return how many seconds to wait after one more failure."""
        whole_s = min(self.least_s * 2.0 ** min(self._failures, 16), self.most_s)
        self._failures += 1
        return max(self.least_s, whole_s * self.chance.uniform(0.5, 1.0))

    def succeeded(self) -> None:
        """Begin with short waits again."""
        self._failures = 0
