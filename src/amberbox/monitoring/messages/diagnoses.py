"""Symptoms and diagnoses as records of a journal, and back without loss.

Failure modes of a hypothesis, which have no order, are written in that of the alphabet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom, Test
from amberbox.monitoring.messages.forms import (
    FLAG,
    NUMBER,
    SAME,
    TEXTS,
    TIME_IF_ANY,
    WHOLE,
    Form,
    Forms,
    Values,
)


def symptom_values(symptom: Symptom) -> Values:
    """Return what is written of a symptom."""
    return _SYMPTOM.write(symptom)


def symptom_of(values: Values) -> Symptom:
    """Return the symptom that a record says."""
    return _SYMPTOM.read(values)


def diagnosis_values(diagnosis: Diagnosis) -> Values:
    """Return what is written of a diagnosis."""
    return _DIAGNOSIS.write(diagnosis)


def diagnosis_of(values: Values) -> Diagnosis:
    """Return the diagnosis that a record says."""
    return _DIAGNOSIS.read(values)


def _evidence_values(evidence: Sequence[tuple[str, int, int]]) -> Sequence[Values]:
    return [
        {"address": address, "from_ns": from_ns, "to_ns": to_ns}
        for address, from_ns, to_ns in evidence
    ]


def _evidence_of(entries: Sequence[Values]) -> tuple[tuple[str, int, int], ...]:
    return tuple((e["address"], int(e["from_ns"]), int(e["to_ns"])) for e in entries)


def _outcomes_values(outcomes: Mapping[str, float]) -> Sequence[Values]:
    return [
        {"answer": answer, "probability": probability} for answer, probability in outcomes.items()
    ]


def _outcomes_of(entries: Sequence[Values]) -> dict[str, float]:
    return {entry["answer"]: float(entry["probability"]) for entry in entries}


_SYMPTOM = Forms(Symptom, {
    "id": SAME, "state": SAME, "address": SAME, "onset_ns": TIME_IF_ANY,
    "confirmed_ns": TIME_IF_ANY, "strength": NUMBER, "source": SAME,
    "evidence": Form(_evidence_values, _evidence_of), "blocked_by": TEXTS,
    "reason": Form(default=""),
})  # fmt: skip
_HYPOTHESIS = Forms(Hypothesis, {
    "id": SAME, "faults": Form(sorted, frozenset), "probability": NUMBER, "explains": TEXTS,
    "unexplained": TEXTS, "contradicted": TEXTS, "ambiguity": TEXTS, "proof": SAME,
    "criticality": NUMBER,
})  # fmt: skip
_GROUP = Forms(AmbiguityGroup, {
    "members": TEXTS, "probability": NUMBER, "wider": TEXTS, "split_by": SAME,
})  # fmt: skip
_TEST = Forms(Test, {
    "id": SAME, "kind": SAME, "text": SAME, "role": SAME, "cost_s": NUMBER, "risk": NUMBER,
    "gain_bits": NUMBER, "outcomes": Form(_outcomes_values, _outcomes_of),
})  # fmt: skip
_DIAGNOSIS = Forms(Diagnosis, {
    "id": SAME, "revision": WHOLE, "robot": SAME, "at_ns": WHOLE, "state": SAME,
    "symptoms": TEXTS, "hypotheses": _HYPOTHESIS.many, "groups": _GROUP.many,
    "mass_covered": NUMBER, "incomplete": SAME, "findings": TEXTS, "next_tests": _TEST.many,
    "config_hash": SAME, "live_only": FLAG, "make_safe": Form(read=tuple, default=()),
})  # fmt: skip
