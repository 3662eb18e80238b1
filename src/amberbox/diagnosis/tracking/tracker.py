"""The tracker: what monitors and the record say over time in, diagnoses and revisions out.

It looks at no clock. Conditions are evaluated at multiples of a quarter of a second of the record's
log time, revisions made at multiples of half a second. How rows and findings are split into calls
does not change what comes out; so live and replay give the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from heapq import merge
from itertools import groupby
from typing import Any, Final, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import Batch, Diagnosis, FaultFacts, Status, Symptom
from amberbox.diagnosis.answering import Effort, Heading, answer
from amberbox.diagnosis.covering.budget import Budget
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation
from amberbox.diagnosis.tracking.absence import Waits
from amberbox.diagnosis.tracking.conditions import Conditions
from amberbox.diagnosis.tracking.opening import FORGOTTEN_NS, Opening, identified
from amberbox.diagnosis.tracking.presence import Counts, Presences
from amberbox.diagnosis.tracking.repair import Repairs, leading_faults

__all__ = ["Tracker"]

HALF_NS: Final = NS // 2
"""Revisions come at multiples of this; only the first comes at once."""
EFFORT = Effort(budget=Budget(nodes=1_000))
"""What a revision may cost: nodes alone, so that it is the same on every machine."""
VERSION: Final = 2

Event: TypeAlias = tuple[int, bool, Symptom]
"""When something was told, whether by a condition of the FMEA, and what."""
Out: TypeAlias = "list[Symptom | Diagnosis]"


class Tracker:
    """Tracks the faults of one robot: ``begin`` an epoch, ``feed`` rows, ``advance``."""

    def __init__(self, knowledge: Knowledge) -> None:
        self.knowledge = knowledge
        self._conditions = Conditions(knowledge.fmea)
        self._presences = Presences(knowledge.fmea)
        self._waits = Waits(knowledge.fmea)
        self._repairs = Repairs(self._waits.shows)
        self._waits_ns: dict[str, int] = {}
        self._until_ns = 0
        self._pending: list[Symptom] = []
        self._opening: Opening | None = None
        self._last_id = ""
        self._due_ns: int | None = None

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose rows the FMEA's own conditions read."""
        return self._conditions.items

    @property
    def history_s(self) -> float:
        """How far back rows have to be fed again after ``resume``, in seconds."""
        return self._conditions.history_s

    @property
    def facts(self) -> Mapping[str, FaultFacts]:
        """What is known of failure modes: the gravest of what each costs, what it may show."""
        return self.knowledge.facts(self._waits.shows)

    @property
    def troubles(self) -> Mapping[str, str]:
        """Conditions that could not be evaluated when last looked at, and why."""
        return self._conditions.troubles

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: nothing is known; a diagnosis that is open stays open.

        Log times before and after it have nothing to do with each other.
        """
        self._pending = self._conditions.begin(at_ns)
        self._presences.begin()
        self._waits_ns = {}
        self._until_ns = at_ns
        self._due_ns = None
        if self._opening is not None:
            self._opening.evidence = {}
            self._opening.quiet_since_ns = at_ns
            self._due_ns = _half_from(at_ns + FORGOTTEN_NS)

    def feed(self, batch: Batch) -> None:
        """Take rows of any item; log times do not decrease."""
        self._conditions.feed(batch)

    def advance(self, found: Sequence[object], until_ns: int) -> list[Symptom | Diagnosis]:
        """Return what is found up to an instant, for which the record must be complete.

        ``found`` is what the monitors found since the last ``advance``, in order of time: of it
        statuses and symptoms count. Symptoms that are returned are those of the FMEA's own
        conditions.
        """
        for status in found:
            if isinstance(status, Status):
                self._conditions.take(status)
        told = [symptom for symptom in found if isinstance(symptom, Symptom)]
        own, self._pending = self._pending, []
        own += self._conditions.advance(self._until_ns, until_ns)
        out: Out = []
        events = merge(_timed(told, is_own=False), _timed(own, is_own=True), key=_when)
        for at_ns, group in groupby(events, key=_when):
            self._look_before(at_ns, out)
            self._take(group, at_ns, out)
        self._look_before(until_ns + 1, out)
        self._until_ns = max(self._until_ns, until_ns)
        return out

    def current(self) -> Diagnosis | None:
        """Return the last revision of the open diagnosis; None if all is well."""
        return None if self._opening is None else self._opening.last

    def situation(self) -> Situation:
        """Return what counts at the instant up to which it has come."""
        return self._situation(self._presences.counting(self._until_ns, self._waits_ns))

    def _situation(self, counting: Mapping[str, Counts]) -> Situation:
        shown = [
            self._presences[name].shown(counts)
            for name, counts in counting.items()
            if counts == "present" or self._presences.knows(name)
        ]
        return Situation(tuple(shown), watched=True)

    def _take(
        self,
        events: Iterable[tuple[int, bool, Symptom]],
        at_ns: int,
        out: list[Symptom | Diagnosis],
    ) -> None:
        """Take all that is told of symptoms at an instant; the first one opens a diagnosis."""
        for _, is_own, symptom in events:
            if is_own:
                out.append(symptom)
            self._presences.take(symptom, at_ns)
            if self._opening is not None:
                self._note(self._opening, symptom)
        onsets_ns = self._presences.onsets(at_ns)
        if self._opening is not None:
            self._due_ns = _half_from(at_ns)
            if self._due_ns == at_ns:
                self._look(at_ns, out)
        elif onsets_ns:
            self._open(at_ns, onsets_ns, out)

    def _note(self, opening: Opening, symptom: Symptom) -> None:
        """Note whether a symptom of the open diagnosis is there, or seen absent."""
        if self._presences[symptom.id].is_there and self._presences.knows(symptom.id):
            opening.waiting.add(symptom.id)
        elif self._presences[symptom.id].is_absent:
            opening.waiting.discard(symptom.id)

    def _open(self, at_ns: int, names: Iterable[str], out: Out) -> None:
        name = identified(self.knowledge.robot, at_ns, self._last_id)
        self._opening = Opening(name, waiting=set(names))
        self._last_id = name
        self._look(at_ns, out)

    def _look_before(self, before_ns: int, out: Out) -> None:
        """Look wherever something changes by itself before an instant."""
        while self._due_ns is not None and self._due_ns < before_ns:
            self._look(self._due_ns, out)

    def _look(self, at_ns: int, out: Out) -> None:
        """Look at what counts at an instant: revise the open diagnosis, or close it."""
        opening = self._opening
        assert opening is not None, "only an open diagnosis is looked at"
        for name, end_ns in self._ends_ns(opening, at_ns).items():
            if end_ns <= at_ns:
                self._presences[name].forget(at_ns)
        onsets_ns = self._presences.onsets(at_ns)
        if onsets_ns:
            opening.quiet_since_ns = None
            self._waits_ns = self._waits.until_ns(onsets_ns)
            self._revise(opening, at_ns, out)
        elif opening.quiet_since_ns is None:
            opening.quiet_since_ns = at_ns
            self._waits_ns = {}
        if opening.is_over(at_ns):
            out += opening.healed(at_ns)
            self._opening = self._due_ns = None
        else:
            self._due_ns = self._next_ns(opening, at_ns)

    def _ends_ns(self, opening: Opening, at_ns: int) -> dict[str, int]:
        """Return when symptoms are forgotten since the leading causes they have are over."""
        if opening.last is None:
            return {}
        faults = frozenset[str]().union(*leading_faults(opening.last))
        return self._repairs.ends_ns(faults, opening.had, self._presences, at_ns)

    def _revise(self, opening: Opening, at_ns: int, out: Out) -> None:
        counting = self._presences.counting(at_ns, self._waits_ns)
        present = [name for name, counts in counting.items() if counts == "present"]
        fading = not all(self._presences[name].is_there for name in present)
        news = opening.take_evidence(counting, fading=fading)
        if not news:
            return
        heading = Heading(opening.id, opening.next_revision, at_ns)
        made = answer(self.knowledge, self._situation(counting), heading, EFFORT)
        last = opening.last if news == "less" else None
        if last is not None and not self._repairs.may_replace(last, made, present):
            return
        if opening.revise(made):
            out.append(made)

    def _next_ns(self, opening: Opening, at_ns: int) -> int | None:
        """Return when something changes next although nothing is told."""
        if opening.quiet_since_ns is not None:
            return _half_from(opening.quiet_since_ns + FORGOTTEN_NS)
        times = [self._presences.next_ns(at_ns, self._waits_ns)]
        times += self._ends_ns(opening, at_ns).values()
        next_ns = min((time for time in times if time is not None and time > at_ns), default=None)
        return None if next_ns is None else _half_from(next_ns)

    def snapshot(self) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON, beside the rows of ``history_s``."""
        return {
            "version": VERSION,
            "config_hash": self.knowledge.config_hash,
            "until_ns": self._until_ns,
            "conditions": self._conditions.snapshot(self._until_ns),
            "symptoms": self._presences.snapshot(),
            "waits_ns": self._waits_ns,
            "pending": msgspec.to_builtins(self._pending),
            "opening": None if self._opening is None else self._opening.snapshot(),
            "last_id": self._last_id,
            "due_ns": self._due_ns,
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot of a tracker with the same knowledge.

        The rows of the last ``history_s`` before it, and all after it, have to be fed again.
        Raises UsageError if it is of another version or another folder.
        """
        ours = (VERSION, self.knowledge.config_hash)
        if (snapshot["version"], snapshot["config_hash"]) != ours:
            raise UsageError("what was remembered of diagnoses is of another version or folder")
        self._until_ns = snapshot["until_ns"]
        self._conditions.resume(snapshot["conditions"], self._until_ns)
        self._presences.resume(snapshot["symptoms"])
        self._waits_ns = dict(snapshot["waits_ns"])
        self._pending = msgspec.convert(snapshot["pending"], list[Symptom])
        opening = snapshot["opening"]
        self._opening = None if opening is None else Opening.resumed(opening)
        self._last_id, self._due_ns = snapshot["last_id"], snapshot["due_ns"]


def _timed(symptoms: Iterable[Symptom], is_own: bool) -> list[Event]:
    return [(symptom.confirmed_ns or 0, is_own, symptom) for symptom in symptoms]


def _when(event: Event) -> int:
    return event[0]


def _half_from(at_ns: int) -> int:
    """Return the first multiple of half a second that is not before an instant."""
    return -(-at_ns // HALF_NS) * HALF_NS
