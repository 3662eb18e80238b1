"""A diagnosis on the screen, as JSON and as a drawing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from amberbox.cli._diagnosis_case import Case
from amberbox.cli._diagnosis_follow import Known
from amberbox.cli._diagnosis_json import diagnosis_json, plain, symptoms_json
from amberbox.core.timetext import format_time
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.explanation import Explanation, as_text, explain
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation, evidence
from amberbox.monitoring.messages.board import duration

_NONE = "none"
"""The state of a robot of which there is no diagnosis."""


def explained(knowledge: Knowledge, case: Case, diagnosis: Diagnosis | None) -> Explanation | None:
    """Explain a diagnosis by the symptoms that it was made of."""
    if diagnosis is None:
        return None
    return explain(diagnosis, knowledge, _seen(case))


def alone_text(engine: str, text: str) -> str:
    """Put on top of a text that one engine alone says so."""
    what = {
        "rules": "By the rules alone, which weigh nothing else:",
        "faulttree": "By the fault trees alone, which know of no false alarm:",
    }
    return f"{what[engine]}\n\n{text}" if engine in what else text


def text_of(case: Case, diagnosis: Diagnosis | None, explanation: Explanation | None) -> str:
    """Write for a person what is broken, or that nothing is."""
    if diagnosis is None or explanation is None:
        return nothing_wrong(case)
    text = as_text(explanation).rstrip("\n")
    return f"{_ended(case, diagnosis)}\n\n{text}" if diagnosis.state == "healed" else text


def nothing_wrong(case: Case) -> str:
    """Say that no symptom is there, and of how many nobody knows."""
    symptoms = case.situation.symptoms
    unknown = sum(symptom.state == "unknown" for symptom in symptoms)
    count = f"{len(symptoms)} symptom{'' if len(symptoms) == 1 else 's'}"
    looked = f"of {count} none is there"
    rest = f"; {unknown} are not known" if unknown else ""
    at = format_time(case.at_ns)[:19]
    found = "".join(
        f"\n  found, and no failure mode explains it: {f}" for f in case.situation.findings
    )
    return f"nothing is wrong at {at}: {looked}{rest}{found}"


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


def revision_text(knowledge: Knowledge, diagnosis: Diagnosis, symptoms: Known) -> str:
    """Write a revision for a person, below a line that tells it from the others."""
    at = format_time(diagnosis.at_ns)[:23]
    title = f"== {at} {diagnosis.id}, revision {diagnosis.revision}"
    if diagnosis.state == "healed":
        return f"{title}: healed, nothing is wrong any more\n"
    return f"{title}\n\n{as_text(explain(diagnosis, knowledge, symptoms.values()))}"


def line_of(knowledge: Knowledge, diagnosis: Diagnosis, symptoms: Known) -> str:
    """Return a revision as one line of JSON."""
    case = Case(diagnosis.at_ns, Situation(tuple(symptoms.values())), diagnosis, "watcher")
    explanation = explain(diagnosis, knowledge, symptoms.values())
    made = json_of(knowledge, case, diagnosis, explanation) | {"engine": "covering"}
    return json.dumps(made, ensure_ascii=False)


def _seen(case: Case) -> Sequence[Symptom]:
    """Return what is known of symptoms; those of the diagnosis as they were when it was made."""
    present = {symptom.id for symptom in case.situation.present()}
    before = [symptom for symptom in case.seen if symptom.id not in present]
    past = {symptom.id for symptom in before}
    return (*before, *(s for s in case.situation.symptoms if s.id not in past))


def _no_diagnosis(knowledge: Knowledge, case: Case) -> dict[str, Any]:
    of = "", 0, knowledge.robot, case.at_ns, knowledge.config_hash
    nothing = Diagnosis(*of, (), 1.0, findings=case.situation.findings)
    return diagnosis_json(nothing) | {"state": _NONE}


def _ended(case: Case, diagnosis: Diagnosis) -> str:
    ago = duration(case.at_ns - diagnosis.at_ns)
    return f"nothing is wrong now; the last diagnosis ended {ago} ago:"
