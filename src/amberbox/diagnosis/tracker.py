"""The fault tracker: symptoms over time in, diagnoses and their revisions out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from heapq import merge
from itertools import groupby
from types import CodeType
from typing import Any, Final, Literal, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.core.given_answers import ITEM as ANSWERS
from amberbox.core.given_answers import RecordedAnswer, answers_in
from amberbox.core.types import Batch, Diagnosis, FaultFacts, Symptom
from amberbox.diagnosis.asked_evidence import AskedEvidence
from amberbox.diagnosis.diagnose import (
    DiagnosisId,
    Effort,
    ObservedSituation,
    OpenWindow,
    answer,
    followers,
    is_answer,
)
from amberbox.diagnosis.fmea.findings import faults_by_finding
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
    symptoms that have counted as present. ``answers`` are what people answered to its tests.
    ``waiting`` are symptoms that it had and that have not been seen absent since.
    ``quiet_since_ns`` is since when none is present; None while one is. ``levels`` are those of the
    sizes that its last answer took into account, and ``texts`` the findings that were shown in it.
    """

    id: str
    last: Diagnosis | None = None
    evidence: dict[str, Counts] = field(default_factory=dict)
    waiting: set[str] = field(default_factory=set)
    quiet_since_ns: int | None = None
    had: set[str] = field(default_factory=set)
    answers: dict[str, str] = field(default_factory=dict)
    has_new_answers: bool = False
    levels: dict[str, int] = field(default_factory=dict)
    texts: tuple[str, ...] = ()
    asked_answers: dict[str, str] = field(default_factory=dict)

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
            "answers": self.answers,
            "has_new_answers": self.has_new_answers,
            "levels": self.levels,
            "texts": self.texts,
            "asked_answers": self.asked_answers,
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
    """Detects failure modes that have ended; ``shows`` are the symptoms of each.

    ``found`` are their findings: as long as one is present, its failure modes are not over.
    """

    def __init__(
        self,
        shows: Mapping[str, Collection[str]],
        found: Iterable[tuple[str, Iterable[str]]] = (),
    ) -> None:
        self._shows = shows
        self._found: dict[str, list[str]] = {}
        for finding, faults in found:
            for fault in faults:
                self._found.setdefault(fault, []).append(finding)

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
            if any(
                name in presences and presences[name].counts_present(at_ns)
                for name in self._found.get(fault, ())
            ):
                over_ns = NEVER_NS
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
        return shows is not None and not any(
            name in present for names in (shows, self._found.get(fault, ())) for name in names
        )


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
    """Tracks the faults of one robot: ``begin`` an epoch, ``feed`` rows, ``advance``.

    ``open_window`` opens folder and record for the providers that are asked at instants; without it
    only evidence that is followed counts.
    """

    def __init__(self, knowledge: Knowledge, open_window: OpenWindow | None = None) -> None:
        self.knowledge = knowledge
        self._followers = followers(knowledge)
        self._asked = AskedEvidence(knowledge, open_window)
        self._presences = SymptomPresences(knowledge.fmea)
        self._waits = AbsenceTimes(knowledge.fmea)
        self._repairs = RepairDetection(self._waits.shows, faults_by_finding(knowledge.fmea))
        self._waits_ns: dict[str, int] = {}
        self._until_ns = 0
        self._pending: list[Symptom] = []
        self._opening: OpenDiagnosis | None = None
        self._last_id = ""
        self._due_ns: int | None = None
        self._answers: deque[tuple[int, RecordedAnswer]] = deque()

    @property
    def items(self) -> frozenset[str]:
        """Return the names of the items whose rows evidence is read from."""
        own = {ANSWERS} if self.knowledge.checks else set[str]()
        return frozenset(own).union(*(one.items for one in self._followers.values()))

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

    @property
    def left_out(self) -> Mapping[str, str]:
        """Return the providers that have failed and are left out for now, with the reason."""
        return self._asked.left_out

    @property
    def guarded(self) -> frozenset[CodeType]:
        """Return the code of the providers that are asked, which must return soon."""
        return self._asked.codes

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: nothing is known; a diagnosis that is open stays open.

        Log times before and after it are not comparable.
        """
        self._pending = [s for one in self._followers.values() for s in one.begin(at_ns)]
        self._presences.begin()
        self._waits_ns = {}
        self._until_ns = at_ns
        self._answers.clear()
        self._asked.begin(at_ns)
        self._due_ns = _half_from_any([self._asked.next_ns(at_ns)])
        if self._opening is not None:
            self._opening.evidence = {}
            self._opening.quiet_since_ns = at_ns
            self._due_ns = self._next_ns(self._opening, at_ns)

    def feed(self, batch: Batch) -> None:
        """Take rows of any item; log times do not decrease."""
        for one in self._followers.values():
            one.feed(batch)
        if batch.item == ANSWERS:  # those up to the last instant have been taken
            self._answers += (given for given in answers_in(batch) if given[0] > self._until_ns)

    def advance(self, found: Sequence[object], until_ns: int) -> list[Symptom | Diagnosis]:
        """Return the findings up to an instant, for which the record must be complete.

        ``found`` are the monitors' findings since the last ``advance``, in order of time: their
        statuses and symptoms are used. The symptoms returned are those that no monitor found.
        """
        written: list[list[Event]] = []
        unwritten = [_timed(self._pending, records=True)]
        self._pending = []
        self._asked.receive(found)
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
        self._asked.forget_before(until_ns)
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
        given = {} if self._opening is None else self._opening.answers
        answers = {**self._asked.answers, **given}
        return ObservedSituation(tuple(shown), answers, watched=True, findings=self._asked.texts)

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
            self._take_symptom(symptom, at_ns)
        if self._opening is not None:
            self._due_ns = _half_from(at_ns)
            if self._due_ns == at_ns:
                self._look(at_ns, out)
        elif not self._open(at_ns, out) and self._asked.is_used:
            self._due_ns = _half_from_any([at_ns, self._due_ns])

    def _take_symptom(self, symptom: Symptom, at_ns: int) -> None:
        self._presences.take(symptom, at_ns)
        if self._opening is not None:
            if self._presences[symptom.id].is_there and self._presences.knows(symptom.id):
                self._opening.waiting.add(symptom.id)
            elif self._presences[symptom.id].is_absent:
                self._opening.waiting.discard(symptom.id)

    def _open(self, at_ns: int, out: Out) -> bool:
        """Open a diagnosis if a symptom is present, and look at it; return whether one is."""
        onsets_ns = self._presences.onsets(at_ns)
        if not onsets_ns:
            return False
        name = new_diagnosis_id(self.knowledge.robot, at_ns, self._last_id)
        self._opening = OpenDiagnosis(name, waiting=set(onsets_ns))
        self._last_id = name
        self._look(at_ns, out)
        return True

    def _look_before(self, before_ns: int, out: Out) -> None:
        """Evaluate at each instant before ``before_ns`` at which the evidence changes without new
        findings.
        """
        while True:
            due_ns = NEVER_NS if self._due_ns is None else self._due_ns
            if self._answers and self._answers[0][0] < min(before_ns, due_ns + 1):
                self._take_answer(*self._answers.popleft())
            elif due_ns < before_ns:
                if self._opening is not None:
                    self._look(due_ns, out)
                else:
                    self._look_for_findings(due_ns, out)
            else:
                return

    def _look_for_findings(self, at_ns: int, out: Out) -> None:
        """Ask the providers while no diagnosis is open; what they find may open one."""
        self._due_ns = None
        self._ask(at_ns, out)
        if not self._open(at_ns, out):
            self._due_ns = self._next_asked_ns(at_ns)

    def _ask(self, at_ns: int, out: Out) -> None:
        """Ask the providers, if there may be something new, and take the symptoms they find."""
        counting = self._presences.counting(at_ns, self._waits_ns)
        if self._asked.is_due(at_ns, counting):
            for symptom in self._asked.ask(at_ns, self._situation(counting), counting):
                out.append(symptom)
                self._take_symptom(symptom, at_ns)

    def _next_asked_ns(self, at_ns: int) -> int | None:
        """Return when the providers may find something else although no symptom changes."""
        if not self._asked.is_used:
            return None
        turn_ns = self._presences.next_ns(at_ns, self._waits_ns)
        return _half_from_any([turn_ns, self._asked.next_ns(at_ns)])

    def _take_answer(self, at_ns: int, given: RecordedAnswer) -> None:
        """Count an answer to a test of the open diagnosis; others mean nothing any more."""
        opening = self._opening
        if opening is None or given.diagnosis != opening.id:
            return
        if is_answer(self.knowledge, given.test, given.answer):
            opening.answers[given.test] = given.answer
            opening.has_new_answers = True
            half_ns = _half_from(at_ns)
            self._due_ns = half_ns if self._due_ns is None else min(half_ns, self._due_ns)

    def _look(self, at_ns: int, out: Out) -> None:
        """Evaluate the evidence at an instant: revise the open diagnosis, or close it."""
        opening = self._opening
        assert opening is not None, "only an open diagnosis is looked at"
        for name, end_ns in self._ends_ns(opening, at_ns).items():
            if end_ns <= at_ns:
                self._presences[name].forget(at_ns)
        onsets_ns = self._presences.onsets(at_ns)
        if onsets_ns:
            self._waits_ns = self._waits.until_ns(onsets_ns)
        if self._asked.is_used:
            self._ask(at_ns, out)
            onsets_ns = self._presences.onsets(at_ns)
        if onsets_ns:
            opening.quiet_since_ns = None
            self._revise(opening, at_ns, out)
        elif opening.quiet_since_ns is None:
            opening.quiet_since_ns = at_ns
            self._waits_ns = {}
        if opening.is_over(at_ns):
            out += opening.healed(at_ns)
            self._opening = None
            self._due_ns = self._next_asked_ns(at_ns)
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
        levels = self._presences.levels(present, self._level)
        if opening.has_new_answers or levels.items() - opening.levels.items():
            news, opening.has_new_answers = "more", False
        opening.levels = levels
        if self._asked.answers != opening.asked_answers:
            news, opening.asked_answers = "more", self._asked.answers
        heading = DiagnosisId(opening.id, opening.next_revision, at_ns)
        made = opening.last
        if news:
            made = answer(self.knowledge, self._situation(counting), heading, EFFORT)
            made = replace(made, asked=self._asked.names)
            last = opening.last if news == "less" else None
            if last is not None and not self._repairs.may_replace(last, made, present):
                made = last
        if made is not None and self._asked.texts != opening.texts:
            made = _with_texts(made, opening.texts, self._asked.texts, heading)
            opening.texts = self._asked.texts
        if made is not None and made is not opening.last and opening.revise(made):
            out.append(made)

    def _level(self, symptom: Symptom) -> int | None:
        """Return the level of a symptom's size, of a finding that of its strength; None if none."""
        if self._presences.is_finding(symptom.id) and 0.0 < symptom.strength < 1.0:
            return round(2.0 * math.atanh(symptom.strength))  # the log of its likelihood ratio
        return self.knowledge.level(symptom)

    def _next_ns(self, opening: OpenDiagnosis, at_ns: int) -> int | None:
        """Return when something changes next without a new symptom."""
        asked_ns = self._next_asked_ns(at_ns)
        if opening.quiet_since_ns is not None:
            return _half_from_any([opening.quiet_since_ns + FORGOTTEN_NS, asked_ns])
        times = [self._presences.next_ns(at_ns, self._waits_ns), asked_ns]
        times += self._ends_ns(opening, at_ns).values()
        return _half_from_any([time for time in times if time is not None and time > at_ns])

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
            "asked": self._asked.snapshot(),
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
        if "asked" in snapshot:  # not written by earlier versions
            self._asked.resume(snapshot["asked"])
        elif self._asked.is_used:
            self._due_ns = _half_from_any([self._until_ns + 1, self._due_ns])


def _timed(symptoms: Iterable[Symptom], *, records: bool) -> list[Event]:
    return [(symptom.confirmed_ns or 0, records, symptom) for symptom in symptoms]


def _when(event: Event) -> int:
    return event[0]


def _with_texts(
    made: Diagnosis, before: Iterable[str], now: Iterable[str], heading: DiagnosisId
) -> Diagnosis:
    """Return an answer with other findings that indicate no failure mode."""
    own = [text for text in made.findings if text not in (*before, *now)]
    return replace(made, findings=(*own, *now), revision=heading.revision, at_ns=heading.at_ns)


def _half_from_any(times_ns: Iterable[int | None]) -> int | None:
    """Return the first multiple of half a second from the earliest of some instants on."""
    known = [at_ns for at_ns in times_ns if at_ns is not None]
    return _half_from(min(known)) if known else None


def _half_from(at_ns: int) -> int:
    """Return the first multiple of half a second that is not before an instant."""
    return -(-at_ns // HALF_NS) * HALF_NS
