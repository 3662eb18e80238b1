"""Causes of alarms from the open diagnosis, and alarms that a diagnosis raises itself."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.robot_status import SEVERITIES, Severity
from amberbox.core.types import (
    UNKNOWN_FAULT,
    Diagnosis,
    FaultFacts,
    Hypothesis,
    Level,
    Status,
)
from amberbox.core.units import LIKELY, confidence_word, percent
from amberbox.monitoring.alarms import FOLLOWS, NEVER_NS, ComponentAlarms, PersonAction
from amberbox.monitoring.component_states import NO_MONITOR, Blocker, OwnState, highest
from amberbox.monitoring.findings import (
    AlarmChange,
    Finding,
    alarm_of,
    alarm_values,
    diagnosis_of,
    diagnosis_values,
    instant_of,
)

_MOST_NAMED: Final = 3  # of hypotheses that cannot be distinguished; the rest is counted
_LEAST_SHOWN: Final = 0.05  # probability from which an alternative answer is shown


def faults_text(faults: Sequence[Collection[str]], probability: float) -> str:
    """Return alternative sets of faults as text, with a word for the probability."""
    return f"{_either(faults)} ({confidence_word(probability)})"


def leading_probability(diagnosis: Diagnosis) -> float:
    """Return the probability of the leading answer."""
    if diagnosis.groups:
        return diagnosis.groups[0].probability
    return diagnosis.hypotheses[0].probability if diagnosis.hypotheses else 0.0


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Return the leading answer, likely alternatives and the next test in one line of text."""
    if diagnosis.state == "healed":
        return "healed"
    groups = [(diagnosis.members(g), g.probability) for g in diagnosis.groups]
    worth = [f"{hypotheses_text(m)} ({percent(p)})" for m, p in groups[:1]]
    worth += [f"{hypotheses_text(m)} ({percent(p)})" for m, p in groups[1:3] if p >= _LEAST_SHOWN]
    tests = diagnosis.next_tests
    safe = "; ".join(diagnosis.make_safe)
    first = f"; first, make it safe: {safe}" if safe else ""
    next_test = f"; {'then' if safe else 'next'}: {tests[0].text or tests[0].id}" if tests else ""
    return (", or ".join(worth) or "no answer") + first + next_test


def hypotheses_text(hypotheses: Sequence[Hypothesis]) -> str:
    """Return alternative hypotheses as text."""
    return _either([hypothesis.faults for hypothesis in hypotheses])


def _either(sets: Sequence[Collection[str]]) -> str:
    names = [_name(faults) for faults in sets[:_MOST_NAMED]]
    more = len(sets) - len(names)
    return " or ".join([*names, f"one of {more} more"] if more else names)


def _name(faults: Collection[str]) -> str:
    names = ("not in the FMEA" if fault == UNKNOWN_FAULT else fault for fault in sorted(faults))
    return " + ".join(names) or "a false alarm"


# alternative sets of faults that an alarm comes from
CauseSets: TypeAlias = tuple[frozenset[str], ...]
URGENT: Final[frozenset[Severity]] = frozenset(SEVERITIES[SEVERITIES.index("urgent") :])
_POSSIBLE: Final = 0.2
# what follows the component in an address, failure mode or symptom
_COMPONENT_END = re.compile(r"[/#.]")


class RaisedCause(NamedTuple):
    """A leading cause for an alarm: one or several failure modes, named after the first.

    ``is_credible``: it is likely, or possible if the robot must not continue.
    """

    faults: tuple[str, ...]
    severity: Severity
    symptoms: tuple[str, ...]
    is_credible: bool


@dataclass(frozen=True, slots=True)
class LeadingAnswer:
    """The leading answer of the open diagnosis; of none, without members.

    ``blocked`` is what blocked each component at that time, ``facts`` are those of failure modes;
    without facts an alarm is about all failure modes of the answer.
    """

    diagnosis: str = ""
    members: tuple[Hypothesis, ...] = ()
    probability: float = 0.0
    blocked: Mapping[str, Sequence[str]] = field(default_factory=dict)
    facts: Mapping[str, FaultFacts] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        diagnosis: Diagnosis | None,
        blocked: Mapping[str, Sequence[str]],
        facts: Mapping[str, FaultFacts],
    ) -> LeadingAnswer:
        """Return the leading answer of an open diagnosis."""
        if diagnosis is None or diagnosis.state != "open":
            return cls()
        return cls(
            diagnosis.id, diagnosis.leading(), leading_probability(diagnosis), dict(blocked), facts
        )

    def share(self, component: str) -> CauseSets:
        """Return the causes of a component's alarm; empty if the diagnosis does not concern it.

        It concerns components that have failed, those whose symptoms are explained, and those that
        block these. The failures of a component itself come before failures of others that it
        shows.
        """
        found = (self._of(hypothesis, component) for hypothesis in self.members)
        return tuple(dict.fromkeys(faults for faults in found if faults is not None))

    def _of(self, hypothesis: Hypothesis, component: str) -> frozenset[str] | None:
        own = frozenset(fault for fault in hypothesis.faults if component_of(fault) == component)
        if own:
            return own
        here = {symptom for symptom in hypothesis.explains if self._is_at(symptom, component)}
        if not here:
            return None
        shown = frozenset(
            fault
            for fault in hypothesis.faults
            if fault in self.facts and not here.isdisjoint(self.facts[fault].shows)
        )
        return shown or hypothesis.faults

    def _is_at(self, symptom: str, component: str) -> bool:
        name = component_of(symptom)
        return name == component or component in map(component_of, self.blocked.get(name, ()))

    def text(self, share: CauseSets) -> str:
        """Return the causes of an alarm as text, with a word for their probability."""
        return faults_text(share, self.probability) if share else ""

    def is_one(self, share: CauseSets) -> bool:
        """Return whether alarms with these causes are merged: all failure modes known and
        likely.
        """
        known = bool(share) and all(
            faults and all(fault in self.facts for fault in faults) for faults in share
        )
        return known and self.probability >= LIKELY

    def causes(self) -> Iterator[RaisedCause]:
        """Yield the single causes that are urgent or worse.

        A failure mode of all members is a cause. All other failure modes together are one cause.
        """
        sets = [hypothesis.faults for hypothesis in self.members]
        common = frozenset.intersection(*sets) if sets else frozenset[str]()
        rest = [faults - common for faults in sets]
        alternatives: list[tuple[str, ...]] = [(fault,) for fault in sorted(common)]
        if rest and all(rest):
            alternatives.append(tuple(dict.fromkeys(f for faults in rest for f in sorted(faults))))
        for faults in alternatives:
            severities = [self.facts[fault].severity for fault in faults if fault in self.facts]
            if len(severities) == len(faults) and highest(severities) in URGENT:
                severity = highest(severities)
                least = LIKELY if severity == "urgent" else _POSSIBLE
                shown = self._shown_by(faults)
                yield RaisedCause(faults, severity, shown, self.probability >= least)

    def _shown_by(self, faults: Sequence[str]) -> tuple[str, ...]:
        shows = frozenset[str]().union(*(self.facts[fault].shows for fault in faults))
        explained = (s for hypothesis in self.members for s in hypothesis.explains if s in shows)
        return tuple(dict.fromkeys(explained))


def component_of(name: str) -> str:
    """Return the component that an output, a failure mode or a symptom belongs to."""
    return _COMPONENT_END.split(name, maxsplit=1)[0]


GATHER_NS: Final = 2 * NS  # how long alarms of one onset are collected before they are emitted

_WELL: Final = OwnState("ok", "nominal", "", "warning")


class DiagnosedAlarms:
    """Alarms by failure mode: call ``update`` whenever diagnosis or alarms have changed.

    A cause gets an alarm once, here or from a monitor, and no other until the diagnosis has dropped
    the cause.
    """

    def __init__(self, robot: str = "", config_hash: str = "") -> None:
        self._alarms = ComponentAlarms(robot, config_hash)
        self._due_ns: dict[str, int] = {}
        self._had: set[str] = set()

    def next_ns(self) -> int:
        """Return the next instant (ns) at which an alarm may change without new findings."""
        return min([self._alarms.next_ns(), *self._due_ns.values()], default=NEVER_NS)

    def active(self) -> list[AlarmChange]:
        """Return the active alarms in their present state."""
        return [_public(alarm) for alarm in self._alarms.active()]

    def update(
        self, blame: LeadingAnswer, others: Iterable[tuple[AlarmChange, CauseSets]], now_ns: int
    ) -> list[AlarmChange]:
        """Raise and heal alarms; ``others`` are those of monitors that last, and their causes."""
        again, changes = self._alarms.due(now_ns)
        active = {alarm.component for alarm in self._alarms.active()}
        causes = {self._key(cause, active): cause for cause in blame.causes()}
        gone = sorted(active - causes.keys())
        urgent = [
            frozenset[str]().union(*share) for alarm, share in others if alarm.severity in URGENT
        ]
        covered = {key for key, cause in causes.items() if any(s & {*cause.faults} for s in urgent)}
        new = [key for key in causes if key not in active | self._had | self._due_ns.keys()]
        self._had = (self._had | covered) & causes.keys()
        for key in causes:
            if key in self._had or not causes[key].is_credible:
                self._due_ns.pop(key, None)
            else:  # withdrawn only once the new cause has an alarm
                self._due_ns.setdefault(key, now_ns if gone else now_ns + GATHER_NS)
        self._due_ns = {key: at_ns for key, at_ns in self._due_ns.items() if key in causes}
        for key, cause in causes.items():
            if key in active or key in again or self._due_ns.get(key, NEVER_NS) <= now_ns:
                changes += self._alarms.update(key, now_ns, _own(cause), ())
                self._due_ns.pop(key, None)
                self._had.add(key)
        instead = [Blocker(component_of(key), "", "", 0, faulty=True) for key in new[:1]]
        for key in gone:
            own = NO_MONITOR._replace(level="error") if instead else _WELL
            changes += self._alarms.update(key, now_ns, own, instead)
        return [_public(change) for change in changes]

    def _key(self, cause: RaisedCause, active: Collection[str]) -> str:
        """Return the failure mode that names a cause: one that has an alarm, else the first."""
        keys = [fault.replace("#", ".") for fault in cause.faults]
        known = [active, self._had, self._due_ns]
        return next((key for some in known for key in keys if key in some), keys[0])

    def command(self, alarm_id: str, done: PersonAction) -> list[AlarmChange]:
        """Apply a person's action to an alarm; raises UsageError if that is not possible."""
        return [_public(change) for change in self._alarms.command(alarm_id, done)]

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """Return the state that is needed to continue, as JSON."""
        had = sorted(self._had)
        return {"alarms": self._alarms.snapshot(now_ns), "due_ns": self._due_ns, "had": had}

    def resume(self, snapshot_values: Mapping[str, Any]) -> None:
        """Continue from the values that ``snapshot`` returned."""
        self._alarms.resume(snapshot_values["alarms"])
        self._due_ns, self._had = dict(snapshot_values["due_ns"]), set(snapshot_values["had"])


def _own(cause: RaisedCause) -> OwnState:
    names = ", ".join(cause.symptoms[:_MOST_NAMED])
    more = len(cause.symptoms) - _MOST_NAMED
    reason = f"diagnosed from {names}" + (f" and {more} more" if more > 0 else "")
    level: Level = "warn" if cause.severity == "urgent" else "error"
    return OwnState(level, "diagnosed", reason, cause.severity)


def _public(alarm: AlarmChange) -> AlarmChange:
    return replace(alarm, component=component_of(alarm.component))


@dataclass(slots=True)
class AlarmCauses:
    """Adds causes to alarms, and emits an alarm again when a diagnosis changes its cause.

    The causes depend only on the findings in their order. A person's actions on an alarm, which a
    replay does not know, are stored separately and emitted again after it. If ``facts`` of failure
    modes are known, alarms with the same cause are merged: the others are its ``_parts`` (alarm id
    by merged alarm). An alarm that opens while others are active is held back for a moment, until
    the diagnosis knows its cause.
    """

    facts: Mapping[str, FaultFacts] = field(default_factory=dict)
    raised: DiagnosedAlarms = field(default_factory=DiagnosedAlarms, compare=False)
    diagnosis: Diagnosis | None = None
    """The last revision of the diagnosis that is open."""
    _now: LeadingAnswer = field(default_factory=LeadingAnswer)
    _alarms: dict[str, AlarmChange] = field(default_factory=dict)
    _user_changes: dict[str, AlarmChange] = field(default_factory=dict)
    _blocked: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _deferred: dict[str, tuple[int, AlarmChange]] = field(default_factory=dict)
    _parts: dict[str, str] = field(default_factory=dict)
    _until_ns: int = 0

    def process(
        self, findings: Iterable[Finding], until_ns: int | None = None
    ) -> Iterator[Finding]:
        """Yield findings and the alarm changes that follow from them, up to an instant."""
        for finding in findings:
            if self.facts:
                yield from self._advance(instant_of(finding) - 1)
            if isinstance(finding, AlarmChange):
                yield from self._receive(finding)
                continue
            yield finding
            if isinstance(finding, Diagnosis):
                yield from self._diagnosis_changed(finding)
            elif isinstance(finding, Status) and not finding.mode:
                if finding.blocked_by:
                    self._blocked[finding.component] = finding.blocked_by
                else:
                    self._blocked.pop(finding.component, None)
        if self.facts and until_ns is not None:
            yield from self._advance(until_ns)

    def _advance(self, until_ns: int) -> Iterator[AlarmChange]:
        """Yield the alarm changes that are due up to an instant."""
        while (
            due_ns := min(
                [self.raised.next_ns(), *(at_ns for at_ns, _ in self._deferred.values())],
                default=NEVER_NS,
            )
        ) <= until_ns:
            for key, (at_ns, _) in list(self._deferred.items()):
                if at_ns <= due_ns:
                    yield from self._release(key, due_ns)
            yield from self._regroup(due_ns)
        self._until_ns = max(self._until_ns, until_ns)

    def _receive(self, alarm: AlarmChange) -> Iterator[AlarmChange]:
        """Process a changed alarm of the monitors."""
        if not self.facts:
            yield self.take(alarm)
        elif alarm.id in self._parts:
            self.take(alarm)
            if alarm.state == "healed":
                del self._parts[alarm.id]
            yield from self._regroup(alarm.changed_ns)
        elif alarm.id in self._deferred and alarm.state == "open":
            self._deferred[alarm.id] = self._deferred[alarm.id][0], alarm
        elif alarm.id not in self._deferred and self._should_defer(alarm):
            self._deferred[alarm.id] = alarm.changed_ns + GATHER_NS, alarm
            if self._now.share(alarm.component):
                yield from self._release(alarm.id, alarm.changed_ns)
        else:
            if alarm.id in self._deferred:
                yield from self._release(alarm.id, alarm.changed_ns)
            yield self.take(alarm)
            yield from self._regroup(alarm.changed_ns)

    def _should_defer(self, alarm: AlarmChange) -> bool:
        """Return whether a newly opened alarm may share its cause with an active one."""
        is_new = alarm.id not in self._alarms and alarm.state == "open" and not alarm.live_only
        return is_new and bool(self._alarms)

    def _release(self, key: str, now_ns: int) -> Iterator[AlarmChange]:
        """Emit a deferred alarm, or make it part of the one with its cause."""
        _, alarm = self._deferred.pop(key)
        named = self.take(alarm)
        root = self._roots().get(key)
        if root is None:
            yield named
        else:
            self._parts[key] = root
        yield from self._regroup(now_ns)

    def take(self, alarm: AlarmChange) -> AlarmChange:
        """Record a changed alarm, and return it with its cause."""
        named = self._named(alarm)
        known = self._alarms.get(alarm.id)
        self._user_changes.pop(alarm.id, None)
        if alarm.live_only and known is not None and alarm.state != known.state:
            self._user_changes[alarm.id] = named
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

    def _share(self, alarm: AlarmChange) -> CauseSets:
        return self._now.share(alarm.component)

    def adopt(self, active: Sequence[AlarmChange]) -> None:
        """Adopt alarms that were active before the first finding."""
        for alarm in active:
            if alarm.id in self._alarms or alarm.id in self._deferred:
                continue
            own = replace(
                alarm, state="open", who="", until_ns=None, live_only=False, note="", said_ns=None,
                command="",
            )  # fmt: skip
            self.take(own)
            if alarm.live_only:
                self.take(alarm)

    def named(self, active: Sequence[AlarmChange]) -> list[AlarmChange]:
        """Return alarms in their present state with causes, also those raised by diagnoses."""
        hidden = self._parts.keys() | self._deferred.keys()
        shown = [alarm for alarm in (*active, *self.raised.active()) if alarm.id not in hidden]
        return [self._dated(self._named(alarm)) for alarm in shown]

    def command(self, alarm_id: str, done: PersonAction) -> list[AlarmChange] | None:
        """Apply a person's action to an alarm that a diagnosis raised; None for another alarm.

        Raises UsageError if it is not possible, or the alarm is part of another.
        """
        if alarm_id in self._parts:
            root = self._parts[alarm_id]
            raise UsageError(f"the alarm '{alarm_id}' is part of '{root}' now", f"name '{root}'")
        if all(alarm.id != alarm_id for alarm in self.raised.active()):
            return None
        return self.raised.command(alarm_id, done)

    def _dated(self, alarm: AlarmChange) -> AlarmChange:
        known = self._alarms.get(alarm.id)
        changed_ns = alarm.changed_ns if known is None else known.changed_ns
        return replace(alarm, changed_ns=max(alarm.changed_ns, changed_ns))

    def _diagnosis_changed(self, diagnosis: Diagnosis) -> Iterator[AlarmChange]:
        """Process a revision of the diagnosis; yield the alarms whose cause it changes."""
        is_open = diagnosis.state == "open"
        self.diagnosis = diagnosis if is_open else None
        self._now = LeadingAnswer.of(self.diagnosis, self._blocked, self.facts)
        own = {alarm.id for alarm in self.raised.active()}
        for key, alarm in list(self._alarms.items()):
            named = self._named(alarm)
            if not named.cause and key in own:
                continue  # it heals
            if (named.cause, named.diagnosis) != (alarm.cause, alarm.diagnosis):
                yield from self._emit_again(key, named, diagnosis.at_ns)
        for key, (_, alarm) in list(self._deferred.items()):
            if self._share(alarm):
                yield from self._release(key, diagnosis.at_ns)
        if self.facts:
            yield from self._regroup(diagnosis.at_ns)

    def _emit_again(self, key: str, named: AlarmChange, at_ns: int) -> Iterator[AlarmChange]:
        """Emit an alarm again with the action of a person on it, unless it is part of another."""
        self._alarms[key] = named = replace(named, changed_ns=at_ns)
        if key in self._parts:
            return
        yield named
        if key in self._user_changes:
            change = replace(self._named(self._user_changes[key]), changed_ns=at_ns)
            self._user_changes[key] = change
            yield change

    def _regroup(self, now_ns: int) -> Iterator[AlarmChange]:
        """Raise and heal alarms of the diagnosis; make one alarm of those with one cause."""
        own = {alarm.id for alarm in self.raised.active()}
        others = [(a, self._share(a)) for key, a in self._alarms.items() if key not in own]
        others += [(alarm, self._share(alarm)) for _, alarm in self._deferred.values()]
        for change in self.raised.update(self._now, others, now_ns):
            known = self._alarms.get(change.id, change)
            named = self.take(change)
            if change.state != "healed":
                yield named
            elif self._parts.pop(change.id, None) is None:  # its last record keeps its cause
                yield replace(named, cause=known.cause, diagnosis=known.diagnosis)
        roots = self._roots()
        for key in [key for key in self._parts if key not in roots]:
            del self._parts[key]
            yield from self._emit_again(key, replace(self._alarms[key], also=()), now_ns)
        for key, root in roots.items():
            if key not in self._parts:
                self._user_changes.pop(key, None)
                reason = FOLLOWS + self._alarms[root].component
                alarm = replace(self._alarms[key], state="healed", reason=reason, also=())
                yield replace(alarm, changed_ns=now_ns)
        self._parts = roots
        yield from self._list_parts(now_ns)

    def _roots(self) -> dict[str, str]:
        """Return the alarms that are part of another, with that other alarm."""
        groups: dict[CauseSets, list[str]] = {}
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
        """Return the order of alarms with one cause: of failed components first, then those emitted
        already.
        """
        alarm = self._alarms[key]
        return alarm.component not in failed, key in self._parts, alarm.opened_ns, key

    def _list_parts(self, now_ns: int) -> Iterator[AlarmChange]:
        """Emit again the alarms whose parts have changed."""
        parts: dict[str, set[str]] = {}
        for key, root in self._parts.items():
            parts.setdefault(root, set()).add(self._alarms[key].component)
        for key, alarm in list(self._alarms.items()):
            also = tuple(sorted(parts.get(key, set()) - {alarm.component}))
            if key not in self._parts and also != alarm.also:
                yield from self._emit_again(key, replace(alarm, also=also), now_ns)

    def snapshot(self) -> dict[str, Any]:
        """Return the state that is needed to continue, as JSON."""
        return {
            "diagnosis": None if self.diagnosis is None else diagnosis_values(self.diagnosis),
            "blamed": self._now.blocked,
            "alarms": [alarm_values(alarm) for alarm in self._alarms.values()],
            "people": [alarm_values(alarm) for alarm in self._user_changes.values()],
            "blocked": self._blocked,
            "held": [[due_ns, alarm_values(alarm)] for due_ns, alarm in self._deferred.values()],
            "parts": self._parts,
            "raised": self.raised.snapshot(self._until_ns),
            "until_ns": self._until_ns,
        }

    def resume(self, snapshot_values: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned, also of a version that raised no alarms."""
        last = snapshot_values["diagnosis"]
        self.diagnosis = None if last is None else diagnosis_of(last)
        self._blocked = {name: tuple(by) for name, by in snapshot_values["blocked"].items()}
        self._now = LeadingAnswer.of(
            self.diagnosis, snapshot_values.get("blamed", self._blocked), self.facts
        )
        self._alarms = {values["id"]: alarm_of(values) for values in snapshot_values["alarms"]}
        self._user_changes = {
            values["id"]: alarm_of(values) for values in snapshot_values["people"]
        }
        self._deferred = {
            v["id"]: (due_ns, alarm_of(v)) for due_ns, v in snapshot_values.get("held", ())
        }
        self._parts = dict(snapshot_values.get("parts", {}))
        if "raised" in snapshot_values:
            self.raised.resume(snapshot_values["raised"])
        self._until_ns = snapshot_values.get("until_ns", 0)
