"""What lasts, as the journal has it: said anew in each file, and by new monitors.

These are the alarms that have not healed, and the diagnosis that is open.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import msgspec
import numpy as np

from amberbox.blackbox.follow.read import JournalFile, newest_first, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.store import Store
from amberbox.core.types import Diagnosis
from amberbox.monitoring.engine.findings import AlarmChange, Finding
from amberbox.monitoring.messages.diagnoses import diagnosis_of
from amberbox.monitoring.messages.records import alarm_of

CHANGED = "the configuration or the version has changed"
"""Why an alarm is over that new monitors do not have."""


class Knows(Protocol):
    """Knows what lasts now."""

    @property
    def diagnosis(self) -> Diagnosis | None:
        """The last revision of the diagnosis that is open."""

    def alarms(self) -> Sequence[AlarmChange]:
        """Return the alarms that last, as they stand."""


@dataclass(frozen=True, slots=True)
class Left:
    """What the last watcher has left in its journal, by id."""

    alarms: Mapping[str, AlarmChange] = field(default_factory=dict)
    diagnoses: Mapping[str, Diagnosis] = field(default_factory=dict)


@dataclass(slots=True)
class Standing:
    """Knows what lasts: by the journal, until the engine has come as far."""

    left: Left
    engine: Knows
    settled: bool = False

    def again(self) -> list[Finding]:
        """Return what each file of the journal begins with: older files may be deleted."""
        if not self.settled:
            lasting: Iterable[AlarmChange] = self.left.alarms.values()
            open_ones: Iterable[Diagnosis] = self.left.diagnoses.values()
        else:
            lasting, now = self.engine.alarms(), self.engine.diagnosis
            open_ones = () if now is None else (now,)
        return [
            *(replace(diagnosis, live_only=True) for diagnosis in open_ones),
            *(replace(alarm, live_only=True) for alarm in lasting),
        ]

    def settle(self, found: Sequence[Finding], at_ns: int, *, anew: bool) -> list[Finding]:
        """Go over to what the engine knows; return what differs from the journal.

        Only an engine that began ``anew`` differs; ``found`` is written anyway.
        """
        self.settled = True
        if not anew:
            return []
        return [*self._diagnoses(found, at_ns), *self._alarms(found, at_ns)]

    def _diagnoses(self, found: Sequence[Finding], at_ns: int) -> list[Diagnosis]:
        """Return how the diagnoses end that are open in the journal, and the one that is now."""
        now = self.engine.diagnosis
        said = {finding.id for finding in found if isinstance(finding, Diagnosis)}
        own = said if now is None else {now.id, *said}
        gone = [closed(d, at_ns) for key, d in self.left.diagnoses.items() if key not in own]
        if now is None or now.id in said:
            return gone
        return [*gone, replace(now, live_only=True)]

    def _alarms(self, found: Sequence[Finding], at_ns: int) -> list[AlarmChange]:
        said = {finding.id for finding in found if isinstance(finding, AlarmChange)}
        lasting = {alarm.id: replace(alarm, live_only=True) for alarm in self.engine.alarms()}
        gone = [a for key, a in self.left.alarms.items() if key not in lasting and key not in said]
        other = [
            alarm
            for key, alarm in lasting.items()
            if key not in said and _told(alarm) != _told(self.left.alarms.get(key))
        ]
        return [*(_over(alarm, at_ns) for alarm in gone), *other]


def standing_in(store: Store) -> Left:
    """Return what lasts by the newest file of the watcher's journal: it has it all."""
    for journal in newest_first(store, "watch"):
        if journal.places:
            return _standing_in(journal)
    return Left()


def _standing_in(journal: JournalFile) -> Left:
    alarms = {alarm.id: alarm for alarm in map(alarm_of, _records(journal, reserved.ALARM))}
    diagnoses = {d.id: d for d in map(diagnosis_of, _records(journal, reserved.DIAGNOSIS))}
    return Left(
        {key: alarm for key, alarm in alarms.items() if alarm.state != "healed"},
        {key: diagnosis for key, diagnosis in diagnoses.items() if diagnosis.state == "open"},
    )


def _records(journal: JournalFile, channel: str) -> Iterator[Any]:
    numbers = [n for n, s in journal.streams.items() if s.topic.name == channel]
    for chunk in sound_chunks(journal) if numbers else ():
        for message in chunk.messages(np.flatnonzero(np.isin(chunk.channel, numbers))):
            yield msgspec.json.decode(message)


def _told(alarm: AlarmChange | None) -> object:
    """Return what of an alarm matters to those who read of it."""
    if alarm is None:
        return None
    return (
        alarm.state, alarm.severity, alarm.level, alarm.reason, alarm.count, alarm.who,
        alarm.until_ns, alarm.cause, alarm.diagnosis,
    )  # fmt: skip


def _over(alarm: AlarmChange, at_ns: int) -> AlarmChange:
    changed_ns = max(at_ns, alarm.changed_ns)
    return replace(
        alarm, state="healed", reason=CHANGED, changed_ns=changed_ns, who="", until_ns=None,
        live_only=True,
    )  # fmt: skip


def closed(diagnosis: Diagnosis, at_ns: int) -> Diagnosis:
    """Return the last revision of a diagnosis that nobody goes on with."""
    return replace(
        diagnosis, state="healed", revision=diagnosis.revision + 1,
        at_ns=max(at_ns, diagnosis.at_ns), live_only=True,
    )  # fmt: skip
