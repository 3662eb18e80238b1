"""The next step: make it safe, then the most informative test, then the repair."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from amberbox.core.errors import UsageError
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.core.units import CONFIDENCE_WORDS, percent
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.covering.observations import Check, outcomes, predict
from amberbox.diagnosis.diagnose import check_named
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import MakeSafeAction, leading_ids, repair_action, safety_actions
from amberbox.diagnosis.report.explanation import (
    AnswerBranch,
    NextStep,
    ProposedAction,
    TestInstance,
)
from amberbox.diagnosis.report.wording import (
    FaultNames,
    capitalize,
    duration,
    instance_words,
    join_with_or,
    merge_texts,
    same_tests,
    sort_modes,
    test_text,
)

ALMOST_CERTAIN = CONFIDENCE_WORDS[0][0]
AS_LIKELY = 0.5  # from this share of what leads on, a false alarm counts as about as likely
# How much the chances of answers must differ for a test to distinguish fault and false alarm
DISCRIMINATES = 0.3
NO_FAULT_STEP = "nothing for now; if it comes back, note what the robot was doing"
NO_TEST_STEP = "no test in the FMEA tells more"
FALSE_ALARM_STEP = "a false alarm is about as likely, and no test in the FMEA tells which it is"

Leading = tuple[AmbiguityGroup, Sequence[Hypothesis]]


def step_of(
    knowledge: Knowledge,
    names: FaultNames,
    diagnosis: Diagnosis,
    leading: Leading | None,
) -> NextStep:
    """Return what to do next, in an order that is safe.

    Actions that make credible dangerous causes safe come first. Then, if one fault is almost
    certain, its repair, else the most informative test; no repair comes first while a false alarm
    is about as likely. ``leading`` has the active failure modes of the leading hypotheses.
    """
    ids = leading_ids(diagnosis.groups, diagnosis.hypotheses)
    safe = safety_actions(names.fmea, diagnosis.hypotheses, ids, names.cleared)
    group, members = leading or (AmbiguityGroup((), 0.0), ())
    first_of_all = tuple(_safe_actions(names, safe))
    remedies = _remedies(names, members, safe)
    asked = _best_candidate(knowledge, names, diagnosis, group, members)
    certain = _is_certain(group, members)
    if asked is None:
        rest, order = _without_test(names, diagnosis, group, members, remedies)
        return NextStep(
            _text(safe, rest), remedies=remedies, make_safe=first_of_all, then=rest,
            order=(*first_of_all, *order),
        )  # fmt: skip
    check, first = asked.check, "; and ".join(remedies)
    same_kind = same_tests(knowledge, diagnosis, check)
    which = f"Which one is it? {merge_texts([test_text(one) for one in same_kind])}"
    question = which if len(same_kind) > 1 else asked.text
    test = ProposedAction("test", question, check.id)
    repairs = tuple(ProposedAction("repair", remedy) for remedy in remedies)
    mends_first = certain and bool(first)
    rest = capitalize(f"{first}; or make sure before: {question}" if mends_first else question)
    return NextStep(
        _text(safe, rest),
        check.id,
        check.role,
        duration(check.cost_s) if check.cost_s else "",
        percent(check.risk) if check.risk else "",
        asked.answers,
        check.id == group.split_by,
        remedies,
        first_of_all,
        rest,
        (*first_of_all, *((*repairs, test) if mends_first else (test, *repairs))),
        _instances(names, same_kind),
        tuple(sorted({fault for one in same_kind for fault in _seen_by(diagnosis, one)})),
        check.kind,
        check.run,
    )


@dataclass(frozen=True, slots=True)
class CandidateTest:
    """A test that may be done, in words, and what its answers would mean."""

    check: Check
    text: str
    answers: tuple[AnswerBranch, ...]

    def may_change_mind(self, leads: str) -> bool:
        """Return whether an answer would make something else lead."""
        return any(branch.leads != leads for branch in self.answers)


def _instances(names: FaultNames, same_kind: Sequence[Check]) -> tuple[TestInstance, ...]:
    """Return the instances of tests that are asked as one question; nothing for a single one."""
    if len(same_kind) < 2:
        return ()
    components = [names.component(one.id.rpartition(".")[0]) for one in same_kind]
    where = instance_words([one.text for one in same_kind]) or components
    return tuple(
        TestInstance(word, one.id, one.outcomes) for word, one in zip(where, same_kind, strict=True)
    )


def _text(safe: Sequence[MakeSafeAction], rest: str) -> str:
    """Put the actions that make the robot safe before the other text, as worded in the FMEA."""
    if not safe:
        return rest
    return f"First, make it safe: {'; '.join(action.text for action in safe)}. Then: {rest}"


def _safe_actions(names: FaultNames, safe: Sequence[MakeSafeAction]) -> Iterator[ProposedAction]:
    """Yield the make-safe actions with their failure modes, the most probable first."""
    for one in safe:
        causes = join_with_or([names.mode(fault) for fault in one.faults], 2)
        why = f"{causes}, {percent(one.probability)}"
        yield ProposedAction("make_safe", one.text, "", one.faults, one.severity, why)


def _is_certain(group: AmbiguityGroup, members: Sequence[Hypothesis]) -> bool:
    return len(members) == 1 and group.probability >= ALMOST_CERTAIN


def _may_be_false_alarm(
    diagnosis: Diagnosis, group: AmbiguityGroup, members: Sequence[Hypothesis]
) -> bool:
    """Return whether faults lead and a false alarm is about as likely."""
    other = next((h for h in diagnosis.hypotheses if not h.faults), None)
    if other is None or not all(hypothesis.faults for hypothesis in members):
        return False
    return other.probability >= AS_LIKELY * group.probability


def _best_candidate(
    knowledge: Knowledge, names: FaultNames, diagnosis: Diagnosis, group: AmbiguityGroup,
    members: Sequence[Hypothesis],
) -> CandidateTest | None:  # fmt: skip
    """Return the test to do next, None if none is worth it.

    Where a false alarm is about as likely as the leading hypotheses, it distinguishes these.
    """
    tests = dict.fromkeys((group.split_by, *(test.id for test in diagnosis.next_tests)))
    found = [_candidate(knowledge, names, diagnosis, name) for name in tests if name]
    asked = [test for test in found if test and not _is_past(names, diagnosis, members, test.check)]
    if _is_certain(group, members):
        asked = [test for test in asked if test.may_change_mind(names.faults(members[0].faults))]
    if _may_be_false_alarm(diagnosis, group, members):
        asked.sort(key=lambda test: not _discriminates(knowledge, test.check, members))
    return asked[0] if asked else None


def _is_past(
    names: FaultNames, diagnosis: Diagnosis, members: Sequence[Hypothesis], check: Check
) -> bool:
    """Return whether a test is about causes alone that show no more, while others lead."""
    seen = _seen_by(diagnosis, check)
    led = {fault for h in members for fault in h.faults}
    return bool(seen) and seen <= names.cleared.keys() and not led <= names.cleared.keys()


def _seen_by(diagnosis: Diagnosis, check: Check) -> set[str]:
    """Return the failure modes of any hypothesis that a test sees."""
    listed = {fault for h in diagnosis.hypotheses for fault in h.faults}
    return listed & {detection.cause for detection in check.detections}


def _discriminates(knowledge: Knowledge, check: Check, members: Sequence[Hypothesis]) -> bool:
    """Return whether a test distinguishes the leading hypotheses from a false alarm."""
    model = knowledge.model
    sound = outcomes(model, check, predict(model, frozenset()))
    known = [h for h in members if h.faults <= model.mode_places.keys()]
    rows = [outcomes(model, check, predict(model, h.faults)) for h in known]
    total = math.fsum(h.probability for h in known)
    if total <= 0:
        return False
    mixed = [
        math.fsum(h.probability * row[k] for h, row in zip(known, rows, strict=True)) / total
        for k in range(len(sound))
    ]
    return math.fsum(abs(a - b) for a, b in zip(sound, mixed, strict=True)) / 2 >= DISCRIMINATES


def _candidate(
    knowledge: Knowledge, names: FaultNames, diagnosis: Diagnosis, test: str
) -> CandidateTest | None:
    try:
        check = check_named(knowledge, test)
    except UsageError:  # a test of another engine: nothing is known of what it would give
        return None
    text = test_text(check)
    if check.reads:
        text = f"Find out whether this shows: {names.symptom(check.reads)}"
    return CandidateTest(check, text, _answers(knowledge, names, diagnosis, check))


def _without_test(
    names: FaultNames, diagnosis: Diagnosis, group: AmbiguityGroup, members: Sequence[Hypothesis],
    remedies: Sequence[str],
) -> tuple[str, tuple[ProposedAction, ...]]:  # fmt: skip
    """Return what to do where no test is worth doing, as one text and in order."""
    repairs = tuple(ProposedAction("repair", remedy) for remedy in remedies)
    if members and not any(hypothesis.faults for hypothesis in members):
        return capitalize(NO_FAULT_STEP), (ProposedAction("watch", NO_FAULT_STEP),)
    if remedies and _may_be_false_alarm(diagnosis, group, members):
        # Name the symptoms that must show again before a part that may be well is repaired.
        seen = dict.fromkeys(name for h in members for name in h.explains)
        what = join_with_or([names.symptom(name) for name in seen], 2) or "what was seen"
        watch = f"{FALSE_ALARM_STEP}; see whether this shows again: {what}"
        return f"{capitalize(watch)}. If it does: {'; '.join(remedies)}", (
            ProposedAction("watch", watch), *repairs,
        )  # fmt: skip
    if len(members) > 1 and remedies:
        return f"{capitalize(NO_TEST_STEP)}. Try in this order: {'; then '.join(remedies)}", repairs
    if remedies:
        return capitalize("; and ".join(remedies)), repairs
    return _look_there(names, members), ()


def _look_there(names: FaultNames, members: Sequence[Hypothesis]) -> str:
    unknown = not members or any(UNKNOWN in hypothesis.faults for hypothesis in members)
    if not unknown:
        return capitalize(f"{NO_TEST_STEP}, and it names no remedy")
    explained = dict.fromkeys(name for h in members for name in h.explains)
    parts = dict.fromkeys(names.owner(name) for name in explained)
    where = join_with_or(list(parts)) or "the robot"
    return f"Look where the symptoms are ({where}), and add to fmea.yaml what you find"


def _remedies(
    names: FaultNames, members: Sequence[Hypothesis], safe: Sequence[MakeSafeAction] = ()
) -> tuple[str, ...]:
    """Return the remedies, that of the most probable cause first, each once.

    For causes with an action in ``safe`` only the part of the remedy that repairs.
    """
    covered = {fault for action in safe for fault in action.faults}
    found = dict.fromkeys(fault for h in members for fault in sort_modes(h.faults))
    modes = ((fault, names.fmea.modes.get(fault)) for fault in found)
    texts = (
        (repair_action(mode) if fault in covered else mode.remedy) for fault, mode in modes if mode
    )
    return tuple(dict.fromkeys(text for text in texts if text))


def _answers(
    knowledge: Knowledge, names: FaultNames, diagnosis: Diagnosis, check: Check
) -> tuple[AnswerBranch, ...]:
    """Return per answer its probability and the hypothesis that would lead then, by Bayes' rule.

    As in the choice of the test, hypotheses that are not listed are ignored.
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
        best = max(range(len(listed)), key=joint.__getitem__)
        remedy = "; and ".join(_remedies(names, [listed[best]]))
        leads = names.faults(listed[best].faults)
        found.append(AnswerBranch(answer, given / total, leads, joint[best] / given, remedy))
    return tuple(found)
