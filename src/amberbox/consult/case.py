"""What is known of a robot at an instant, and the answer to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from amberbox.core.timetext import format_time
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.answering import Heading, answer
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation

Origin: TypeAlias = Literal["watcher", "record", "given", "status"]
"""Who says what the symptoms are: the watcher's journal, an evaluation, the user alone; or only
the watcher's statuses, which a server has of it (they say nothing of conditions)."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is known at an instant, and the last revision of a diagnosis up to then, if any.

    ``seen`` are the symptoms of that diagnosis as they were; they need not be there any more.
    ``has_more`` tells that more is known than what that diagnosis was made of.
    """

    at_ns: int
    situation: Situation = field(default_factory=Situation)
    standing: Diagnosis | None = None
    origin: Origin = "given"
    seen: tuple[Symptom, ...] = ()
    has_more: bool = False

    @property
    def is_over(self) -> bool:
        """Tell whether the last diagnosis has healed, so that nothing is wrong now."""
        return self.standing is not None and self.standing.state == "healed"

    @property
    def open(self) -> Diagnosis | None:
        """Return the diagnosis that stands, if one does that is not over."""
        return None if self.is_over else self.standing

    def told(self, symptoms: Sequence[Symptom], answers: Mapping[str, str]) -> Case:
        """Return the case with what somebody says; it counts before what was read.

        Answers alone, once a diagnosis is over, are about what it was.
        """
        about_it = self.seen if self.is_over and not symptoms else ()
        standing = None if self.is_over and symptoms else self.standing
        said = {symptom.id: symptom for symptom in (*about_it, *symptoms)}
        read = (symptom for symptom in self.situation.symptoms if symptom.id not in said)
        situation = replace(
            self.situation,
            symptoms=(*read, *said.values()),
            answers={**self.situation.answers, **answers},
        )
        return replace(self, situation=situation, standing=standing, seen=(), has_more=True)


def answered(knowledge: Knowledge, case: Case) -> Diagnosis | None:
    """Return the diagnosis of a case; None where nothing speaks for a fault.

    What stood stays as it is where nothing more is known.
    """
    if case.standing is not None and not case.has_more:
        return case.standing
    situation = case.situation
    if not (situation.present() or situation.answers or situation.conflicts):
        return None
    made = answer(knowledge, case.situation, heading_of(knowledge, case))
    if case.standing is None or not case.is_over:
        return made
    return replace(made, state="healed", at_ns=case.standing.at_ns)


def heading_of(knowledge: Knowledge, case: Case) -> Heading:
    """Name the diagnosis as the one that stood is named; without one, by the instant."""
    if case.standing is not None:
        return Heading(case.standing.id, case.standing.revision, case.at_ns)
    stamp = format_time(case.at_ns)[:19].replace("-", "").replace(":", "").lower()
    return Heading(f"{knowledge.robot}-{stamp}", 1, case.at_ns)


def is_wrong(case: Case, diagnosis: Diagnosis | None) -> bool:
    """Tell whether something is wrong: a symptom is there, or a fault leads."""
    if diagnosis is None or diagnosis.state == "healed":
        return False
    leading = diagnosis.hypotheses[:1]
    return bool(case.situation.present()) or any(entry.faults for entry in leading)
