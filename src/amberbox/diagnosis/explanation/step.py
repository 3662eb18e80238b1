"""Do this next: the test that tells most, what its answers would mean, and what helps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from amberbox.core.errors import UsageError
from amberbox.core.sureness import SURE_WORDS, percent
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.diagnosis.covering.check import Check
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.covering.prediction import outcomes, predict
from amberbox.diagnosis.explanation.explanation import Branch, Step
from amberbox.diagnosis.explanation.names import Names, in_order
from amberbox.diagnosis.explanation.words import capital, duration, either
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import check_named

ALMOST_CERTAIN = SURE_WORDS[0][0]
NO_FAULT_STEP = "nothing for now; if it comes back, note what the robot was doing"
NO_TEST_STEP = "no test in the FMEA tells more"

Leading = tuple[AmbiguityGroup, Sequence[Hypothesis]]


def step_of(
    knowledge: Knowledge, names: Names, diagnosis: Diagnosis, leading: Leading | None
) -> Step:
    """Say what to do next: if one fault is almost certain mend it, else find out more."""
    group, members = leading or (AmbiguityGroup((), 0.0), ())
    remedies = _remedies(names, members)
    certain = len(members) == 1 and group.probability >= ALMOST_CERTAIN
    found = [_asked(knowledge, names, diagnosis, name) for name in _tests(diagnosis, group)]
    asked = [test for test in found if test is not None]
    if certain:
        asked = [test for test in asked if test.may_change_mind(names.faults(members[0].faults))]
    if not asked:
        return Step(_without_test(names, members, remedies), remedies=remedies)
    check, first = asked[0].check, "; and ".join(remedies)
    text = f"{first}; or make sure before: {asked[0].text}" if certain and first else asked[0].text
    return Step(
        capital(text),
        check.id,
        check.role,
        duration(check.cost_s) if check.cost_s else "",
        percent(check.risk) if check.risk else "",
        asked[0].answers,
        check.id == group.split_by,
        remedies,
    )


@dataclass(frozen=True, slots=True)
class Asked:
    """A test that may be done, in words, and what its answers would mean."""

    check: Check
    text: str
    answers: tuple[Branch, ...]

    def may_change_mind(self, leads: str) -> bool:
        """Tell whether an answer would make something else lead."""
        return any(branch.leads != leads for branch in self.answers)


def _tests(diagnosis: Diagnosis, group: AmbiguityGroup) -> Iterator[str]:
    """Yield tests, that which splits the leading group first."""
    names = dict.fromkeys((group.split_by, *(test.id for test in diagnosis.next_tests)))
    return (name for name in names if name)


def _asked(knowledge: Knowledge, names: Names, diagnosis: Diagnosis, test: str) -> Asked | None:
    try:
        check = check_named(knowledge, test)
    except UsageError:  # a test of another engine: nothing is known of what it would give
        return None
    text = f"Find out whether this shows: {names.symptom(check.reads)}" if check.reads else ""
    return Asked(check, text or check.text, _answers(knowledge, names, diagnosis, check))


def _without_test(names: Names, members: Sequence[Hypothesis], remedies: Sequence[str]) -> str:
    if members and not any(hypothesis.faults for hypothesis in members):
        return capital(NO_FAULT_STEP)
    if len(members) > 1 and remedies:
        return f"{capital(NO_TEST_STEP)}. Try in this order: {'; then '.join(remedies)}"
    if remedies:
        return capital("; and ".join(remedies))
    unknown = not members or any(UNKNOWN in hypothesis.faults for hypothesis in members)
    if not unknown:
        return capital(f"{NO_TEST_STEP}, and it names no remedy")
    explained = dict.fromkeys(name for h in members for name in h.explains)
    parts = dict.fromkeys(names.owner(name) for name in explained)
    where = either(list(parts)) or "the robot"
    return f"Look where the symptoms are ({where}), and add to fmea.yaml what you find"


def _remedies(names: Names, members: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Return what helps, that of the most probable first, each once."""
    faults = (names.fault(f) for h in members for f in in_order(h.faults))
    return tuple(dict.fromkeys(fault.remedy for fault in faults if fault.remedy))


def _answers(
    knowledge: Knowledge, names: Names, diagnosis: Diagnosis, check: Check
) -> tuple[Branch, ...]:
    """Return per answer how probable it is and what would lead then, by Bayes' rule.

    As in the choice of the test, what is not listed is taken to be out of the question.
    """
    model = knowledge.model
    listed = [h for h in diagnosis.hypotheses if h.faults <= model.mode_places.keys()]
    total = math.fsum(h.probability for h in listed)
    rows = [outcomes(model, check, predict(model, h.faults)) for h in listed]
    found = []
    for level, answer in enumerate(check.outcomes):
        joint = [h.probability * row[level] for h, row in zip(listed, rows, strict=True)]
        given = math.fsum(joint)
        if given <= 0:
            continue
        best = max(range(len(listed)), key=lambda place: joint[place])
        found.append(_branch(names, answer, given / total, listed[best], joint[best] / given))
    return tuple(found)


def _branch(names: Names, answer: str, chance: float, leads: Hypothesis, then: float) -> Branch:
    remedy = "; and ".join(_remedies(names, [leads]))
    return Branch(answer, chance, names.faults(leads.faults), then, remedy)
