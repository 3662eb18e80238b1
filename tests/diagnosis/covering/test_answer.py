from __future__ import annotations

import random
from itertools import pairwise

import pytest

from amberbox.core.contracts import Budget
from amberbox.core.needs import all_of, any_of
from amberbox.diagnosis.covering.hypotheses import NO_FAULT, RankedHypotheses, diagnose
from amberbox.diagnosis.covering.model import (
    UNKNOWN,
    Function,
    Link,
    Mode,
    Model,
    Sign,
    Unknown,
)
from amberbox.diagnosis.covering.observations import Evidence, Observation
from benchmarks.covering import random_case, random_robot
from tests.diagnosis.covering.known import evidence, probabilities, two_causes


def test_probabilities_are_those_computed_by_hand() -> None:
    answer = diagnose(two_causes(), evidence(present="s"), max_hypotheses=10, mass=1.0)
    # priors .01, .02; detects .9, .5; leak .1
    joint = {
        NO_FAULT: 0.99 * 0.98 * 0.1,
        "a#x": 0.01 * 0.98 * 0.91,
        "b#y": 0.99 * 0.02 * 0.55,
        "a#x + b#y": 0.01 * 0.02 * 0.955,
    }
    total = sum(joint.values())
    assert probabilities(answer) == pytest.approx({n: p / total for n, p in joint.items()})
    assert [h.id for h in answer.hypotheses] == [NO_FAULT, "b#y", "a#x", "a#x + b#y"]


def test_a_cause_of_all_beats_two_causes_of_one_each_by_their_priors() -> None:
    """Peng and Reggia's covers: {wide} and {left, right}; adding a fault to a cover costs
    probability.
    """
    modes = (Mode("w#wide", 0.01), Mode("l#left", 0.05), Mode("r#right", 0.05))
    links = (Link("w#wide", "m1", 1), Link("w#wide", "m2", 1),
             Link("l#left", "m1", 1), Link("r#right", "m2", 1))  # fmt: skip
    model = Model(modes, (Sign("m1"), Sign("m2")), links, unknown=None)
    answer = diagnose(model, evidence(present="m1 m2"), max_hypotheses=10, mass=1.0)
    odds = {"w": 0.01 / 0.99, "lr": (0.05 / 0.95) ** 2, "one": 0.05 / 0.95}
    covers = [odds["w"], odds["lr"], odds["w"] * odds["one"], odds["w"] * odds["lr"]]
    total = covers[0] + covers[1] + 2 * covers[2] + covers[3]
    assert [h.id for h in answer.hypotheses[:2]] == ["w#wide", "l#left + r#right"]
    found = probabilities(answer)
    assert found["w#wide"] == pytest.approx(covers[0] / total)
    assert found["l#left + r#right"] == pytest.approx(covers[1] / total)
    assert found["l#left + w#wide"] == pytest.approx(covers[2] / total)
    assert len(found) == 5


def test_a_weak_observation_moves_half_as_far_to_a_coin() -> None:
    weak = Evidence({"s": Observation("present", 0.5)})
    found = probabilities(diagnose(two_causes(), weak, max_hypotheses=10, mass=1.0))
    ratio = (0.5 * 0.91 + 0.25) * 0.01 / 0.99 / (0.5 * 0.1 + 0.25)
    assert found["a#x"] / found[NO_FAULT] == pytest.approx(ratio)


def test_a_conflict_leaves_only_sets_with_one_of_its_modes() -> None:
    conflict = Evidence(conflicts=(frozenset({"a#x", "b#y"}),))
    answer = diagnose(two_causes(), conflict, max_hypotheses=10, mass=1.0)
    assert probabilities(answer) == pytest.approx(
        {"b#y": 0.0198 / 0.0298, "a#x": 0.0098 / 0.0298, "a#x + b#y": 0.0002 / 0.0298}
    )


def test_conflicts_that_nothing_meets_give_no_hypothesis() -> None:
    answer = diagnose(two_causes(), Evidence(conflicts=(frozenset(),)))
    assert answer.hypotheses == () and answer.mass_covered == 0.0


def redundant(unknown: Unknown | None = None) -> Model:
    """Make two lasers of which one is enough to see, and a drive that needs seeing."""
    modes = (Mode("front#dark", 0.01, takes_down=True), Mode("rear#dark", 0.02, takes_down=True))
    functions = (Function("see", any_of("front", "rear")), Function("drive", all_of("see")))
    links = (Link("front#dark", "front_scan", 0.99), Link("rear#dark", "rear_scan", 0.99),
             Link("drive", "stuck", 0.9))  # fmt: skip
    signs = (Sign("front_scan", 0.001), Sign("rear_scan", 0.001), Sign("stuck", 0.001))
    return Model(modes, signs, links, functions, unknown)


def test_a_function_is_lost_only_when_no_alternative_is_left() -> None:
    answer = diagnose(redundant(), evidence(present="stuck"), max_hypotheses=10, mass=1.0)
    both, none = 0.01 * 0.02 * (1 - 0.999 * 0.1), 0.99 * 0.98 * 0.001
    front, rear = 0.01 * 0.98 * 0.001, 0.99 * 0.02 * 0.001
    total = both + none + front + rear
    found = probabilities(answer)
    assert found["front#dark + rear#dark"] == pytest.approx(both / total)
    assert found["front#dark"] == pytest.approx(front / total)


def test_what_a_hypothesis_explains_and_what_speaks_against_it() -> None:
    seen = evidence(present="front_scan stuck", absent="rear_scan")
    answer = diagnose(redundant(), seen, max_hypotheses=10, mass=1.0)
    by_id = {h.id: h for h in answer.hypotheses}
    assert by_id["front#dark"].explains == ("front_scan",)
    assert by_id["front#dark"].unexplained == ("stuck",)
    assert by_id["front#dark"].contradicted == ()
    both = by_id["front#dark + rear#dark"]
    assert both.explains == ("front_scan", "stuck") and both.contradicted == ("rear_scan",)


def test_what_nothing_in_the_model_explains_is_something_else() -> None:
    modes = (Mode("a#x", 0.001), Mode("b#y", 0.001))
    signs = tuple(Sign(f"s{n}", 0.001) for n in range(4))
    links = (Link("a#x", "s0", 0.99), Link("a#x", "s1", 0.99), Link("b#y", "s2", 0.99))
    model = Model(modes, signs, links, unknown=Unknown(0.0001, 0.5))
    answer = diagnose(model, evidence(present="s0 s3", absent="s1 s2"))
    assert answer.hypotheses[0].faults == {UNKNOWN}
    assert answer.hypotheses[0].explains == ("s0", "s3")
    known = diagnose(model, evidence(present="s0 s1", absent="s2 s3"))
    assert known.hypotheses[0].faults == {"a#x"}


def alike() -> Model:
    """Make two modes that only the symptom ``apart`` distinguishes."""
    modes = (Mode("a#x", 0.01, criticality=2.0), Mode("b#y", 0.02), Mode("c#z", 0.01))
    links = (Link("a#x", "s", 0.99), Link("b#y", "s", 0.95), Link("c#z", "t", 0.99),
             Link("a#x", "apart", 0.99))  # fmt: skip
    signs = (Sign("s", 0.001), Sign("t", 0.001), Sign("apart", 0.001))
    return Model(modes, signs, links, unknown=None)


def test_what_nothing_known_tells_apart_is_one_group() -> None:
    answer = diagnose(alike(), evidence(present="s", absent="t"), max_hypotheses=50, mass=1.0)
    first = answer.groups[0]
    assert first.members == ("b#y", "a#x") and "a#x + b#y" in first.wider
    found = {h.id: h for h in answer.hypotheses}
    assert found["a#x"].ambiguity == ("b#y",) and found["b#y"].ambiguity == ("a#x",)
    assert found["a#x"].criticality == 2.0
    everyone = (found[name].probability for name in (*first.members, *first.wider))
    assert first.probability == pytest.approx(sum(everyone))
    assert sum(group.probability for group in answer.groups) == pytest.approx(1.0)


def test_many_improbable_causes_do_not_come_before_a_probable_one() -> None:
    few, many = "a#x", [f"b{number}#y" for number in range(12)]
    modes = (Mode(few, 0.02), *(Mode(name, 0.008) for name in many))
    links = (
        Link(few, "s", 0.9),
        *(Link(name, shown, 0.3) for name in many for shown in ("s", "more")),
    )
    model = Model(modes, (Sign("s", 1e-9), Sign("more")), links, unknown=None)
    answer = diagnose(model, evidence("s", "more"), max_hypotheses=40, mass=1.0)
    assert answer.hypotheses[0].id == few
    assert answer.groups[0].members == (few,)
    assert answer.groups[1].probability > answer.groups[0].probability


def test_a_symptom_that_tells_them_apart_splits_the_group() -> None:
    answer = diagnose(alike(), evidence(present="s", absent="t apart"), mass=0.9999)
    assert answer.groups[0].members == ("b#y",)


def test_symptoms_that_the_model_does_not_know_are_findings() -> None:
    answer = diagnose(two_causes(), evidence(present="s strange"))
    assert answer.findings == ("strange",)


def test_modes_without_a_trace_in_the_evidence_are_summed_out() -> None:
    model = Model((*two_causes().modes, Mode("far#away", 0.4)), (*two_causes().signs, Sign("t")),
                  (*two_causes().links, Link("far#away", "t", 0.5)), unknown=None)  # fmt: skip
    seen = evidence(present="s", absent="t")
    assert probabilities(diagnose(model, seen, max_hypotheses=99, mass=1.0)) == pytest.approx(
        probabilities(diagnose(two_causes(), evidence(present="s"), max_hypotheses=99, mass=1.0))
    )


def test_a_budget_of_nodes_ends_with_incomplete() -> None:
    model, seen = _robot()
    answer = diagnose(model, seen, max_hypotheses=10**6, mass=1.0, budget=Budget(nodes=50))
    assert answer.incomplete == "more than 50 nodes" and answer.opened == 50
    assert 0 < answer.mass_covered < 1


def test_the_best_that_was_reached_is_listed_when_a_budget_ends_the_search() -> None:
    model, seen = _robot()
    cut = diagnose(model, seen, budget=Budget(nodes=2))
    assert cut.incomplete and len(cut.hypotheses) == 3
    shares = [hypothesis.probability for hypothesis in cut.hypotheses]
    assert shares == sorted(shares, reverse=True) and sum(shares) == pytest.approx(1.0)


def test_a_deadline_ends_with_incomplete() -> None:
    model, seen = _robot()
    asked = iter([False, False, True])
    answer = diagnose(model, seen, budget=Budget(is_over=lambda: next(asked)))
    assert answer.incomplete == "the time was up" and answer.opened <= 2


def test_what_is_listed_first_does_not_depend_on_how_much_is_listed() -> None:
    model, seen = _robot()
    few, many = (diagnose(model, seen, max_hypotheses=n, mass=1.0) for n in (3, 30))
    assert [h.id for h in few.hypotheses] == [h.id for h in many.hypotheses[:3]]
    shares = [h.probability for h in many.hypotheses]
    assert all(a >= b * (1 - 1e-9) for a, b in pairwise(shares))


def test_a_large_robot_is_answered_with_few_nodes() -> None:
    model = random_robot(1000, 5000, 1500)
    rng = random.Random(3)
    for count in (1, 2, 3):
        answer = diagnose(model, random_case(model, rng, count).evidence, budget=Budget(5000))
        assert answer.hypotheses and not answer.incomplete


def _robot() -> tuple[Model, Evidence]:
    model = random_robot(60, 150, 90)
    return model, random_case(model, random.Random(5), 3).evidence


def test_no_evidence_leaves_nothing_to_say() -> None:
    answer: RankedHypotheses = diagnose(two_causes(), Evidence())
    assert [h.id for h in answer.hypotheses] == [NO_FAULT]
    assert answer.hypotheses[0].probability == 1.0 and answer.mass_covered == 1.0
