"""Up to when the record is complete: sources whose messages come late hold it back, bounded."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class LateSource:
    """A source that passes messages on later than they were received.

    ``complete_ns`` is up to when it has passed on all of them (log time); None while it does not
    run. It holds the watermark back by ``late_ns`` at most.
    """

    late_ns: int
    complete_ns: int | None = None


@dataclass(slots=True)
class RecordWatermark:
    """The log time before which no message can be recorded any more; belongs to the writing thread.

    ``add`` may be called from any thread, and each source sets its own ``complete_ns``.
    """

    at_ns: int = 0
    _late: list[LateSource] = field(default_factory=list)
    _seen: list[tuple[int, int]] = field(default_factory=list)

    def add(self, late_ns: int) -> LateSource:
        """Add a source that may be late."""
        source = LateSource(late_ns)
        self._late.append(source)
        return source

    def look(self) -> None:
        """Note what the sources promise: before the queue is taken, which then has it all."""
        self._seen = [
            (source.late_ns, complete_ns)
            for source in self._late
            if (complete_ns := source.complete_ns) is not None
        ]

    def advance(self, now_ns: int) -> int:
        """Advance as far as the promises allow; return the new watermark."""
        marks = [max(complete_ns, now_ns - late_ns) for late_ns, complete_ns in self._seen]
        self.at_ns = max(self.at_ns, min([now_ns, *marks]))
        return self.at_ns

    def begin(self, now_ns: int, step_ns: int) -> None:
        """Begin a new epoch of log time, which differs from the last one by ``step_ns``."""
        self.at_ns = now_ns
        for source in self._late:
            if source.complete_ns is not None:
                source.complete_ns += step_ns

    def release(self) -> None:
        """Wait for no source any more: the run ends."""
        self._late = []
