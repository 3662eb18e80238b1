"""An answer about a robot: what explains it, and all of it as one object of JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from amberbox.consult.case import Case
from amberbox.consult.plain import diagnosis_json, plain, symptoms_json
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.explanation import Explanation, explain
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import evidence

_NONE = "none"
"""The state of a robot of which there is no diagnosis."""


def explained(knowledge: Knowledge, case: Case, diagnosis: Diagnosis | None) -> Explanation | None:
    """Explain a diagnosis by the symptoms that it was made of."""
    if diagnosis is None:
        return None
    return explain(diagnosis, knowledge, _seen(case))


def json_of(
    knowledge: Knowledge, case: Case, diagnosis: Diagnosis | None, explanation: Explanation | None
) -> dict[str, Any]:
    """Return all of it as one object."""
    counted = evidence(knowledge, case.situation).observations
    shown = diagnosis_json(diagnosis) if diagnosis else _no_diagnosis(knowledge, case)
    more = {
        "symptoms": symptoms_json(case.situation.symptoms, counted),
        "answers": dict(case.situation.answers),
        "explanation": explanation,
        "origin": case.origin,
    }
    return {key: plain(value) for key, value in (shown | more).items()}


def _seen(case: Case) -> Sequence[Symptom]:
    """Return what is known of symptoms; those of the diagnosis as they were when it was made."""
    present = {symptom.id for symptom in case.situation.present()}
    before = [s for s in with_ends(case.seen, case.situation.symptoms) if s.id not in present]
    past = {symptom.id for symptom in before}
    return (*before, *(s for s in case.situation.symptoms if s.id not in past))


def with_ends(seen: Iterable[Symptom], now: Iterable[Symptom]) -> list[Symptom]:
    """Return symptoms as they were, with when they went by what is known of them now."""
    ends = {s.id: s.confirmed_ns if s.state == "absent" else s.gone_ns for s in now}
    return [replace(symptom, gone_ns=ends.get(symptom.id)) for symptom in seen]


def _no_diagnosis(knowledge: Knowledge, case: Case) -> dict[str, Any]:
    of = "", 0, knowledge.robot, case.at_ns, knowledge.config_hash
    nothing = Diagnosis(*of, (), 1.0, findings=case.situation.findings)
    return diagnosis_json(nothing) | {"state": _NONE}
