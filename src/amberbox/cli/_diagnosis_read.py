"""What was known of a robot at an instant, from its record: by its watcher, else evaluated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from amberbox.blackbox.store import Store
from amberbox.cli._diagnosis_case import Case
from amberbox.cli._diagnosis_journal import said_until
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation
from amberbox.diagnosis.tracking.absence import Waits
from amberbox.diagnosis.tracking.presence import Presences
from amberbox.diagnosis.tracking.tracker import Tracker
from amberbox.monitoring.engine.engine import Engine
from amberbox.monitoring.engine.findings import Finding
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.watcher.diagnosing import Diagnosing
from amberbox.monitoring.watcher.evaluation import Evaluation
from amberbox.monitoring.watcher.guard import guarded
from amberbox.monitoring.watcher.replay import Part, blocks


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


def evaluated(
    knowledge: Knowledge, plan: Plan, store: Store, at_ns: int, lookback_s: float
) -> Case:
    """Evaluate the record before an instant; nothing is written."""
    tracker, heard = Tracker(knowledge), _Heard()
    engine = Diagnosing(Engine(plan), tracker)
    evaluation = Evaluation(engine)
    part = Part(at_ns - round(lookback_s * NS))
    with guarded(plan):
        for block in blocks(plan, store, engine, part):
            until_ns = min(block.until_ns, at_ns)
            for found in evaluation.take(replace(block, until_ns=until_ns)):
                heard.hear(found)
            if block.until_ns >= at_ns:
                break
    place = evaluation.place
    reached_ns = at_ns if place is None else min(place.until_ns, at_ns)
    return replace(heard.case(reached_ns, tracker.situation()), origin="record")


def watched(knowledge: Knowledge, store: Store, at_ns: int) -> Case:
    """Return what a watcher has found of the record up to an instant, by its journal."""
    said, heard = said_until(store, at_ns), _Heard()
    heard.hear(said.symptoms)
    heard.hear(said.diagnoses)
    situation = counting(knowledge, said.symptoms, at_ns)
    return replace(heard.case(at_ns, situation), origin="watcher")


def counting(knowledge: Knowledge, symptoms: Iterable[Symptom], at_ns: int) -> Situation:
    """Return what counts at an instant of symptoms that were told up to then, in order."""
    presences = Presences(knowledge.fmea)
    for symptom in symptoms:
        presences.take(symptom, symptom.confirmed_ns or 0)
    waits_ns = Waits(knowledge.fmea).until_ns(presences.onsets(at_ns))
    counts = presences.counting(at_ns, waits_ns)
    shown = (presences[name].shown(counted) for name, counted in counts.items())
    return Situation(tuple(shown), watched=True)
