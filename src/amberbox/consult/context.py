"""The context of a diagnosis: the evidence on a robot at an instant, and the record before it.

The evidence comes from the watcher's journal; without one the record is evaluated again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.query.record_window import RecordWindow
from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.store.store import Store
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.consult.rule_lookups import ConditionCache, record_predicates
from amberbox.core.clock import NS
from amberbox.core.contracts import NOTHING_GIVEN, EvidenceNeeds, GivenEvidence
from amberbox.core.errors import Problem, UsageError
from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.diagnose import DiagnosisContext, ObservedSituation, is_answer
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.prolog.machine import Virtual
from amberbox.diagnosis.symptom_presence import AbsenceTimes, SymptomPresences
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.current_state import (
    RecordedFindings,
    duration_text,
    findings_until,
    was_watched,
)
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import Finding
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.record_evaluation import (
    WARM_UP_S,
    DiagnosedEngine,
    MakeDiagnoser,
    RecordEvaluation,
    ReplayOptions,
    blocks,
    hang_guard,
)
from amberbox.monitoring.record_reader import RecordBlock


@dataclass(slots=True)
class _RecordedFaults:
    """The last diagnosis, and the last presence of each symptom."""

    diagnosis: Diagnosis | None = None
    present: dict[str, Symptom] = field(default_factory=dict)

    def receive(self, found: Iterable[Finding]) -> None:
        for finding in found:
            if isinstance(finding, Diagnosis):
                self.diagnosis = finding
            elif isinstance(finding, Symptom) and finding.state == "present":
                self.present[finding.id] = finding

    def context(self, at_ns: int, situation: ObservedSituation) -> DiagnosisContext:
        """Return the context with the situation at an instant."""
        names = () if self.diagnosis is None else self.diagnosis.symptoms
        seen = tuple(self.present[name] for name in names if name in self.present)
        return DiagnosisContext(at_ns, situation, self.diagnosis, seen=seen)


def load_diagnoser(
    folder: RobotFolder, plan: MonitoringPlan, store: Path | None = None
) -> tuple[MakeDiagnoser | None, list[Problem]]:
    """Return a maker of fault trackers for a folder; None without failure modes.

    Its providers of evidence look at the record in a ``store``, the folder's own by default.
    """
    knowledge, problems = load_knowledge(folder, plan)
    if knowledge is None:
        return None, problems
    open_window = followed_windows(folder.path, store or folder.store_path)
    return partial(FaultTracker, knowledge, open_window), problems


def context_at(
    knowledge: Knowledge,
    plan: MonitoringPlan,
    store: Store,
    at_ns: int,
    lookback_s: float,
    folder: Path | None = None,
) -> DiagnosisContext:
    """Return the context at an instant: from the watcher's journal, else by evaluation.

    An evaluation asks providers of evidence if it has the robot's ``folder``. Raises UsageError
    where nothing was recorded.
    """
    if was_watched(store, knowledge.config_hash, at_ns):
        found = context_from_journal(knowledge, store, at_ns)
        if found is not None:
            return found
    return context_by_evaluation(knowledge, plan, store, at_ns, lookback_s, folder)


def context_by_evaluation(
    knowledge: Knowledge,
    plan: MonitoringPlan,
    store: Store,
    at_ns: int,
    lookback_s: float,
    folder: Path | None = None,
) -> DiagnosisContext:
    """Evaluate the record before an instant, and a minute before that; nothing is written.

    Raises UsageError where nothing was recorded.
    """
    open_window = None if folder is None else followed_windows(folder, store.path)
    tracker, recorded = FaultTracker(knowledge, open_window), _RecordedFaults()
    engine = DiagnosedEngine(Engine(plan), tracker)
    evaluation = RecordEvaluation(engine)
    with hang_guard(plan, engine.guarded):
        for block in _between(plan, store, engine, at_ns - round(lookback_s * NS), at_ns):
            for found in evaluation.take(block):
                recorded.receive(found)
    if evaluation.place is None:
        raise UsageError(
            f"nothing was recorded in the {duration_text(round(lookback_s * NS))} before "
            f"{format_time(at_ns)[:19]}; {_recorded(store)}",
            "amberbox gaps shows what is missing; give another --at or a longer --lookback",
        )
    reached_ns = evaluation.place.until_ns
    return replace(recorded.context(reached_ns, tracker.situation()), origin="record")


def _recorded(store: Store) -> str:
    """Return as text the span in which a record has rows."""
    items = LocalRecord(store.path).items()
    if not items:
        return "the record has no rows"
    first_ns, last_ns = min(i.first_ns for i in items), max(i.last_ns for i in items)
    return f"the record goes from {format_time(first_ns)[:19]} to {format_time(last_ns)[:19]}"


def _between(
    plan: MonitoringPlan, store: Store, engine: DiagnosedEngine, from_ns: int, to_ns: int
) -> Iterator[RecordBlock]:
    """Yield the record of a span, and of the time before it in which monitors warm up."""
    start_ns = from_ns - round(WARM_UP_S * NS)
    part = ReplayOptions(from_ns + round(engine.history_s * NS))  # windows fill within the span
    for block in blocks(plan, store, engine, part):
        if block.until_ns >= start_ns and block.start_ns <= to_ns:
            until_ns = min(block.until_ns, to_ns)
            yield replace(block, start_ns=max(block.start_ns, start_ns), until_ns=until_ns)
        if block.until_ns >= to_ns:
            return


def context_from_journal(knowledge: Knowledge, store: Store, at_ns: int) -> DiagnosisContext | None:
    """Return the context at an instant from the journal of the watcher.

    None if it has no symptom: the watcher was an earlier version, or had no failure modes.
    """
    return context_from_findings(knowledge, findings_until(store, at_ns), at_ns)


def context_from_findings(
    knowledge: Knowledge, findings: RecordedFindings, at_ns: int
) -> DiagnosisContext | None:
    """Return the context made from the findings up to an instant; None if there is no symptom."""
    if not findings.symptoms:
        return None
    recorded = _RecordedFaults()
    recorded.receive(findings.symptoms)
    recorded.receive(findings.diagnoses)
    symptoms = [*_from_deleted_files(recorded.diagnosis, findings.symptoms), *findings.symptoms]
    situation = situation_at(knowledge, symptoms, at_ns)
    found = recorded.context(at_ns, situation)
    if found.open is not None:
        answers = {
            given.test: given.answer
            for given in findings.answers
            if given.diagnosis == found.open.id and is_answer(knowledge, given.test, given.answer)
        }
        found = replace(found, situation=replace(situation, answers=answers))
    return replace(found, origin="watcher")


def _from_deleted_files(
    last_diagnosis: Diagnosis | None, symptoms: Iterable[Symptom]
) -> Iterator[Symptom]:
    """Yield the symptoms of an open diagnosis whose findings are only in deleted files.

    There is no later finding, so they are still present.
    """
    known = {symptom.id for symptom in symptoms}
    if last_diagnosis is not None and last_diagnosis.state == "open":
        for name in last_diagnosis.symptoms:
            if name not in known:
                yield Symptom(name, "present", name)


def situation_at(
    knowledge: Knowledge, symptoms: Iterable[Symptom], at_ns: int
) -> ObservedSituation:
    """Return the situation at an instant from the symptoms reported until then, in order."""
    presences = SymptomPresences(knowledge.fmea)
    for symptom in symptoms:
        presences.take(symptom, symptom.confirmed_ns or 0)
    waits_ns = AbsenceTimes(knowledge.fmea).until_ns(presences.onsets(at_ns))
    counts = presences.counting(at_ns, waits_ns)
    shown = (presences[name].shown(counted) for name, counted in counts.items())
    return ObservedSituation(tuple(shown), watched=True)


@dataclass(frozen=True, slots=True)
class RobotWindow:
    """The ``EvidenceWindow`` of a robot at an instant (``core.contracts``).

    ``open_past`` opens a part of the record, by its first and last instant; None without a record.
    The window reaches back as far as a provider needs, and at least ``lookback_ns``. ``cache``
    keeps what lookups have found for later windows of the same record.
    """

    context: DiagnosisContext
    folder: Path
    given: GivenEvidence = NOTHING_GIVEN
    open_past: Callable[[int, int], RecordWindow] | None = None
    lookback_ns: int = 0
    cache: ConditionCache | None = None

    @property
    def at_ns(self) -> int:
        """Return the instant."""
        return self.context.at_ns

    @property
    def symptoms(self) -> Sequence[Symptom]:
        """Return the symptoms that count already."""
        return self.context.situation.symptoms

    def past(self, needs: EvidenceNeeds) -> RecordWindow | None:
        """Open the record as far back as is needed; None without a record."""
        if self.open_past is None:
            return None
        back_ns = max(self.lookback_ns, round(needs.history_s * NS))
        return self.open_past(self.at_ns - back_ns, self.at_ns + 1)

    def lookups(self, needs: EvidenceNeeds) -> Sequence[Virtual]:
        """Return the predicates of rules that query that part of the record."""
        past = self.past(needs)
        return () if past is None else record_predicates(past, self.cache, self.context.statuses)


def followed_windows(folder: Path, store: Path) -> Callable[[DiagnosisContext], RobotWindow]:
    """Return a function that opens a robot's folder and record again and again as time passes."""
    past = partial(RecordWindow, LocalRecord(store))
    return partial(RobotWindow, folder=folder, open_past=past, cache=ConditionCache())
