"""A diagnosis and its explanation as plain JSON (docs/robot/diagnosing.md)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from amberbox.core.timestamps import format_time, maybe_time
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom, Test
from amberbox.diagnosis.diagnose import DiagnosisContext, evidence_of_situation
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import Explanation


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return everything of a diagnosis."""
    faults = {h.id: sorted(h.faults) for h in diagnosis.hypotheses}
    return {
        "id": diagnosis.id,
        "revision": diagnosis.revision,
        "robot": diagnosis.robot,
        "at": format_time(diagnosis.at_ns),
        "at_ns": diagnosis.at_ns,
        "state": diagnosis.state,
        "config_hash": diagnosis.config_hash,
        "mass_covered": diagnosis.mass_covered,
        "incomplete": bool(diagnosis.incomplete),
        "incomplete_because": diagnosis.incomplete,
        "hypotheses": [_hypothesis(entry) for entry in diagnosis.hypotheses],
        "groups": [_group(entry, faults) for entry in diagnosis.groups],
        "next_tests": [_test(entry) for entry in diagnosis.next_tests],
        "findings": list(diagnosis.findings),
        "make_safe": list(diagnosis.make_safe),
    }


def symptoms_json(symptoms: Sequence[Symptom], counted: Collection[str]) -> list[dict[str, Any]]:
    """Return symptoms: present ones first, by onset; ``counted`` are those that are evidence."""
    return [
        {
            "id": symptom.id,
            "state": symptom.state,
            "onset": maybe_time(symptom.onset_ns),
            "confirmed": maybe_time(symptom.confirmed_ns),
            "gone": maybe_time(symptom.gone_ns),
            "reason": symptom.reason,
            "size": symptom.size,
            "source": symptom.source,
            "blocked_by": list(symptom.blocked_by),
            "counted": symptom.id in counted,
        }
        for symptom in sorted(symptoms, key=_order)
    ]


def to_json(value: Any) -> Any:
    """Return a value as JSON has it: no number that is not finite, no set."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: to_json(getattr(value, field.name)) for field in fields}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): to_json(entry) for key, entry in value.items()}
    if isinstance(value, set | frozenset):
        return [to_json(entry) for entry in sorted(value)]
    if isinstance(value, list | tuple):
        return [to_json(entry) for entry in value]
    return value


def _hypothesis(hypothesis: Hypothesis) -> dict[str, Any]:
    return {
        "id": hypothesis.id,
        "faults": sorted(hypothesis.faults),
        "probability": hypothesis.probability,
        "explains": list(hypothesis.explains),
        "unexplained": list(hypothesis.unexplained),
        "contradicted": list(hypothesis.contradicted),
        "ambiguity": list(hypothesis.ambiguity),
        "proof": hypothesis.proof,
        "criticality": hypothesis.criticality,
        "follows": sorted(hypothesis.follows),
    }


def _group(group: AmbiguityGroup, faults: Mapping[str, list[str]]) -> dict[str, Any]:
    return {
        "members": list(group.members),
        "wider": list(group.wider),
        "probability": group.probability,
        "split_by": group.split_by or None,
        "faults": [faults.get(member, []) for member in group.members],
    }


def _test(test: Test) -> dict[str, Any]:
    return {
        "id": test.id,
        "kind": test.kind,
        "text": test.text,
        "role": test.role,
        "cost_s": test.cost_s,
        "risk": test.risk,
        "gain_bits": test.gain_bits,
        "outcomes": dict(test.outcomes),
        "run": test.run or None,
        "moves": test.moves,
    }


def _order(symptom: Symptom) -> tuple[int, int, str]:
    rank = ("present", "absent", "unknown").index(symptom.state)
    return rank, symptom.onset_ns or 0, symptom.id


_NONE = "none"  # the state of a robot of which there is no diagnosis


def explain_context(
    knowledge: Knowledge, case: DiagnosisContext, diagnosis: Diagnosis | None
) -> Explanation | None:
    """Explain a diagnosis by the symptoms that it was made of."""
    if diagnosis is None:
        return None
    return explain(diagnosis, knowledge, _seen(case))


def context_json(
    knowledge: Knowledge,
    case: DiagnosisContext,
    diagnosis: Diagnosis | None,
    explanation: Explanation | None,
) -> dict[str, Any]:
    """Return all of it as one object."""
    counted = evidence_of_situation(knowledge, case.situation).observations
    shown = diagnosis_json(diagnosis) if diagnosis else _no_diagnosis(knowledge, case)
    more = {
        "symptoms": symptoms_json(case.situation.symptoms, counted),
        "answers": dict(case.situation.answers),
        "explanation": explanation,
        "origin": case.origin,
    }
    return {key: to_json(value) for key, value in (shown | more).items()}


def _seen(case: DiagnosisContext) -> Sequence[Symptom]:
    """Return the known symptoms; those of a past diagnosis with their state at that time."""
    present = {symptom.id for symptom in case.situation.present()}
    before = [s for s in with_end_times(case.seen, case.situation.symptoms) if s.id not in present]
    past = {symptom.id for symptom in before}
    return (*before, *(s for s in case.situation.symptoms if s.id not in past))


def with_end_times(seen: Iterable[Symptom], now: Iterable[Symptom]) -> list[Symptom]:
    """Return earlier symptoms, with the times when they disappeared according to the
    present ones.
    """
    ends = {s.id: s.confirmed_ns if s.state == "absent" else s.gone_ns for s in now}
    return [replace(symptom, gone_ns=ends.get(symptom.id)) for symptom in seen]


def _no_diagnosis(knowledge: Knowledge, case: DiagnosisContext) -> dict[str, Any]:
    of = "", 0, knowledge.robot, case.at_ns, knowledge.config_hash
    nothing = Diagnosis(*of, (), 1.0, findings=case.situation.findings)
    return diagnosis_json(nothing) | {"state": _NONE}
