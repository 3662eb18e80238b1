"""The causes of alarms: what the diagnosis that is open says of their components."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.engine.findings import AlarmChange, Finding
from amberbox.monitoring.messages.diagnoses import diagnosis_of, diagnosis_values
from amberbox.monitoring.messages.records import alarm_of, alarm_values
from amberbox.monitoring.watcher.leading import cause, leading

_ENDS = re.compile(r"[/#.]")
"""What ends a component in the address of an output, in a failure mode, in a symptom's name."""


@dataclass(frozen=True, slots=True)
class _Said:
    """What the open diagnosis says, and of which components."""

    text: str = ""
    diagnosis: str = ""
    components: frozenset[str] = frozenset()

    def of(self, alarm: AlarmChange) -> AlarmChange:
        """Return an alarm with its cause; without one if it is not concerned."""
        if alarm.component in self.components:
            return replace(alarm, cause=self.text, diagnosis=self.diagnosis)
        return replace(alarm, cause="", diagnosis="") if alarm.diagnosis else alarm


@dataclass(slots=True)
class Causes:
    """Gives alarms their cause, and says them again when a diagnosis changes it.

    What it gives depends on nothing but the findings in their order. What people said of an
    alarm, which a replay does not know, is kept apart and said again after it.
    """

    diagnosis: Diagnosis | None = None
    """The last revision of the diagnosis that is open."""
    _now: _Said = _Said()
    _alarms: dict[str, AlarmChange] = field(default_factory=dict)
    _people: dict[str, AlarmChange] = field(default_factory=dict)
    _blocked: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def through(self, findings: Iterable[Finding]) -> Iterator[Finding]:
        """Give findings with what they mean for alarms."""
        for finding in findings:
            if isinstance(finding, AlarmChange):
                yield self.take(finding)
                continue
            yield finding
            if isinstance(finding, Diagnosis):
                yield from self._turned(finding)
            elif isinstance(finding, Status) and not finding.mode:
                self._note_blocked(finding)

    def take(self, alarm: AlarmChange) -> AlarmChange:
        """Take note of an alarm after a change, and return it with its cause."""
        named = self._now.of(alarm)
        known = self._alarms.get(alarm.id)
        self._people.pop(alarm.id, None)
        if alarm.live_only and known is not None and alarm.state != known.state:
            self._people[alarm.id] = named
        elif alarm.state == "healed":
            self._alarms.pop(alarm.id, None)
        elif not alarm.live_only:
            self._alarms[alarm.id] = named
        return named

    def know(self, standing: Sequence[AlarmChange]) -> None:
        """Take note of alarms that lasted before anything was heard of them."""
        for alarm in standing:
            if alarm.id in self._alarms:
                continue
            own = replace(alarm, state="open", who="", until_ns=None, live_only=False)
            self.take(own)
            if alarm.live_only:
                self.take(alarm)

    def named(self, standing: Sequence[AlarmChange]) -> list[AlarmChange]:
        """Return alarms as they stand, with their causes."""
        return [self._dated(self._now.of(alarm)) for alarm in standing]

    def _dated(self, alarm: AlarmChange) -> AlarmChange:
        known = self._alarms.get(alarm.id)
        changed_ns = alarm.changed_ns if known is None else known.changed_ns
        return replace(alarm, changed_ns=max(alarm.changed_ns, changed_ns))

    def _note_blocked(self, status: Status) -> None:
        if status.blocked_by:
            self._blocked[status.component] = status.blocked_by
        else:
            self._blocked.pop(status.component, None)

    def _turned(self, diagnosis: Diagnosis) -> Iterator[AlarmChange]:
        """Go over to a revision; give the alarms anew of which it says something else."""
        is_open = diagnosis.state == "open"
        self.diagnosis = diagnosis if is_open else None
        concerned = frozenset(_concerned(diagnosis, self._blocked)) if is_open else frozenset()
        self._now = _Said(cause(diagnosis), diagnosis.id, concerned)
        for key, alarm in list(self._alarms.items()):
            named = self._now.of(alarm)
            if (named.cause, named.diagnosis) == (alarm.cause, alarm.diagnosis):
                continue
            self._alarms[key] = named = replace(named, changed_ns=diagnosis.at_ns)
            yield named
            if key in self._people:
                said = self._now.of(self._people[key])
                self._people[key] = said = replace(said, changed_ns=diagnosis.at_ns)
                yield said

    def snapshot(self) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON."""
        return {
            "diagnosis": None if self.diagnosis is None else diagnosis_values(self.diagnosis),
            "text": self._now.text,
            "of": self._now.diagnosis,
            "components": sorted(self._now.components),
            "alarms": [alarm_values(alarm) for alarm in self._alarms.values()],
            "people": [alarm_values(alarm) for alarm in self._people.values()],
            "blocked": self._blocked,
        }

    def resume(self, held: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        last = held["diagnosis"]
        self.diagnosis = None if last is None else diagnosis_of(last)
        self._now = _Said(held["text"], held["of"], frozenset(held["components"]))
        self._alarms = {values["id"]: alarm_of(values) for values in held["alarms"]}
        self._people = {values["id"]: alarm_of(values) for values in held["people"]}
        self._blocked = {name: tuple(by) for name, by in held["blocked"].items()}


def _concerned(diagnosis: Diagnosis, blocked: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Name the components that the leading answer is about.

    Those that it says have failed, those whose symptoms it explains, and what blocks these.
    """
    for hypothesis in leading(diagnosis):
        yield from (_component(fault) for fault in hypothesis.faults)
        for symptom in hypothesis.explains:
            name = _component(symptom)
            yield name
            yield from (_component(by) for by in blocked.get(name, ()))


def _component(name: str) -> str:
    return _ENDS.split(name, maxsplit=1)[0]
