"""The causes of alarms: what the diagnosis that is open says of their components.

Alarms with the same leading cause become one; a cause that is urgent and has none raises its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from amberbox.core.errors import UsageError
from amberbox.core.types import Diagnosis, FaultFacts, Status
from amberbox.monitoring.engine.alarms import FOLLOWS, NEVER_NS, Action
from amberbox.monitoring.engine.findings import AlarmChange, Finding
from amberbox.monitoring.messages.diagnoses import diagnosis_of, diagnosis_values
from amberbox.monitoring.messages.records import alarm_of, alarm_values
from amberbox.monitoring.watcher.blame import Blame, Share, component_of
from amberbox.monitoring.watcher.instants import instant_of
from amberbox.monitoring.watcher.raising import GATHER_NS, Raised


@dataclass(slots=True)
class Causes:
    """Gives alarms their cause, and says them again when a diagnosis changes it.

    What it gives depends on nothing but the findings in their order. What people said of an
    alarm, which a replay does not know, is kept apart and said again after it. Where ``facts``
    of failure modes are known, alarms with one cause are one: the others are its ``_parts``
    (which by which). An alarm that opens while others last is held back for a moment, until the
    diagnosis knows what it belongs to.
    """

    facts: Mapping[str, FaultFacts] = field(default_factory=dict)
    raised: Raised = field(default_factory=Raised, compare=False)
    diagnosis: Diagnosis | None = None
    """The last revision of the diagnosis that is open."""
    _now: Blame = field(default_factory=Blame)
    _alarms: dict[str, AlarmChange] = field(default_factory=dict)
    _people: dict[str, AlarmChange] = field(default_factory=dict)
    _blocked: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _held: dict[str, tuple[int, AlarmChange]] = field(default_factory=dict)
    _parts: dict[str, str] = field(default_factory=dict)
    _until_ns: int = 0

    def through(
        self, findings: Iterable[Finding], until_ns: int | None = None
    ) -> Iterator[Finding]:
        """Give findings with what they mean for alarms, up to an instant."""
        for finding in findings:
            if self.facts:
                yield from self._pass(instant_of(finding) - 1)
            if isinstance(finding, AlarmChange):
                yield from self._hear(finding)
                continue
            yield finding
            if isinstance(finding, Diagnosis):
                yield from self._turned(finding)
            elif isinstance(finding, Status) and not finding.mode:
                self._note_blocked(finding)
        if self.facts and until_ns is not None:
            yield from self._pass(until_ns)

    def _pass(self, until_ns: int) -> Iterator[AlarmChange]:
        """Do what is due up to an instant."""
        while (due_ns := min([self.raised.next_ns(), *self._dues()], default=NEVER_NS)) <= until_ns:
            for key, (at_ns, _) in list(self._held.items()):
                if at_ns <= due_ns:
                    yield from self._let_go(key, due_ns)
            yield from self._regroup(due_ns)
        self._until_ns = max(self._until_ns, until_ns)

    def _dues(self) -> Iterator[int]:
        return (due_ns for due_ns, _ in self._held.values())

    def _hear(self, alarm: AlarmChange) -> Iterator[AlarmChange]:
        """Take an alarm of the monitors after a change."""
        if not self.facts:
            yield self.take(alarm)
        elif alarm.id in self._parts:
            self.take(alarm)
            if alarm.state == "healed":
                del self._parts[alarm.id]
            yield from self._regroup(alarm.changed_ns)
        elif alarm.id in self._held and alarm.state == "open":
            self._held[alarm.id] = self._held[alarm.id][0], alarm
        elif alarm.id not in self._held and self._is_to_be_held(alarm):
            self._held[alarm.id] = alarm.changed_ns + GATHER_NS, alarm
            if self._now.share(alarm.component):
                yield from self._let_go(alarm.id, alarm.changed_ns)
        else:
            if alarm.id in self._held:
                yield from self._let_go(alarm.id, alarm.changed_ns)
            yield self.take(alarm)
            yield from self._regroup(alarm.changed_ns)

    def _is_to_be_held(self, alarm: AlarmChange) -> bool:
        """Tell whether an alarm opens that may belong to what lasts already."""
        is_new = alarm.id not in self._alarms and alarm.state == "open" and not alarm.live_only
        return is_new and bool(self._alarms)

    def _let_go(self, key: str, now_ns: int) -> Iterator[AlarmChange]:
        """Say an alarm that was held back, or make it part of the one that has its cause."""
        _, alarm = self._held.pop(key)
        named = self.take(alarm)
        root = self._roots().get(key)
        if root is None:
            yield named
        else:
            self._parts[key] = root
        yield from self._regroup(now_ns)

    def take(self, alarm: AlarmChange) -> AlarmChange:
        """Take note of an alarm after a change, and return it with its cause."""
        named = self._named(alarm)
        known = self._alarms.get(alarm.id)
        self._people.pop(alarm.id, None)
        if alarm.live_only and known is not None and alarm.state != known.state:
            self._people[alarm.id] = named
        elif alarm.state == "healed":
            self._alarms.pop(alarm.id, None)
        elif not alarm.live_only:
            self._alarms[alarm.id] = named
        return named

    def _named(self, alarm: AlarmChange) -> AlarmChange:
        """Return an alarm with its cause; without one if it is not concerned."""
        also = self._alarms[alarm.id].also if alarm.id in self._alarms else alarm.also
        share = self._share(alarm)
        if share:
            text = self._now.text(share)
            return replace(alarm, cause=text, diagnosis=self._now.diagnosis, also=also)
        cause = "" if alarm.diagnosis else alarm.cause
        return replace(alarm, cause=cause, diagnosis="", also=also)

    def _share(self, alarm: AlarmChange) -> Share:
        return self._now.share(alarm.component)

    def know(self, standing: Sequence[AlarmChange]) -> None:
        """Take note of alarms that lasted before anything was heard of them."""
        for alarm in standing:
            if alarm.id in self._alarms or alarm.id in self._held:
                continue
            own = replace(alarm, state="open", who="", until_ns=None, live_only=False)
            self.take(own)
            if alarm.live_only:
                self.take(alarm)

    def named(self, standing: Sequence[AlarmChange]) -> list[AlarmChange]:
        """Return alarms as they stand, with their causes and those that diagnoses have raised."""
        hidden = self._parts.keys() | self._held.keys()
        shown = [alarm for alarm in (*standing, *self.raised.standing()) if alarm.id not in hidden]
        return [self._dated(self._named(alarm)) for alarm in shown]

    def command(
        self, action: Action, alarm_id: str, who: str, at_ns: int, until_ns: int | None = None
    ) -> list[AlarmChange] | None:
        """Do what a person says of an alarm that a diagnosis has raised; None for another.

        Raises UsageError if it makes no sense, or the alarm is part of another.
        """
        if alarm_id in self._parts:
            root = self._parts[alarm_id]
            raise UsageError(f"the alarm '{alarm_id}' is part of '{root}' now", f"name '{root}'")
        if all(alarm.id != alarm_id for alarm in self.raised.standing()):
            return None
        return self.raised.command(action, alarm_id, who, at_ns, until_ns)

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
        self._now = Blame.of(self.diagnosis, self._blocked, self.facts)
        own = {alarm.id for alarm in self.raised.standing()}
        for key, alarm in list(self._alarms.items()):
            named = self._named(alarm)
            if not named.cause and key in own:
                continue  # it heals
            if (named.cause, named.diagnosis) != (alarm.cause, alarm.diagnosis):
                yield from self._again(key, named, diagnosis.at_ns)
        for key, (_, alarm) in list(self._held.items()):
            if self._share(alarm):
                yield from self._let_go(key, diagnosis.at_ns)
        if self.facts:
            yield from self._regroup(diagnosis.at_ns)

    def _again(self, key: str, named: AlarmChange, at_ns: int) -> Iterator[AlarmChange]:
        """Say an alarm again, and what people said of it; a part is not said."""
        self._alarms[key] = named = replace(named, changed_ns=at_ns)
        if key in self._parts:
            return
        yield named
        if key in self._people:
            said = replace(self._named(self._people[key]), changed_ns=at_ns)
            self._people[key] = said
            yield said

    def _regroup(self, now_ns: int) -> Iterator[AlarmChange]:
        """Raise and heal alarms of the diagnosis; make one alarm of those with one cause."""
        own = {alarm.id for alarm in self.raised.standing()}
        others = [(a, self._share(a)) for key, a in self._alarms.items() if key not in own]
        others += [(alarm, self._share(alarm)) for _, alarm in self._held.values()]
        for change in self.raised.look(self._now, others, now_ns):
            known = self._alarms.get(change.id, change)
            named = self.take(change)
            if change.state != "healed":
                yield named
            elif self._parts.pop(change.id, None) is None:  # its last record keeps its cause
                yield replace(named, cause=known.cause, diagnosis=known.diagnosis)
        roots = self._roots()
        for key in [key for key in self._parts if key not in roots]:
            del self._parts[key]
            yield from self._again(key, replace(self._alarms[key], also=()), now_ns)
        for key, root in roots.items():
            if key not in self._parts:
                self._people.pop(key, None)
                reason = FOLLOWS + self._alarms[root].component
                alarm = replace(self._alarms[key], state="healed", reason=reason, also=())
                yield replace(alarm, changed_ns=now_ns)
        self._parts = roots
        yield from self._list_parts(now_ns)

    def _roots(self) -> dict[str, str]:
        """Return the alarms that are part of another, and of which."""
        groups: dict[Share, list[str]] = {}
        for key, alarm in self._alarms.items():
            share = self._share(alarm)
            if self._now.is_one(share):
                groups.setdefault(share, []).append(key)
        roots: dict[str, str] = {}
        for share, keys in groups.items():
            failed = {component_of(fault) for faults in share for fault in faults}
            root = min(keys, key=lambda key: self._order(key, failed))
            roots |= {key: root for key in keys if key != root}
        return roots

    def _order(self, key: str, failed: set[str]) -> tuple[bool, bool, int, str]:
        """Order alarms with one cause: first of what has failed, then what was said already."""
        alarm = self._alarms[key]
        return alarm.component not in failed, key in self._parts, alarm.opened_ns, key

    def _list_parts(self, now_ns: int) -> Iterator[AlarmChange]:
        """Say an alarm again whose parts are others than before."""
        parts: dict[str, set[str]] = {}
        for key, root in self._parts.items():
            parts.setdefault(root, set()).add(self._alarms[key].component)
        for key, alarm in list(self._alarms.items()):
            also = tuple(sorted(parts.get(key, set()) - {alarm.component}))
            if key not in self._parts and also != alarm.also:
                yield from self._again(key, replace(alarm, also=also), now_ns)

    def snapshot(self) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON."""
        return {
            "diagnosis": None if self.diagnosis is None else diagnosis_values(self.diagnosis),
            "blamed": self._now.blocked,
            "alarms": [alarm_values(alarm) for alarm in self._alarms.values()],
            "people": [alarm_values(alarm) for alarm in self._people.values()],
            "blocked": self._blocked,
            "held": [[due_ns, alarm_values(alarm)] for due_ns, alarm in self._held.values()],
            "parts": self._parts,
            "raised": self.raised.snapshot(self._until_ns),
            "until_ns": self._until_ns,
        }

    def resume(self, held: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned, also of a version that raised no alarms."""
        last = held["diagnosis"]
        self.diagnosis = None if last is None else diagnosis_of(last)
        self._blocked = {name: tuple(by) for name, by in held["blocked"].items()}
        self._now = Blame.of(self.diagnosis, held.get("blamed", self._blocked), self.facts)
        self._alarms = {values["id"]: alarm_of(values) for values in held["alarms"]}
        self._people = {values["id"]: alarm_of(values) for values in held["people"]}
        self._held = {v["id"]: (due_ns, alarm_of(v)) for due_ns, v in held.get("held", ())}
        self._parts = dict(held.get("parts", {}))
        if "raised" in held:
            self.raised.resume(held["raised"])
        self._until_ns = held.get("until_ns", 0)
