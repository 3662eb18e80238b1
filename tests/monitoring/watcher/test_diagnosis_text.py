"""The leading answer in a line."""

from __future__ import annotations

import pytest

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.core.types import Test as NextTest
from amberbox.monitoring.alarm_causes import LeadingAnswer, diagnosis_text, hypotheses_text


def hypothesis(*faults: str, probability: float = 0.5) -> Hypothesis:
    return Hypothesis(" + ".join(faults) or "no fault", frozenset(faults), probability)


def diagnosis(*groups: tuple[float, list[Hypothesis]], **more: object) -> Diagnosis:
    """Make a diagnosis of groups, with the hypotheses in their order."""
    made = tuple(AmbiguityGroup(tuple(h.id for h in hs), p) for p, hs in groups)
    hypotheses = tuple(h for _, hs in groups for h in hs)
    return Diagnosis("d", 1, "r", 0, "h", hypotheses, 1.0, groups=made, **more)  # type: ignore[arg-type]  # its last fields


ONE, TWO = hypothesis("laser#dead"), hypothesis("laser#dirty")
LOOK = NextTest("look", "question", "Is it dirty?")


def cause(found: Diagnosis) -> str:
    """Return the cause of an alarm of the laser."""
    blame = LeadingAnswer.of(found, {}, {})
    return blame.text(blame.share("laser"))


def test_the_first_group_leads() -> None:
    assert diagnosis((0.6, [ONE, TWO]), (0.3, [hypothesis("host#off")])).leading() == (ONE, TWO)
    assert diagnosis().leading() == ()
    ungrouped = Diagnosis("d", 1, "r", 0, "h", (ONE, TWO), 1.0)
    assert ungrouped.leading() == (ONE,)
    assert cause(ungrouped) == "laser#dead (likely)"


@pytest.mark.parametrize(
    ("probability", "word"),
    [(0.96, "almost certain"), (0.8, "very likely"), (0.5, "likely"), (0.3, "possible"),
     (0.1, "only a guess")],
)  # fmt: skip
def test_a_cause_says_how_sure_it_is(probability: float, word: str) -> None:
    assert cause(diagnosis((probability, [ONE]))) == f"laser#dead ({word})"
    assert cause(diagnosis()) == ""


def test_names_are_few_and_plain() -> None:
    many = [hypothesis(f"laser#{name}") for name in "abcde"]
    assert hypotheses_text(many) == "laser#a or laser#b or laser#c or one of 2 more"
    assert hypotheses_text([hypothesis("b#y", "a#x")]) == "a#x + b#y"
    assert hypotheses_text([hypothesis("unknown#other")]) == "not in the FMEA"
    assert hypotheses_text([hypothesis()]) == "a false alarm"


def test_what_else_and_what_next_are_said() -> None:
    said = diagnosis(
        (0.624, [ONE, TWO]), (0.3, [hypothesis("host#off")]), (0.04, [hypothesis("hook#bent")]),
        next_tests=(LOOK,),
    )  # fmt: skip
    expected = "laser#dead or laser#dirty (62 %), or host#off (30 %); next: Is it dirty?"
    assert diagnosis_text(said) == expected
    assert diagnosis_text(diagnosis((0.999, [ONE]))) == "laser#dead (over 99 %)"
    assert diagnosis_text(diagnosis((0.6, [ONE]), state="healed")) == "healed"
    assert diagnosis_text(diagnosis()) == "no answer"
