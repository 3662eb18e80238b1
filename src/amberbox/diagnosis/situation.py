"""What is known of a robot at an instant: symptoms, answers to tests, what is proven."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.types import Symptom
from amberbox.diagnosis.covering.check import Check, reading
from amberbox.diagnosis.covering.evidence import Evidence, evidence_of
from amberbox.diagnosis.covering.next_test import with_answer
from amberbox.diagnosis.knowledge import Knowledge


@dataclass(frozen=True, slots=True)
class Situation:
    """What is known at an instant.

    A symptom that is unknown, or blocked by something that its component depends on, is no
    evidence. ``answers`` are what tests gave, by the test's id (``cannot check`` is one).
    ``conflicts`` are sets of failure modes of which other engines proved that at least one is
    there. ``watched`` says that the symptoms come from a watcher, which reads them all as soon as
    they can be read: reading them is no test. ``findings`` are texts of what other engines found
    that speaks for no failure mode.
    """

    symptoms: tuple[Symptom, ...] = ()
    answers: Mapping[str, str] = field(default_factory=dict)
    conflicts: tuple[frozenset[str], ...] = ()
    watched: bool = False
    findings: tuple[str, ...] = ()

    def present(self) -> tuple[Symptom, ...]:
        """Return the symptoms that are there and count, in order of onset."""
        there = (s for s in self.symptoms if s.state == "present" and not s.blocked_by)
        return tuple(sorted(there, key=lambda s: (s.onset_ns or 0, s.id)))


def evidence(knowledge: Knowledge, situation: Situation) -> Evidence:
    """Return what counts of a situation.

    Raises UsageError for an answer to a test that there is not, or that the test does not give.
    """
    counting = (_asked(symptom) for symptom in situation.symptoms if not symptom.blocked_by)
    found = evidence_of(counting, situation.conflicts)
    if situation.watched:
        read = frozenset(f"read:{sign.id}" for sign in knowledge.model.signs)
        found = replace(found, asked=found.asked | read)
    for test, answer in situation.answers.items():
        found = with_answer(found, check_named(knowledge, test), answer)
    return found


def _asked(symptom: Symptom) -> Symptom:
    """Take the FMEA's own conditions for what monitors say: both are questions of one author.

    The author has given both a ``detects``, knowing that they look at the same measurement.
    """
    return replace(symptom, source="monitor") if symptom.source == "condition" else symptom


def check_named(knowledge: Knowledge, test: str) -> Check:
    """Return the check of an id; ``read:SYMPTOM`` is the reading of a symptom."""
    symptom = test.removeprefix("read:")
    if test in knowledge.checks:
        return knowledge.checks[test]
    if symptom != test and symptom in knowledge.model.sign_places:
        return reading(symptom, 0.0)
    known = [*knowledge.checks, *(f"read:{sign.id}" for sign in knowledge.model.signs)]
    raise UsageError(f"there is no test '{test}'{did_you_mean(test, known)}")
