"""Symptoms and diagnoses as records of a journal, and back without loss.

Failure modes of a hypothesis, which have no order, are written in that of the alphabet.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom, Test

Values = Mapping[str, Any]


def symptom_values(symptom: Symptom) -> Values:
    """Return what is written of a symptom."""
    return {
        "id": symptom.id,
        "state": symptom.state,
        "address": symptom.address,
        "onset_ns": symptom.onset_ns,
        "confirmed_ns": symptom.confirmed_ns,
        "strength": symptom.strength,
        "source": symptom.source,
        "evidence": [
            {"address": address, "from_ns": from_ns, "to_ns": to_ns}
            for address, from_ns, to_ns in symptom.evidence
        ],
        "blocked_by": symptom.blocked_by,
    }


def symptom_of(values: Values) -> Symptom:
    """Return the symptom that a record says."""
    return Symptom(
        id=values["id"],
        state=values["state"],
        address=values["address"],
        onset_ns=_time(values["onset_ns"]),
        confirmed_ns=_time(values["confirmed_ns"]),
        strength=float(values["strength"]),
        source=values["source"],
        evidence=tuple(
            (entry["address"], int(entry["from_ns"]), int(entry["to_ns"]))
            for entry in values["evidence"]
        ),
        blocked_by=tuple(values["blocked_by"]),
    )


def _time(value: Any) -> int | None:
    return None if value is None else int(value)


def diagnosis_values(diagnosis: Diagnosis) -> Values:
    """Return what is written of a diagnosis."""
    return {
        "id": diagnosis.id,
        "revision": diagnosis.revision,
        "robot": diagnosis.robot,
        "at_ns": diagnosis.at_ns,
        "state": diagnosis.state,
        "symptoms": diagnosis.symptoms,
        "hypotheses": [_hypothesis_values(entry) for entry in diagnosis.hypotheses],
        "groups": [_group_values(entry) for entry in diagnosis.groups],
        "mass_covered": diagnosis.mass_covered,
        "incomplete": diagnosis.incomplete,
        "findings": diagnosis.findings,
        "next_tests": [_test_values(entry) for entry in diagnosis.next_tests],
        "config_hash": diagnosis.config_hash,
        "live_only": diagnosis.live_only,
    }


def diagnosis_of(values: Values) -> Diagnosis:
    """Return the diagnosis that a record says."""
    return Diagnosis(
        id=values["id"],
        revision=int(values["revision"]),
        robot=values["robot"],
        at_ns=int(values["at_ns"]),
        config_hash=values["config_hash"],
        hypotheses=tuple(_hypothesis_of(entry) for entry in values["hypotheses"]),
        mass_covered=float(values["mass_covered"]),
        incomplete=values["incomplete"],
        findings=tuple(values["findings"]),
        next_tests=tuple(_test_of(entry) for entry in values["next_tests"]),
        groups=tuple(_group_of(entry) for entry in values["groups"]),
        symptoms=tuple(values["symptoms"]),
        state=values["state"],
        live_only=bool(values["live_only"]),
    )


def _hypothesis_values(hypothesis: Hypothesis) -> Values:
    return {
        "id": hypothesis.id,
        "faults": sorted(hypothesis.faults),
        "probability": hypothesis.probability,
        "explains": hypothesis.explains,
        "unexplained": hypothesis.unexplained,
        "contradicted": hypothesis.contradicted,
        "ambiguity": hypothesis.ambiguity,
        "proof": hypothesis.proof,
        "criticality": hypothesis.criticality,
    }


def _hypothesis_of(values: Values) -> Hypothesis:
    return Hypothesis(
        id=values["id"],
        faults=frozenset(values["faults"]),
        probability=float(values["probability"]),
        explains=tuple(values["explains"]),
        unexplained=tuple(values["unexplained"]),
        contradicted=tuple(values["contradicted"]),
        ambiguity=tuple(values["ambiguity"]),
        proof=values["proof"],
        criticality=float(values["criticality"]),
    )


def _group_values(group: AmbiguityGroup) -> Values:
    return {
        "members": group.members,
        "probability": group.probability,
        "wider": group.wider,
        "split_by": group.split_by,
    }


def _group_of(values: Values) -> AmbiguityGroup:
    members, wider = tuple(values["members"]), tuple(values["wider"])
    return AmbiguityGroup(members, float(values["probability"]), wider, values["split_by"])


def _test_values(test: Test) -> Values:
    return {
        "id": test.id,
        "kind": test.kind,
        "text": test.text,
        "role": test.role,
        "cost_s": test.cost_s,
        "risk": test.risk,
        "gain_bits": test.gain_bits,
        "outcomes": _outcomes_values(test.outcomes.items()),
    }


def _outcomes_values(outcomes: Iterable[tuple[str, float]]) -> Sequence[Values]:
    return [{"answer": answer, "probability": probability} for answer, probability in outcomes]


def _test_of(values: Values) -> Test:
    return Test(
        id=values["id"],
        kind=values["kind"],
        text=values["text"],
        role=values["role"],
        cost_s=float(values["cost_s"]),
        risk=float(values["risk"]),
        gain_bits=float(values["gain_bits"]),
        outcomes={o["answer"]: float(o["probability"]) for o in values["outcomes"]},
    )
