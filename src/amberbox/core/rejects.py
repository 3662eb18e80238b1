"""Input that a source cannot use: counted as lost, with an event that shows an example."""

from __future__ import annotations

from dataclasses import dataclass, field

from amberbox.core.clock import NS
from amberbox.core.safe_text import one_line
from amberbox.core.source import Sink

REPORT_NS = NS  # between two reports of losses
EVENT_NS = 60 * NS  # between two events
_SHOWN = 60


@dataclass
class RejectCounter:
    """Counts rejected input of one topic; ``report`` passes the counts on once a second.

    The topic must be registered with the sink before.
    """

    sink: Sink
    topic: str
    peer: str
    _counts: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    _reported_ns: int = 0
    _event_ns: int | None = None

    def add(self, reason: str, example: bytes | str = b"") -> None:
        """Count one message that is left out; ``reason`` is a constant, not its content."""
        now_ns = self.sink.now_ns()
        first_ns, _, count = self._counts.get(reason, (now_ns, now_ns, 0))
        self._counts[reason] = first_ns, now_ns, count + 1
        if self._event_ns is None or now_ns - self._event_ns >= EVENT_NS:
            self._event_ns = now_ns
            text = example.decode(errors="replace") if isinstance(example, bytes) else example
            shown = f": {one_line(text[:_SHOWN])}" if text else ""
            self.sink.event("malformed_input", f"{self.peer}: {reason}{shown}", topic=self.topic)

    def report(self, *, now: bool = False) -> None:
        """Report the counts as losses if it is time, or in any case."""
        now_ns = self.sink.now_ns()
        if not self._counts or (not now and now_ns - self._reported_ns < REPORT_NS):
            return
        self._reported_ns = now_ns
        for reason, (first_ns, last_ns, count) in self._counts.items():
            self.sink.lost(self.topic, self.peer, first_ns, last_ns, count, reason)
        self._counts = {}
