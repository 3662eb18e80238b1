"""The one answer: from what is known at an instant to a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.types import AmbiguityGroup, Diagnosis
from amberbox.diagnosis.covering.answer import Answer, diagnose
from amberbox.diagnosis.covering.budget import Budget
from amberbox.diagnosis.covering.evidence import Evidence
from amberbox.diagnosis.covering.next_test import next_tests, splitting_test
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import with_make_safe
from amberbox.diagnosis.situation import Situation, evidence


@dataclass(frozen=True, slots=True)
class Heading:
    """Which diagnosis it is, and of when."""

    id: str
    revision: int
    at_ns: int


@dataclass(frozen=True, slots=True)
class Effort:
    """How much an answer may cost, and how much of it is wanted."""

    hypotheses: int = 20
    mass: float = 0.99
    budget: Budget = field(default_factory=Budget)
    tests: int = 5


def answer(
    knowledge: Knowledge, situation: Situation, heading: Heading, effort: Effort = Effort()
) -> Diagnosis:
    """Return the diagnosis of a situation: a pure function of what is given.

    Raises UsageError for answers and conflicts that name what the knowledge does not have.
    """
    known = evidence(knowledge, situation)
    found = diagnose(
        knowledge.model, known, max_hypotheses=effort.hypotheses, mass=effort.mass,
        budget=effort.budget,
    )  # fmt: skip
    checks = tuple(knowledge.checks.values())
    tests = next_tests(knowledge.model, known, found.hypotheses, checks, most=effort.tests)
    made = Diagnosis(
        heading.id,
        heading.revision,
        knowledge.robot,
        heading.at_ns,
        knowledge.config_hash,
        found.hypotheses,
        found.mass_covered,
        found.incomplete,
        (*found.findings, *situation.findings),
        tuple(proposal.test for proposal in tests),
        _groups(knowledge, known, found),
        tuple(symptom.id for symptom in situation.present()),
    )
    return with_make_safe(knowledge.fmea, made)


def _groups(knowledge: Knowledge, known: Evidence, found: Answer) -> tuple[AmbiguityGroup, ...]:
    return tuple(
        replace(group, split_by=_split(knowledge, known, found, group.members))
        for group in found.groups
    )


def _split(knowledge: Knowledge, known: Evidence, found: Answer, members: Sequence[str]) -> str:
    if len(members) < 2:
        return ""
    checks = tuple(knowledge.checks.values())
    best = splitting_test(knowledge.model, known, found.hypotheses, members, checks)
    return "" if best is None else best.test.id
