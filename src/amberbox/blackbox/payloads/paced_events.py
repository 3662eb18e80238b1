"""Events that peers cause, which they must not be able to flood the record with."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from amberbox.core.pacing import TokenBucket
from amberbox.core.source import Sink

AT_ONCE, PER_S = 30, 0.2
_LONGEST = 500
_MOST_KEYS = 1000


@dataclass
class PacedEvents:
    """Records 30 events at once, then one each 5 s; states how many were left out."""

    sink: Sink
    clock_s: Callable[[], float] = time.monotonic
    _pace: TokenBucket = field(default_factory=lambda: TokenBucket(PER_S, AT_ONCE))
    _left_out: int = 0
    _keys: set[str] = field(default_factory=set)

    def add(self, kind: str, text: str, **details: Any) -> None:
        """Record an event, unless there were too many."""
        if self._pace.take_one(self.clock_s()):
            self._left_out += 1
            return
        if self._left_out:
            more = f"{self._left_out} events were left out before: there were too many"
            self.sink.event("events_left_out", more, count=self._left_out)
            self._left_out = 0
        self.sink.event(kind, text[:_LONGEST], **details)

    def add_once(self, kind: str, text: str, **details: Any) -> None:
        """Record an event unless the same was recorded since ``forget``."""
        if text not in self._keys and len(self._keys) < _MOST_KEYS:
            self._keys.add(text)
            self.add(kind, text, **details)

    def forget(self) -> None:
        """Record again what is the same as before."""
        self._keys.clear()
