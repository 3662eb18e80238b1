"""What was known of a robot at an instant, from its record: by its watcher, else evaluated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from amberbox.blackbox.query.record import Record
from amberbox.blackbox.store import Store
from amberbox.consult.case import Case
from amberbox.consult.journal import Said, said_until, was_watched
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation
from amberbox.diagnosis.tracking.absence import Waits
from amberbox.diagnosis.tracking.presence import Presences
from amberbox.diagnosis.tracking.tracker import Tracker
from amberbox.monitoring.engine.engine import Engine
from amberbox.monitoring.engine.findings import Finding
from amberbox.monitoring.messages.board import duration
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.watcher.diagnosing import Diagnosing
from amberbox.monitoring.watcher.evaluation import Evaluation
from amberbox.monitoring.watcher.guard import guarded
from amberbox.monitoring.watcher.reader import Block
from amberbox.monitoring.watcher.replay import WARM_UP_S, Part, blocks


@dataclass(slots=True)
class _Heard:
    """The last diagnosis, and of each symptom the last time that it was there."""

    diagnosis: Diagnosis | None = None
    present: dict[str, Symptom] = field(default_factory=dict)

    def hear(self, found: Iterable[Finding]) -> None:
        for finding in found:
            if isinstance(finding, Diagnosis):
                self.diagnosis = finding
            elif isinstance(finding, Symptom) and finding.state == "present":
                self.present[finding.id] = finding

    def case(self, at_ns: int, situation: Situation) -> Case:
        """Return the case that this makes with what counts at an instant."""
        names = () if self.diagnosis is None else self.diagnosis.symptoms
        seen = tuple(self.present[name] for name in names if name in self.present)
        return Case(at_ns, situation, self.diagnosis, seen=seen)


def known_at(knowledge: Knowledge, plan: Plan, store: Store, at_ns: int, lookback_s: float) -> Case:
    """Return what was known at an instant: by the watcher's journal, else by evaluating.

    Raises UsageError where nothing was recorded.
    """
    if was_watched(store, knowledge.config_hash, at_ns):
        found = watched(knowledge, store, at_ns)
        if found is not None:
            return found
    return evaluated(knowledge, plan, store, at_ns, lookback_s)


def evaluated(
    knowledge: Knowledge, plan: Plan, store: Store, at_ns: int, lookback_s: float
) -> Case:
    """Evaluate the record before an instant, and a minute before that; nothing is written.

    Raises UsageError where nothing was recorded.
    """
    tracker, heard = Tracker(knowledge), _Heard()
    engine = Diagnosing(Engine(plan), tracker)
    evaluation = Evaluation(engine)
    with guarded(plan):
        for block in _between(plan, store, engine, at_ns - round(lookback_s * NS), at_ns):
            for found in evaluation.take(block):
                heard.hear(found)
    if evaluation.place is None:
        raise UsageError(
            f"nothing was recorded in the {duration(round(lookback_s * NS))} before "
            f"{format_time(at_ns)[:19]}; {_recorded(store)}",
            "amberbox gaps shows what is missing; give another --at or a longer --lookback",
        )
    reached_ns = evaluation.place.until_ns
    return replace(heard.case(reached_ns, tracker.situation()), origin="record")


def _recorded(store: Store) -> str:
    """Say from when to when a record has rows."""
    items = Record(store.path).items()
    if not items:
        return "the record has no rows"
    first_ns, last_ns = min(i.first_ns for i in items), max(i.last_ns for i in items)
    return f"the record goes from {format_time(first_ns)[:19]} to {format_time(last_ns)[:19]}"


def _between(
    plan: Plan, store: Store, engine: Diagnosing, from_ns: int, to_ns: int
) -> Iterator[Block]:
    """Give what is recorded of a span, and of the time in which monitors warm up before it."""
    start_ns = from_ns - round(WARM_UP_S * NS)
    part = Part(from_ns + round(engine.history_s * NS))  # windows fill within the span
    for block in blocks(plan, store, engine, part):
        if block.until_ns >= start_ns and block.start_ns <= to_ns:
            until_ns = min(block.until_ns, to_ns)
            yield replace(block, start_ns=max(block.start_ns, start_ns), until_ns=until_ns)
        if block.until_ns >= to_ns:
            return


def watched(knowledge: Knowledge, store: Store, at_ns: int) -> Case | None:
    """Return what a watcher has found of the record up to an instant, by its journal.

    None if it told of no symptom: it was of a version that did not, or had nothing to go by.
    """
    return case_of(knowledge, said_until(store, at_ns), at_ns)


def case_of(knowledge: Knowledge, said: Said, at_ns: int) -> Case | None:
    """Return what a watcher's words up to an instant make known; None if it told of no symptom."""
    if not said.symptoms:
        return None
    heard = _Heard()
    heard.hear(said.symptoms)
    heard.hear(said.diagnoses)
    symptoms = [*_told_before(heard.diagnosis, said.symptoms), *said.symptoms]
    return replace(heard.case(at_ns, counting(knowledge, symptoms, at_ns)), origin="watcher")


def _told_before(standing: Diagnosis | None, told: Iterable[Symptom]) -> Iterator[Symptom]:
    """Yield the symptoms of an open diagnosis that are told of in deleted files alone.

    Nothing was told of them since, so they are there still.
    """
    known = {symptom.id for symptom in told}
    if standing is not None and standing.state == "open":
        for name in standing.symptoms:
            if name not in known:
                yield Symptom(name, "present", name)


def counting(knowledge: Knowledge, symptoms: Iterable[Symptom], at_ns: int) -> Situation:
    """Return what counts at an instant of symptoms that were told up to then, in order."""
    presences = Presences(knowledge.fmea)
    for symptom in symptoms:
        presences.take(symptom, symptom.confirmed_ns or 0)
    waits_ns = Waits(knowledge.fmea).until_ns(presences.onsets(at_ns))
    counts = presences.counting(at_ns, waits_ns)
    shown = (presences[name].shown(counted) for name, counted in counts.items())
    return Situation(tuple(shown), watched=True)
