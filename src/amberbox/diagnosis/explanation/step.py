"""Do this next: make it safe, then the test that tells most, then what mends it."""

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
from amberbox.diagnosis.explanation.explanation import Action, Branch, Instance, Step
from amberbox.diagnosis.explanation.instances import instance_words, merged, siblings
from amberbox.diagnosis.explanation.names import Names, in_order
from amberbox.diagnosis.explanation.words import capital, duration, either
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import MakeSafe, leading_ids, make_safe, repair
from amberbox.diagnosis.situation import check_named

ALMOST_CERTAIN = SURE_WORDS[0][0]
AS_LIKELY = 0.5
"""From this share of what leads on, a false alarm counts as about as likely."""
TELLS_APART = 0.3
"""How much the chances of answers must differ for a test to tell a fault from a false alarm."""
NO_FAULT_STEP = "nothing for now; if it comes back, note what the robot was doing"
NO_TEST_STEP = "no test in the FMEA tells more"
FALSE_ALARM_STEP = "a false alarm is about as likely, and no test in the FMEA tells which it is"

Leading = tuple[AmbiguityGroup, Sequence[Hypothesis]]


def step_of(
    knowledge: Knowledge,
    names: Names,
    diagnosis: Diagnosis,
    leading: Leading | None,
) -> Step:
    """Say what to do next, in the order in which it is safe.

    What makes credible dangerous causes safe comes first. Then, if one fault is almost certain,
    what mends it, else the test that tells more; nothing is mended first while a false alarm is
    about as likely. ``leading`` has what is active of the hypotheses that lead.
    """
    ids = leading_ids(diagnosis.groups, diagnosis.hypotheses)
    safe = make_safe(names.fmea, diagnosis.hypotheses, ids, names.cleared)
    group, members = leading or (AmbiguityGroup((), 0.0), ())
    remedies = _remedies(names, members, safe)
    asked = _worth_asking(knowledge, names, diagnosis, group, members)
    certain = _is_certain(group, members)
    if asked is None:
        rest, order = _without_test(names, diagnosis, group, members, remedies)
        return Step(
            _text(safe, rest), remedies=remedies, make_safe=_told(names, safe), then=rest,
            order=(*_told(names, safe), *order),
        )  # fmt: skip
    check, first = asked.check, "; and ".join(remedies)
    alike = siblings(knowledge, diagnosis, check)
    which = f"Which one is it? {merged([one.text for one in alike])}"
    asks = which if len(alike) > 1 else asked.text
    test = Action("test", asks, check.id)
    repairs = tuple(Action("repair", remedy) for remedy in remedies)
    mends_first = certain and bool(first)
    rest = capital(f"{first}; or make sure before: {asks}" if mends_first else asks)
    return Step(
        _text(safe, rest),
        check.id,
        check.role,
        duration(check.cost_s) if check.cost_s else "",
        percent(check.risk) if check.risk else "",
        asked.answers,
        check.id == group.split_by,
        remedies,
        _told(names, safe),
        rest,
        (*_told(names, safe), *((*repairs, test) if mends_first else (test, *repairs))),
        _instances(names, alike),
        tuple(sorted({fault for one in alike for fault in _seen_by(diagnosis, one)})),
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


def _instances(names: Names, alike: Sequence[Check]) -> tuple[Instance, ...]:
    """Say where tests are done that are asked as one; nothing for one alone."""
    if len(alike) < 2:
        return ()
    components = [names.component(one.id.rpartition(".")[0]) for one in alike]
    where = instance_words([one.text for one in alike]) or components
    return tuple(
        Instance(word, one.id, one.outcomes) for word, one in zip(where, alike, strict=True)
    )


def _text(safe: Sequence[MakeSafe], rest: str) -> str:
    """Put what makes safe before all the rest, in the words of the FMEA."""
    if not safe:
        return rest
    return f"First, make it safe: {'; '.join(action.text for action in safe)}. Then: {rest}"


def _told(names: Names, safe: Sequence[MakeSafe]) -> tuple[Action, ...]:
    return tuple(
        Action("make_safe", one.text, "", one.faults, one.severity, _danger(names, one))
        for one in safe
    )


def _danger(names: Names, one: MakeSafe) -> str:
    """Say against what an action is, the most probable first."""
    return f"{either([names.mode(fault) for fault in one.faults], 2)}, {percent(one.probability)}"


def _is_certain(group: AmbiguityGroup, members: Sequence[Hypothesis]) -> bool:
    return len(members) == 1 and group.probability >= ALMOST_CERTAIN


def _false_alarm(diagnosis: Diagnosis) -> Hypothesis | None:
    return next((h for h in diagnosis.hypotheses if not h.faults), None)


def _may_be_false_alarm(
    diagnosis: Diagnosis, group: AmbiguityGroup, members: Sequence[Hypothesis]
) -> bool:
    """Tell whether faults lead and a false alarm is about as likely."""
    other = _false_alarm(diagnosis)
    if other is None or not all(hypothesis.faults for hypothesis in members):
        return False
    return other.probability >= AS_LIKELY * group.probability


def _worth_asking(
    knowledge: Knowledge, names: Names, diagnosis: Diagnosis, group: AmbiguityGroup,
    members: Sequence[Hypothesis],
) -> Asked | None:  # fmt: skip
    """Return the test to do next, None if none is worth it.

    Where a false alarm is about as likely as what leads, it is one that tells these apart.
    """
    found = [_asked(knowledge, names, diagnosis, name) for name in _tests(diagnosis, group)]
    asked = [test for test in found if test and not _is_past(names, diagnosis, members, test.check)]
    if _is_certain(group, members):
        asked = [test for test in asked if test.may_change_mind(names.faults(members[0].faults))]
    if _may_be_false_alarm(diagnosis, group, members):
        asked.sort(key=lambda test: not _tells_apart(knowledge, test.check, members))
    return asked[0] if asked else None


def _is_past(
    names: Names, diagnosis: Diagnosis, members: Sequence[Hypothesis], check: Check
) -> bool:
    """Tell whether a test is about causes alone that show no more, while others lead."""
    seen = _seen_by(diagnosis, check)
    led = {fault for h in members for fault in h.faults}
    return bool(seen) and seen <= names.cleared.keys() and not led <= names.cleared.keys()


def _seen_by(diagnosis: Diagnosis, check: Check) -> set[str]:
    """Return the failure modes of any hypothesis that a test sees."""
    listed = {fault for h in diagnosis.hypotheses for fault in h.faults}
    return listed & {sight.cause for sight in check.sights}


def _tells_apart(knowledge: Knowledge, check: Check, members: Sequence[Hypothesis]) -> bool:
    """Tell whether a test tells what leads from a false alarm."""
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
    return math.fsum(abs(a - b) for a, b in zip(sound, mixed, strict=True)) / 2 >= TELLS_APART


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


def _without_test(
    names: Names, diagnosis: Diagnosis, group: AmbiguityGroup, members: Sequence[Hypothesis],
    remedies: Sequence[str],
) -> tuple[str, tuple[Action, ...]]:  # fmt: skip
    """Return what to do where no test is worth doing, as one text and in order."""
    repairs = tuple(Action("repair", remedy) for remedy in remedies)
    if members and not any(hypothesis.faults for hypothesis in members):
        return capital(NO_FAULT_STEP), (Action("watch", NO_FAULT_STEP),)
    if remedies and _may_be_false_alarm(diagnosis, group, members):
        watch = _watch(names, members)
        return f"{capital(watch)}. If it does: {'; '.join(remedies)}", (
            Action("watch", watch), *repairs,
        )  # fmt: skip
    if len(members) > 1 and remedies:
        return f"{capital(NO_TEST_STEP)}. Try in this order: {'; then '.join(remedies)}", repairs
    if remedies:
        return capital("; and ".join(remedies)), repairs
    return _look_there(names, members), ()


def _watch(names: Names, members: Sequence[Hypothesis]) -> str:
    """Say what has to show again before anything is mended that may be well."""
    seen = dict.fromkeys(name for h in members for name in h.explains)
    what = either([names.symptom(name) for name in seen], 2) or "what was seen"
    return f"{FALSE_ALARM_STEP}; see whether this shows again: {what}"


def _look_there(names: Names, members: Sequence[Hypothesis]) -> str:
    unknown = not members or any(UNKNOWN in hypothesis.faults for hypothesis in members)
    if not unknown:
        return capital(f"{NO_TEST_STEP}, and it names no remedy")
    explained = dict.fromkeys(name for h in members for name in h.explains)
    parts = dict.fromkeys(names.owner(name) for name in explained)
    where = either(list(parts)) or "the robot"
    return f"Look where the symptoms are ({where}), and add to fmea.yaml what you find"


def _remedies(
    names: Names, members: Sequence[Hypothesis], safe: Sequence[MakeSafe] = ()
) -> tuple[str, ...]:
    """Return what helps, that of the most probable first, each once.

    Of what is made ``safe`` first only what mends it.
    """
    told = {fault for action in safe for fault in action.faults}
    found = dict.fromkeys(fault for h in members for fault in in_order(h.faults))
    modes = ((fault, names.fmea.modes.get(fault)) for fault in found)
    texts = ((repair(mode) if fault in told else mode.remedy) for fault, mode in modes if mode)
    return tuple(dict.fromkeys(text for text in texts if text))


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
