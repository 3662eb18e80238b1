from __future__ import annotations

from dataclasses import replace

import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Hypothesis
from amberbox.core.types import Test as ToDo
from amberbox.diagnosis.tracker import OpenDiagnosis, needs_revision, new_diagnosis_id

AT_NS = 1_790_000_000 * NS + 999_999_999


def hypotheses(**shares: float) -> tuple[Hypothesis, ...]:
    return tuple(Hypothesis(name, frozenset({name}), share) for name, share in shares.items())


BEFORE = Diagnosis(
    "d", 3, "r", AT_NS, "h", hypotheses(a=0.6, b=0.3, c=0.05, d=0.015, e=0.012), 1.0,
    symptoms=("s",), next_tests=(ToDo("t", "check", "look"), ToDo("u", "check", "listen")),
)  # fmt: skip


def test_is_named_by_robot_and_second() -> None:
    assert new_diagnosis_id("ropod_001", AT_NS, "") == "ropod_001-20260921t141320"
    assert new_diagnosis_id("r", AT_NS, "r-20260921t141319a") == "r-20260921t141320"
    assert len(new_diagnosis_id("r" * 64, AT_NS, "")) <= 64


def test_a_letter_tells_those_of_one_second_apart() -> None:
    last, names = "", []
    for _ in range(3):
        last = new_diagnosis_id("r", AT_NS, last)
        names.append(last[-2:])
    assert names == ["20", "0a", "0b"]


@pytest.mark.parametrize(
    "after",
    [
        replace(BEFORE, hypotheses=hypotheses(b=0.6, a=0.3, c=0.05)),
        replace(BEFORE, hypotheses=hypotheses(a=0.6, c=0.3, b=0.05)),
        replace(BEFORE, hypotheses=hypotheses(a=0.585, b=0.31, c=0.05)),
        replace(BEFORE, hypotheses=hypotheses(a=0.6, b=0.3)),
        replace(BEFORE, hypotheses=()),
        replace(BEFORE, symptoms=("s", "t")),
        replace(BEFORE, findings=("f",)),
        replace(BEFORE, incomplete="time"),
        replace(BEFORE, next_tests=(ToDo("u", "check", "listen"),)),
        replace(BEFORE, hypotheses=(
            replace(BEFORE.hypotheses[0], explains=("s",)), *BEFORE.hypotheses[1:])),
    ],
)  # fmt: skip
def test_a_revision_is_due_when_the_answer_differs(after: Diagnosis) -> None:
    assert needs_revision(BEFORE, after) and needs_revision(after, BEFORE)


@pytest.mark.parametrize(
    "after",
    [
        replace(BEFORE, revision=4, at_ns=AT_NS + NS),
        replace(BEFORE, hypotheses=hypotheses(a=0.595, b=0.305, c=0.05, e=0.012)),
        replace(BEFORE, next_tests=BEFORE.next_tests[:1]),
    ],
)
def test_no_revision_for_what_nobody_would_notice(after: Diagnosis) -> None:
    assert not needs_revision(BEFORE, after) and not needs_revision(after, BEFORE)


def test_small_steps_add_up_to_a_revision() -> None:
    opening = OpenDiagnosis("d", BEFORE)
    steps = [hypotheses(a=0.6 - 0.004 * i, b=0.3 + 0.004 * i, c=0.05) for i in range(1, 4)]
    assert [opening.revise(replace(BEFORE, hypotheses=one)) for one in steps] == [
        False, False, True,
    ]  # fmt: skip


def test_what_goes_is_told_from_what_comes() -> None:
    opening = OpenDiagnosis("d", BEFORE)
    assert opening.take_evidence({"s": "present", "t": "absent", "u": ""}) == "more"
    assert opening.take_evidence({"s": "present", "t": ""}) == ""
    assert opening.take_evidence({"s": "present", "t": "absent"}) == "more", "it never showed"
    assert opening.take_evidence({"s": "", "t": "absent"}) == "less"
    assert opening.take_evidence({"s": "absent", "t": "absent"}, fading=True) == "less"
    assert opening.take_evidence({"s": "present", "t": "absent"}) == "more"
    assert opening.take_evidence({"s": "absent", "t": "absent"}) == "more", "nothing else fades"
