"""The alarms that last, as the journal has them: said anew in each file, and by new monitors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from amberbox.blackbox.follow.read import JournalFile, newest_first, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.store import Store
from amberbox.monitoring.engine.findings import AlarmChange, Finding
from amberbox.monitoring.messages.records import alarm_of

CHANGED = "the configuration or the version has changed"
"""Why an alarm is over that new monitors do not have."""


@dataclass(slots=True)
class Standing:
    """Knows which alarms last: those of the journal until the engine has come as far."""

    left: Mapping[str, AlarmChange]
    """What the last watcher has left in its journal, by id."""
    alarms: Callable[[], Sequence[AlarmChange]]
    """Asks the engine."""
    settled: bool = False

    def again(self) -> list[AlarmChange]:
        """Return what each file of the journal begins with: older files may be deleted."""
        lasting = self.alarms() if self.settled else self.left.values()
        return [replace(alarm, live_only=True) for alarm in lasting]

    def settle(self, found: Sequence[Finding], at_ns: int, *, anew: bool) -> list[AlarmChange]:
        """Go over to the engine's alarms; return what differs from the journal.

        Only an engine that began ``anew`` differs; ``found`` is written anyway.
        """
        self.settled = True
        if not anew:
            return []
        said = {finding.id for finding in found if isinstance(finding, AlarmChange)}
        lasting = {alarm.id: replace(alarm, live_only=True) for alarm in self.alarms()}
        gone = [a for key, a in self.left.items() if key not in lasting and key not in said]
        other = [
            alarm
            for key, alarm in lasting.items()
            if key not in said and _told(alarm) != _told(self.left.get(key))
        ]
        return [*(_over(alarm, at_ns) for alarm in gone), *other]


def standing_in(store: Store) -> dict[str, AlarmChange]:
    """Return the alarms that last by the newest file of the watcher's journal: it has them all."""
    for journal in newest_first(store, "watch"):
        if journal.places:
            return _standing_in(journal)
    return {}


def _standing_in(journal: JournalFile) -> dict[str, AlarmChange]:
    numbers = [n for n, s in journal.streams.items() if s.topic.name == reserved.ALARM]
    newest = {}
    for chunk in sound_chunks(journal) if numbers else ():
        for message in chunk.messages(np.flatnonzero(np.isin(chunk.channel, numbers))):
            alarm = alarm_of(msgspec.json.decode(message))
            newest[alarm.id] = alarm
    return {key: alarm for key, alarm in newest.items() if alarm.state != "healed"}


def _told(alarm: AlarmChange | None) -> object:
    """Return what of an alarm matters to those who read of it."""
    if alarm is None:
        return None
    return (
        alarm.state, alarm.severity, alarm.level, alarm.reason, alarm.count, alarm.who,
        alarm.until_ns,
    )  # fmt: skip


def _over(alarm: AlarmChange, at_ns: int) -> AlarmChange:
    changed_ns = max(at_ns, alarm.changed_ns)
    return replace(
        alarm, state="healed", reason=CHANGED, changed_ns=changed_ns, who="", until_ns=None,
        live_only=True,
    )  # fmt: skip
