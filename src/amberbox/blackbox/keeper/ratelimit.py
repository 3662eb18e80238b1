"""How often triggers may pin: a chattering one leaves room for the others, and is told of."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from amberbox.blackbox.incidents.incident import Incident
from amberbox.blackbox.keeper.ownjournal import Record, event
from amberbox.core.clock import NS

_HOUR_S = 3600.0


def refused_by_rate(
    trigger: str, at_ns: int, hold_off_s: float, incidents: Iterable[Incident], per_hour: int
) -> str:
    """Say why a trigger may not pin now; empty if it may.

    One trigger may use half of what all of them may.
    """
    fired = [(r.trigger, at_ns - r.at_ns) for i in incidents for r in i.reasons if r.trigger]
    if any(name == trigger and 0 <= ago < hold_off_s * NS for name, ago in fired):
        return f"it fired less than {hold_off_s:g} s ago"
    recent = [name for name, ago in fired if abs(ago) < _HOUR_S * NS]
    if len(recent) >= per_hour:
        return f"there were {per_hour} incidents in an hour"
    if recent.count(trigger) >= math.ceil(per_hour / 2):
        return f"it fired {recent.count(trigger)} times in an hour"
    return ""


@dataclass(slots=True)
class _Count:
    """Firings of one trigger that were not told of yet."""

    since_s: float
    count: int = 0
    why: str = ""


@dataclass
class Refusals:
    """Tells of firings that pinned nothing: the first one at once, then once an hour."""

    _counts: dict[str, _Count] = field(default_factory=dict)

    def note(self, trigger: str, why: str, text: str) -> Iterator[Record]:
        """Take a firing; give an event if it is time for one."""
        known = self._counts.get(trigger)
        if known is None:
            self._counts[trigger] = _Count(time.monotonic())
            yield _event(trigger, 1, why, text)
            return
        known.count, known.why = known.count + 1, why
        yield from self.due()

    def due(self, *, all_of_them: bool = False) -> Iterator[Record]:
        """Give the events that are due; at the end all that is left."""
        for trigger, known in list(self._counts.items()):
            if all_of_them or time.monotonic() - known.since_s >= _HOUR_S:
                del self._counts[trigger]
                if known.count:
                    yield _event(trigger, known.count, known.why, "")


def _event(trigger: str, count: int, why: str, text: str) -> Record:
    times = "once" if count == 1 else f"{count} times more"
    what = f"{trigger or 'somebody'} fired {times} and nothing was pinned: {why}"
    return event(
        "incident_refused", what, trigger, count=count, trigger=trigger, why=why, reason=text
    )
