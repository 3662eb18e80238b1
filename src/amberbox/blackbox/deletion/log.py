"""Deletions as events: summed up, for under pressure there are many a second."""

from __future__ import annotations

import time
from dataclasses import dataclass

from amberbox.blackbox.deletion.rule import Removal
from amberbox.blackbox.keeper.ownjournal import Record, event
from amberbox.blackbox.segments.entries import Tombstone
from amberbox.core.timetext import format_time

PERIOD_S = 60.0
_WORDS = {"raw": "raw journals", "columns": "columns", "both": "journals with their columns"}


@dataclass(slots=True)
class _Sum:
    """Deletions of one kind that no event tells of yet."""

    count: int
    size: int
    from_ns: int
    to_ns: int
    first: str
    last: str


class DeletionLog:
    """Adds up what was deleted; the first one of a series is told at once."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str, bool], _Sum] = {}
        self._told_s = -PERIOD_S

    def add(self, removal: Removal, tombstone: Tombstone) -> None:
        """Take note of one deletion."""
        key = (tombstone.what, tombstone.reason, tombstone.confirmed)
        name, start_ns, end_ns = tombstone.journals[0], tombstone.start_ns, tombstone.end_ns
        known = self._sums.get(key)
        if known is None:
            self._sums[key] = _Sum(1, removal.freed_bytes, start_ns, end_ns, name, name)
            return
        known.count += 1
        known.size += removal.freed_bytes
        known.from_ns, known.to_ns = min(known.from_ns, start_ns), max(known.to_ns, end_ns)
        known.last = name

    def due(self, *, now: bool = False) -> list[Record]:
        """Return the events to be written now; ``forget`` them once they are."""
        if not self._sums or not (now or time.monotonic() - self._told_s >= PERIOD_S):
            return []
        return [_event(*key, found) for key, found in self._sums.items()]

    def forget(self) -> None:
        """Begin to count anew: what was due is written."""
        self._sums.clear()
        self._told_s = time.monotonic()


def _event(what: str, reason: str, confirmed: bool, found: _Sum) -> Record:
    start, end = format_time(found.from_ns), format_time(found.to_ns)
    known = "confirmed by a server" if confirmed else "not confirmed by a server"
    text = f"{found.count} {_WORDS[what]} deleted {reason}, {start} to {end}, {known}"
    return event(
        "deleted", text, what=what, reason=reason, confirmed=confirmed, journals=found.count,
        first=found.first, last=found.last, bytes=found.size, from_ns=found.from_ns,
        to_ns=found.to_ns,
    )  # fmt: skip
