"""What is broken on a robot, or was: its own evidence, its own folder of then, our engines."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from amberbox.consult.case import Case
from amberbox.consult.declared import Declared
from amberbox.consult.engines import Ground, diagnosis_by, with_findings
from amberbox.consult.given import given_answers, given_symptoms
from amberbox.consult.journal import Said
from amberbox.consult.reading import case_of
from amberbox.consult.span import DAY_NS
from amberbox.consult.telling import explained, json_of, with_ends
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timetext import format_time
from amberbox.core.types import Symptom
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation
from amberbox.fleet.data.recorded import Stores
from amberbox.fleet.knowledge.asked import AskDiagnosis
from amberbox.fleet.knowledge.listing import find
from amberbox.fleet.knowledge.moment import Moment, moment
from amberbox.fleet.knowledge.past import past_of
from amberbox.fleet.knowledge.statuses import symptoms_of
from amberbox.fleet.knowledge.then import folder_of_then


def answered(folder: Path, stores: Stores, asked: AskDiagnosis) -> dict[str, Any]:
    """Return the answer as ``amberbox diagnose --json`` gives it, with ``notes``."""
    then = _moment(stores, asked)
    subject, notes = folder_of_then(
        folder, stores.database, asked.robot, asked.config_hash, then.config_hash
    )
    knowledge = subject.knowledge(asked.exposure_h)
    case = _case(knowledge, subject, then)
    if asked.diagnosis and not asked.at:
        case = _as_revised(case)
    symptoms = given_symptoms(_texts(asked.symptoms), knowledge, case.at_ns)
    answers = given_answers(_texts(asked.answers), knowledge)
    case = case.told(symptoms, answers) if symptoms or answers else case
    ground = Ground(knowledge, subject.folder.path, _past(stores, asked.robot), DAY_NS)
    case, notes = _by_rules(ground, case, asked.engine, notes)
    diagnosis = diagnosis_by(asked.engine, ground, case)
    explanation = explained(knowledge, case, diagnosis)
    answer = json_of(knowledge, case, diagnosis, explanation)
    return {**answer, "engine": asked.engine, "notes": [*then.notes, *notes]}


def _moment(stores: Stores, asked: AskDiagnosis) -> Moment:
    """Return what was known then; of a diagnosis of old when it was revised, by default last."""
    if not asked.diagnosis:
        return moment(stores, asked.robot, asked.at, asked.now_ns)
    known = find(stores, asked.robot, asked.diagnosis)
    if known is None:
        raise UsageError(f"{asked.robot} has no diagnosis '{asked.diagnosis}'")
    if not asked.at:
        last_ns = (known.until(asked.revision) if asked.revision else known).last.at_ns
        return moment(stores, asked.robot, format_time(last_ns), asked.now_ns, last_ns)
    return moment(stores, asked.robot, asked.at, asked.now_ns)


def _case(knowledge: Knowledge, subject: Declared, then: Moment) -> Case:
    """Return what was known, by the watcher's symptoms, else by its statuses alone."""
    said = _known(knowledge, then.said)
    case = case_of(knowledge, said, then.at_ns)
    if case is not None:
        return replace(case, origin="watcher")
    symptoms = tuple(symptoms_of(subject.plan, then.statuses))
    if not symptoms:
        return Case(then.at_ns)
    known = tuple(s for s in symptoms if s.id in knowledge.fmea.symptoms)
    return Case(then.at_ns, Situation(known, watched=True), origin="status", has_more=True)


def _as_revised(case: Case) -> Case:
    """Take as there what the robot's own revision was made of, and nothing else.

    Of what it had dropped by then, the words that made it do so may have been lost on the way.
    """
    if case.open is None:
        return case
    names = frozenset(case.open.symptoms)
    counting = case.situation.symptoms
    present = {s.id: s for s in (*case.seen, *counting) if s.state == "present"}
    shown = (present.get(name, Symptom(name, "present", name)) for name in case.open.symptoms)
    there = tuple(replace(one, blocked_by=()) for one in with_ends(shown, counting))
    rest = (
        replace(symptom, state="unknown") if symptom.state == "present" else symptom
        for symptom in counting if symptom.id not in names
    )  # fmt: skip
    return replace(case, situation=replace(case.situation, symptoms=(*there, *rest)))


def _known(knowledge: Knowledge, said: Said) -> Said:
    """Leave out symptoms that this folder's analysis does not know, of older or newer folders."""
    names = knowledge.fmea.symptoms
    return Said([s for s in said.symptoms if s.id in names], said.diagnoses)


def _past(stores: Stores, robot: str) -> Any:
    return partial(past_of, stores, robot)


def _by_rules(
    ground: Ground, case: Case, engine: str, notes: tuple[str, ...]
) -> tuple[Case, tuple[str, ...]]:
    """Add what the folder's rules find; rules that fail are told, the rest counts without them."""
    if engine == "rules":
        return case, notes
    try:
        return with_findings(ground, case), notes
    except AmberboxError as error:
        return case, (*notes, f"its rules were left out: {error.what}")


def _texts(given: dict[str, Any]) -> list[str]:
    return [f"{name}={word}" for name, word in given.items()]
