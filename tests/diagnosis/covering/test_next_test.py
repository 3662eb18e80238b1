from __future__ import annotations

import math

import pytest

from amberbox.core.errors import UsageError
from amberbox.diagnosis.covering.hypotheses import diagnose
from amberbox.diagnosis.covering.model import Link, Mode, Model, Sign
from amberbox.diagnosis.covering.next_test import (
    CANNOT,
    TestCosts,
    entropy_bits,
    next_tests,
    reading_checks,
    splitting_test,
    with_answer,
)
from amberbox.diagnosis.covering.observations import Check, CheckDetection, outcomes, predict
from tests.diagnosis.covering.known import evidence, probabilities


def even() -> Model:
    """Make two modes that explain a symptom equally well; reading ``t`` distinguishes them."""
    modes = (Mode("a#x", 0.001), Mode("b#y", 0.001))
    links = (Link("a#x", "s", 1.0), Link("b#y", "s", 1.0), Link("a#x", "t", 1.0))
    return Model(modes, (Sign("s"), Sign("t", 0.0, 30.0)), links, unknown=None)


def check(name: str, detects: float, sure: float = 1.0, cost_s: float = 0.0) -> Check:
    """Make a check that sees a#x."""
    detections = (CheckDetection("a#x", "yes", detects),)
    return Check(
        name, "check", "Look.", "technician", cost_s, 0.0, sure=sure, detections=detections
    )


SEEN = evidence(present="s")


def test_a_sure_check_between_two_equal_modes_tells_one_bit() -> None:
    hypotheses = diagnose(even(), SEEN, max_hypotheses=2).hypotheses
    assert {h.id for h in hypotheses} == {"a#x", "b#y"}
    (best, *_) = next_tests(even(), SEEN, hypotheses, [check("look", 1.0)])
    assert best.test.id == "look" and best.test.gain_bits == pytest.approx(1.0)
    assert best.test.outcomes == pytest.approx({"no": 0.5, "yes": 0.5})
    assert best.value == pytest.approx(1.0 / TestCosts().fixed_s)


def test_a_check_that_may_err_tells_what_a_noisy_channel_carries() -> None:
    hypotheses = diagnose(even(), SEEN, max_hypotheses=2).hypotheses
    noisy = check("look", 1 - 0.1 / 0.9, sure=0.9)  # sensitivity and specificity .9
    assert outcomes(even(), noisy, predict(even(), {"a#x"})) == pytest.approx((0.1, 0.9))
    proposals = next_tests(even(), SEEN, hypotheses, [noisy])
    gain = {p.test.id: p.test.gain_bits for p in proposals}["look"]
    assert gain == pytest.approx(1 - entropy_bits([0.1, 0.9]))


def test_cost_and_risk_decide_between_equal_gains_as_the_user_weighs_them() -> None:
    hypotheses = diagnose(even(), SEEN, max_hypotheses=2).hypotheses
    slow = check("slow", 1.0, cost_s=300)
    risky = Check("risky", "check", "Drive.", risk=0.4, sure=1.0, detections=slow.detections)

    def order(weights: TestCosts) -> list[str]:
        found = next_tests(even(), SEEN, hypotheses, [slow, risky], weights)
        return [proposal.test.id for proposal in found]

    assert order(TestCosts()) == ["read:t", "risky", "slow"]
    assert order(TestCosts(risk_s=6000)) == ["read:t", "slow", "risky"]


def test_only_symptoms_whose_state_is_not_known_are_read() -> None:
    assert [r.reads for r in reading_checks(even(), SEEN)] == ["t"]
    assert [r.cost_s for r in reading_checks(even(), SEEN)] == [30.0]
    assert not list(reading_checks(even(), evidence(present="s", absent="t")))
    sealed = Model(even().modes, (Sign("s"), Sign("t", 0.0, None)), even().links, unknown=None)
    assert not list(reading_checks(sealed, SEEN))


def test_an_answer_ranks_anew_as_bayes_says() -> None:
    noisy = check("look", 1 - 0.1 / 0.9, sure=0.9)
    after = with_answer(SEEN, noisy, "yes")
    found = probabilities(diagnose(even(), after, max_hypotheses=2))
    assert found["a#x"] / found["b#y"] == pytest.approx(9.0)
    read = next(iter(reading_checks(even(), SEEN)))
    ruled_out = probabilities(diagnose(even(), with_answer(SEEN, read, "absent")))
    assert list(ruled_out) == ["b#y"]


def test_cannot_check_changes_nothing_but_is_not_asked_again() -> None:
    look = check("look", 1.0)
    after = with_answer(SEEN, look, CANNOT)
    before, again = diagnose(even(), SEEN), diagnose(even(), after)
    assert probabilities(again) == probabilities(before)
    offered = next_tests(even(), after, again.hypotheses, [look])
    assert [proposal.test.id for proposal in offered] == ["read:t"]
    read = offered[0].check
    assert not next_tests(even(), with_answer(after, read, CANNOT), again.hypotheses, [look])


def test_a_done_test_is_not_offered_again() -> None:
    look = check("look", 0.5)
    after = with_answer(SEEN, look, "no")
    offered = next_tests(even(), after, diagnose(even(), after).hypotheses, [look])
    assert "look" not in [proposal.test.id for proposal in offered]


def test_an_answer_that_a_test_does_not_give_is_refused() -> None:
    with pytest.raises(UsageError, match="the test look has no outcome 'maybe'"):
        with_answer(SEEN, check("look", 1.0), "maybe")


def test_a_group_names_the_test_that_splits_it_or_none() -> None:
    answer = diagnose(even(), SEEN)
    group = answer.groups[0]
    assert set(group.members) == {"a#x", "b#y"}
    proposal = splitting_test(even(), SEEN, answer.hypotheses, group.members)
    assert proposal is not None and proposal.test.id == "read:t"
    asked = with_answer(SEEN, proposal.check, CANNOT)
    assert splitting_test(even(), asked, answer.hypotheses, group.members) is None


def test_of_three_outcomes_the_gravest_that_is_reached_is_seen() -> None:
    detections = (CheckDetection("a#x", "weak", 0.8), CheckDetection("b#y", "dead", 0.5))
    light = Check("light", "question", "Which light?", outcomes=("on", "weak", "dead"),
                  sure=0.98, detections=detections)  # fmt: skip
    both = outcomes(even(), light, predict(even(), {"a#x", "b#y"}))
    # at most on: .98 * .2 * .5; at most weak: .99 * .5
    assert both == pytest.approx((0.098, 0.495 - 0.098, 0.505))
    assert math.fsum(both) == pytest.approx(1.0)
