"""A diagnosis as programs get it: one object of plain JSON (docs/diagnosing.md)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from amberbox.core.timetext import format_time
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom, Test


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
            "onset": _time(symptom.onset_ns),
            "confirmed": _time(symptom.confirmed_ns),
            "gone": _time(symptom.gone_ns),
            "reason": symptom.reason,
            "source": symptom.source,
            "blocked_by": list(symptom.blocked_by),
            "counted": symptom.id in counted,
        }
        for symptom in sorted(symptoms, key=_order)
    ]


def plain(value: Any) -> Any:
    """Return a value as JSON has it: no number that is not finite, no set."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, set | frozenset):
        return [plain(entry) for entry in sorted(value)]
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
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
    }


def _order(symptom: Symptom) -> tuple[int, int, str]:
    rank = ("present", "absent", "unknown").index(symptom.state)
    return rank, symptom.onset_ns or 0, symptom.id


def _time(at_ns: int | None) -> str | None:
    return None if at_ns is None else format_time(at_ns)
