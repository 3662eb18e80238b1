"""A diagnosis on the screen, and as a line of JSON."""

from __future__ import annotations

import json

from amberbox.cli._diagnosis_follow import Known
from amberbox.consult.case import Case
from amberbox.consult.telling import json_of
from amberbox.core.timetext import format_time
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.explanation import Explanation, as_text, explain
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation
from amberbox.monitoring.messages.board import duration


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


def _ended(case: Case, diagnosis: Diagnosis) -> str:
    ago = duration(case.at_ns - diagnosis.at_ns)
    return f"nothing is wrong now; the last diagnosis ended {ago} ago:"
