"""The fault tracker: symptoms over time in, diagnoses and their revisions out."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from heapq import merge
from itertools import groupby
from typing import Any, Final, Literal, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.core.types import Batch, Diagnosis, FaultFacts, Symptom
from amberbox.diagnosis.diagnose import DiagnosisId, Effort, ObservedSituation, answer, followers
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.symptom_presence import (
    AbsenceTimes,
    Counts,
    SymptomPresence,
    SymptomPresences,
)

# What is new in the evidence: nothing, only that something has gone, or something else
News: TypeAlias = Literal["", "less", "more"]
# Hypotheses that are less probable than this may change their order without a revision
LIKELY = 0.02
MOVED = 0.01  # A revision is due when a probability has moved by more than this
# So long without any present symptom, and a diagnosis is over, seen absent or not
FORGOTTEN_NS = 3600 * NS
_LONGEST_NAME = 46  # what remains of an id's 64 characters for the robot


@dataclass(slots=True)
class OpenDiagnosis:
    """A diagnosis from its first symptom until all have healed.

    ``evidence`` is what its last answer took into account, as far as it still counts; ``had`` are
    symptoms that have counted as present.
    ``waiting`` are symptoms that it had and that have not been seen absent since.
    ``quiet_since_ns`` is since when none is present; None while one is.
    """

    id: str
    last: Diagnosis | None = None
    evidence: dict[str, Counts] = field(default_factory=dict)
    waiting: set[str] = field(default_factory=set)
    quiet_since_ns: int | None = None
    had: set[str] = field(default_factory=set)

    @property
    def next_revision(self) -> int:
        """Return the number of the next revision."""
        return 1 if self.last is None else self.last.revision + 1

    def take_evidence(self, counting: Mapping[str, Counts], *, fading: bool = False) -> News:
        """Update the evidence that counts now; return what is new in it.

        ``more``: a symptom appeared, or an absence begins to count. ``less``: a symptom no longer
        counts; while other symptoms are ``fading``, also if it counts as absent.
        """
        evidence: dict[str, Counts] = {name: counts for name, counts in counting.items() if counts}
        changed = {name for name, counts in evidence.items() if self.evidence.get(name) != counts}
        lost = {name for name, counts in self.evidence.items() if counts == "present"}
        lost -= {name for name, counts in evidence.items() if counts == "present"}
        is_more = any(
            evidence[name] == "present" or name not in self.had or not fading for name in changed
        )
        self.had |= {name for name, counts in evidence.items() if counts == "present"}
        self.evidence = evidence
        return "more" if is_more else "less" if lost or changed else ""

    def revise(self, made: Diagnosis) -> bool:
        """Set a new answer; return whether it differs from the last revision."""
        if self.last is not None and not needs_revision(self.last, made):
            return False
        self.last = made
        return True

    def is_over(self, at_ns: int) -> bool:
        """Return whether it has healed, or nothing was seen of it for too long."""
        if self.quiet_since_ns is None:
            return False
        return not self.waiting or at_ns - self.quiet_since_ns >= FORGOTTEN_NS

    def healed(self, at_ns: int) -> list[Diagnosis]:
        """Return the last revision: the last answer, healed."""
        if self.last is None:
            return []
        return [replace(self.last, revision=self.next_revision, at_ns=at_ns, state="healed")]

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        return {
            "id": self.id,
            "last": msgspec.to_builtins(self.last, order="deterministic"),
            "evidence": dict(self.evidence),
            "waiting": sorted(self.waiting),
            "quiet_since_ns": self.quiet_since_ns,
            "had": sorted(self.had),
        }

    @classmethod
    def resumed(cls, snapshot: Mapping[str, Any]) -> OpenDiagnosis:
        """Return what ``snapshot`` was made of."""
        return msgspec.convert(snapshot, cls)


def new_diagnosis_id(robot: str, at_ns: int, last_id: str) -> str:
    """Return a diagnosis id by its opening time, with a letter if the last one has the same."""
    when = datetime.fromtimestamp(at_ns // NS, UTC).strftime("%Y%m%dt%H%M%S")
    name = f"{robot[:_LONGEST_NAME]}-{when}"
    if not last_id.startswith(name):
        return name
    letter = last_id.removeprefix(name)
    return name + (chr(ord(letter) + 1) if letter else "a")


def needs_revision(before: Diagnosis, after: Diagnosis) -> bool:
    """Return whether an answer differs so that a revision is due."""
    return _conclusion(before) != _conclusion(after) or _moved(before, after)


def _conclusion(one: Diagnosis) -> tuple[object, ...]:
    leading = one.hypotheses[0] if one.hypotheses else None
    why = None if leading is None else (leading.id, leading.explains, leading.unexplained)
    proposed = one.next_tests[0].id if one.next_tests else ""
    about = one.findings, one.incomplete, one.make_safe
    return why, frozenset(one.symptoms), proposed, *about


def _moved(before: Diagnosis, after: Diagnosis) -> bool:
    """Return whether likely hypotheses have changed their order or their probability."""
    was = {one.id: one.probability for one in before.hypotheses}
    now = {one.id: one.probability for one in after.hypotheses}
    likely = {name for shares in (was, now) for name, share in shares.items() if share >= LIKELY}
    if [name for name in was if name in likely] != [name for name in now if name in likely]:
        return True
    return any(abs(was[name] - now[name]) > MOVED for name in likely)


NEVER_NS = 1 << 62


class RepairDetection:
    """Detects failure modes that have ended; ``shows`` are the symptoms of each."""

    def __init__(self, shows: Mapping[str, Collection[str]]) -> None:
        self._shows = shows

    def ends_ns(
        self, faults: Iterable[str], had: Collection[str], presences: SymptomPresences, at_ns: int
    ) -> dict[str, int]:
        """Return when symptoms stop counting because all of their causes among ``faults`` are over.

        A failure mode is over when all its symptoms (of those that the diagnosis ``had``) have been
        observed to be gone for as long as the shortest ``hold_s`` among them. Symptoms that are
        present, or unknown, have no end.
        """
        ends_ns: dict[str, int] = {}
        for fault in faults:
            names = [n for n in self._shows.get(fault, ()) if n in had and n in presences]
            over_ns = _over_ns([presences[name] for name in names], at_ns)
            for name in names:
                ends_ns[name] = max(ends_ns.get(name, 0), over_ns)
        return {name: end_ns for name, end_ns in ends_ns.items() if end_ns < NEVER_NS}

    def may_replace(self, before: Diagnosis, after: Diagnosis, present: Collection[str]) -> bool:
        """Return whether an answer may replace another only since symptoms have gone.

        It may narrow the leading group, and leave out causes that show nothing any more. It adds no
        cause that did not lead before, unless each leading hypothesis has such an ended cause, so
        that none holds any longer.
        """
        was, now = ([one.faults for one in of.leading()] for of in (before, after))
        if set(now) < set(was) or all(
            any(self._is_over(fault, present) for fault in one) for one in was
        ):
            return True
        left_out = frozenset[str]().union(*was) - frozenset[str]().union(*now)
        accuses_no_other = all(one and any(one <= other for other in was) for one in now)
        return (
            accuses_no_other
            and any(left_out)
            and all(self._is_over(fault, present) for fault in left_out)
        )

    def _is_over(self, fault: str, present: Collection[str]) -> bool:
        shows = self._shows.get(fault)
        return shows is not None and not any(name in present for name in shows)


def _over_ns(shown: Collection[SymptomPresence], at_ns: int) -> int:
    """Return when the cause of symptoms is over; NEVER_NS while one is present, or unknown."""
    gone_ns = [one.forgotten_since_ns(at_ns) for one in shown]
    if not shown or None in gone_ns:
        return NEVER_NS
    return max(gone or 0 for gone in gone_ns) + min(one.hold_ns for one in shown)


HALF_NS: Final = NS // 2  # revisions come at multiples of this; only the first comes at once
# What a revision may cost: nodes alone, so that it is the same on every machine
EFFORT = Effort(budget=Budget(nodes=1_000))
VERSION: Final = 2

# When a symptom was found, whether it is still to be recorded, and which
Event: TypeAlias = tuple[int, bool, Symptom]
Out: TypeAlias = "list[Symptom | Diagnosis]"


class FaultTracker:
    """Tracks the faults of one robot: ``begin`` an epoch, ``feed`` rows, ``advance``."""

    def __init__(self, knowledge: Knowledge) -> None:
        self.knowledge = knowledge
        self._followers = followers(knowledge)
        self._presences = SymptomPresences(knowledge.fmea)
        self._waits = AbsenceTimes(knowledge.fmea)
        self._repairs = RepairDetection(self._waits.shows)
        self._waits_ns: dict[str, int] = {}
        self._until_ns = 0
        self._pending: list[Symptom] = []
        self._opening: OpenDiagnosis | None = None
        self._last_id = ""
        self._due_ns: int | None = None

    @property
    def items(self) -> frozenset[str]:
        """Return the names of the items whose rows evidence is read from."""
        return frozenset[str]().union(*(one.items for one in self._followers.values()))

    @property
    def history_s(self) -> float:
        """Return how far back rows have to be fed again after ``resume``, in seconds."""
        return max((one.history_s for one in self._followers.values()), default=0.0)

    @property
    def facts(self) -> Mapping[str, FaultFacts]:
        """Facts about failure modes: the severity of each, and its possible symptoms."""
        return self.knowledge.facts(self._waits.shows)

    @property
    def troubles(self) -> Mapping[str, str]:
        """Return the conditions whose last evaluation failed, with the reason."""
        return {name: why for of in self._followers.values() for name, why in of.troubles.items()}

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: nothing is known; a diagnosis that is open stays open.

        Log times before and after it are not comparable.
        """
        self._pending = [s for one in self._followers.values() for s in one.begin(at_ns)]
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
        for one in self._followers.values():
            one.feed(batch)

    def advance(self, found: Sequence[object], until_ns: int) -> list[Symptom | Diagnosis]:
        """Return the findings up to an instant, for which the record must be complete.

        ``found`` are the monitors' findings since the last ``advance``, in order of time: their
        statuses and symptoms are used. The symptoms returned are those that no monitor found.
        """
        written: list[list[Event]] = []
        unwritten = [_timed(self._pending, records=True)]
        self._pending = []
        for one in self._followers.values():
            one.receive(found)
            changes = _timed(one.advance(self._until_ns, until_ns), records=one.records)
            (unwritten if one.records else written).append(changes)
        out: Out = []
        events = merge(*written, *unwritten, key=_when)
        for at_ns, group in groupby(events, key=_when):
            self._look_before(at_ns, out)
            self._take(group, at_ns, out)
        self._look_before(until_ns + 1, out)
        self._until_ns = max(self._until_ns, until_ns)
        return out

    def current(self) -> Diagnosis | None:
        """Return the last revision of the open diagnosis; None if all is well."""
        return None if self._opening is None else self._opening.last

    def situation(self) -> ObservedSituation:
        """Return the situation at the last evaluated instant."""
        return self._situation(self._presences.counting(self._until_ns, self._waits_ns))

    def _situation(self, counting: Mapping[str, Counts]) -> ObservedSituation:
        shown = [
            self._presences[name].shown(counts)
            for name, counts in counting.items()
            if counts == "present" or self._presences.knows(name)
        ]
        return ObservedSituation(tuple(shown), watched=True)

    def _take(
        self,
        events: Iterable[tuple[int, bool, Symptom]],
        at_ns: int,
        out: list[Symptom | Diagnosis],
    ) -> None:
        """Process the symptoms of an instant; the first one opens a diagnosis."""
        for _, records, symptom in events:
            if records:
                out.append(symptom)
            self._presences.take(symptom, at_ns)
            if self._opening is not None:
                if self._presences[symptom.id].is_there and self._presences.knows(symptom.id):
                    self._opening.waiting.add(symptom.id)
                elif self._presences[symptom.id].is_absent:
                    self._opening.waiting.discard(symptom.id)
        onsets_ns = self._presences.onsets(at_ns)
        if self._opening is not None:
            self._due_ns = _half_from(at_ns)
            if self._due_ns == at_ns:
                self._look(at_ns, out)
        elif onsets_ns:
            name = new_diagnosis_id(self.knowledge.robot, at_ns, self._last_id)
            self._opening = OpenDiagnosis(name, waiting=set(onsets_ns))
            self._last_id = name
            self._look(at_ns, out)

    def _look_before(self, before_ns: int, out: Out) -> None:
        """Evaluate at each instant before ``before_ns`` at which the evidence changes without new
        findings.
        """
        while self._due_ns is not None and self._due_ns < before_ns:
            self._look(self._due_ns, out)

    def _look(self, at_ns: int, out: Out) -> None:
        """Evaluate the evidence at an instant: revise the open diagnosis, or close it."""
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

    def _ends_ns(self, opening: OpenDiagnosis, at_ns: int) -> dict[str, int]:
        """Return when symptoms are forgotten since the leading causes they have are over."""
        if opening.last is None:
            return {}
        faults = frozenset[str]().union(*(one.faults for one in opening.last.leading()))
        return self._repairs.ends_ns(faults, opening.had, self._presences, at_ns)

    def _revise(self, opening: OpenDiagnosis, at_ns: int, out: Out) -> None:
        counting = self._presences.counting(at_ns, self._waits_ns)
        present = [name for name, counts in counting.items() if counts == "present"]
        fading = not all(self._presences[name].is_there for name in present)
        news = opening.take_evidence(counting, fading=fading)
        if not news:
            return
        heading = DiagnosisId(opening.id, opening.next_revision, at_ns)
        # Only evidence that is followed counts here: providers asked at an instant do not, as yet.
        made = answer(self.knowledge, self._situation(counting), heading, EFFORT)
        last = opening.last if news == "less" else None
        if last is not None and not self._repairs.may_replace(last, made, present):
            return
        if opening.revise(made):
            out.append(made)

    def _next_ns(self, opening: OpenDiagnosis, at_ns: int) -> int | None:
        """Return when something changes next without a new symptom."""
        if opening.quiet_since_ns is not None:
            return _half_from(opening.quiet_since_ns + FORGOTTEN_NS)
        times = [self._presences.next_ns(at_ns, self._waits_ns)]
        times += self._ends_ns(opening, at_ns).values()
        next_ns = min((time for time in times if time is not None and time > at_ns), default=None)
        return None if next_ns is None else _half_from(next_ns)

    def snapshot(self) -> dict[str, Any]:
        """Return the state needed by ``resume``, as JSON, without the rows of ``history_s``."""
        return {
            "version": VERSION,
            "config_hash": self.knowledge.config_hash,
            "until_ns": self._until_ns,
            **{
                name: kept
                for name, one in self._followers.items()
                if (kept := one.snapshot(self._until_ns)) is not None
            },
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
        for name, one in self._followers.items():
            if name in snapshot:
                one.resume(snapshot[name], self._until_ns)
        self._presences.resume(snapshot["symptoms"])
        self._waits_ns = dict(snapshot["waits_ns"])
        self._pending = msgspec.convert(snapshot["pending"], list[Symptom])
        opening = snapshot["opening"]
        self._opening = None if opening is None else OpenDiagnosis.resumed(opening)
        self._last_id, self._due_ns = snapshot["last_id"], snapshot["due_ns"]


def _timed(symptoms: Iterable[Symptom], *, records: bool) -> list[Event]:
    return [(symptom.confirmed_ns or 0, records, symptom) for symptom in symptoms]


def _when(event: Event) -> int:
    return event[0]


def _half_from(at_ns: int) -> int:
    """Return the first multiple of half a second that is not before an instant."""
    return -(-at_ns // HALF_NS) * HALF_NS
