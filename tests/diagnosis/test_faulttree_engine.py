"""Diagnosis by fault trees: minimal explanations, ranked by the evidence."""

from __future__ import annotations

import itertools

import pytest

from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.core.types import Diagnosis, Symptom, SymptomState
from amberbox.diagnosis.covering.observations import predict
from amberbox.diagnosis.diagnose import DiagnosisId, Effort, ObservedSituation, answer
from amberbox.diagnosis.evidence import faulttree
from amberbox.diagnosis.evidence.faulttree import conclude
from amberbox.diagnosis.knowledge import Knowledge
from tests.diagnosis.fmea.small import small

HEADING = DiagnosisId("small-1", 3, 77)
FRONT, REAR = "laser_front/heartbeat/alive", "laser_rear/heartbeat/alive"
GIVEN_UP, HOST = "tasks/log/none_given_up", "host/heartbeat/alive"


def seen(*present: str, absent: tuple[str, ...] = ()) -> ObservedSituation:
    """Return a situation with symptoms that are there and that are not."""
    states: list[tuple[str, SymptomState]] = [(name, "present") for name in present]
    states += [(name, "absent") for name in absent]
    return ObservedSituation(tuple(Symptom(name, state) for name, state in states))


def of(situation: ObservedSituation, effort: Effort | None = None) -> Diagnosis:
    """Diagnose the small analysis."""
    return conclude(Knowledge("small", small(), "hash"), situation, HEADING, effort)


def test_a_loss_is_explained_by_the_cut_sets_of_the_function() -> None:
    found = of(seen(GIVEN_UP))
    assert [h.faults for h in found.hypotheses] == [
        {"hook#bent"}, {"host#off"}, {"laser_front#dead", "laser_rear#dead"},
    ]  # fmt: skip
    assert sum(h.probability for h in found.hypotheses) == pytest.approx(1.0)
    assert found.mass_covered == pytest.approx(1.0) and found.incomplete == ""
    assert found.hypotheses[0].probability > 0.9
    assert (found.id, found.revision, found.at_ns, found.robot) == ("small-1", 3, 77, "small")
    assert found.symptoms == (GIVEN_UP,) and found.config_hash == "hash"


def test_the_proof_is_the_way_through_the_tree() -> None:
    found = of(seen(GIVEN_UP, FRONT, REAR))
    both = next(h for h in found.hypotheses if h.faults == {"laser_front#dead", "laser_rear#dead"})
    assert both.proof.splitlines() == [
        f"{FRONT}: laser_front#dead",
        f"{REAR}: laser_rear#dead",
        f"{GIVEN_UP}: carry lost because see lost because laser_front#dead and laser_rear#dead",
    ]


def test_all_that_is_seen_is_explained_together() -> None:
    found = of(seen(GIVEN_UP, FRONT, HOST))
    assert found.hypotheses[0].faults == {"host#off", "laser_front#dead"}
    assert found.hypotheses[0].unexplained == ()
    assert found.hypotheses[0].explains == (HOST, FRONT, GIVEN_UP)


def test_absent_symptoms_and_answers_count_in_the_ranking() -> None:
    found = of(seen(GIVEN_UP, absent=(FRONT, REAR, HOST)))
    lasers = next(h for h in found.hypotheses if "laser_rear#dead" in h.faults)
    assert lasers.contradicted == (FRONT, REAR) and lasers.probability < 1e-6
    window = "laser_front/window/clear"
    assert [h.faults for h in of(seen(window)).hypotheses] == [
        {"laser_front#wet"},
        {"laser_front#dirty"},
    ]
    told = ObservedSituation(seen(window).symptoms, {"laser_front.look": "dirty"})
    assert of(told).hypotheses[0].faults == {"laser_front#dirty"}


def test_what_looks_alike_is_a_group_with_a_test_that_splits_it() -> None:
    found = of(seen("laser_front/window/clear"))
    (group,) = found.groups
    assert set(group.members) == {"laser_front#wet", "laser_front#dirty"}
    assert group.split_by == "laser_front.look" == found.next_tests[0].id


def test_one_of_a_conflict_is_there() -> None:
    conflict = frozenset({"laser_front#dead", "hook#bent"})
    found = of(
        ObservedSituation(seen(FRONT).symptoms, {}, (conflict, frozenset({"unknown#other"})))
    )
    assert [h.faults for h in found.hypotheses] == [{"laser_front#dead"}]
    with pytest.raises(UsageError, match="laser_frnt#dead"):
        of(ObservedSituation(conflicts=(frozenset({"laser_frnt#dead"}),)))


def test_of_what_the_analysis_does_not_know_it_concludes_nothing() -> None:
    found = of(seen("nobody/is/this"))
    assert found.hypotheses == () and found.groups == ()
    assert found.findings == ("nobody/is/this",)


def test_a_component_with_a_symptom_that_nobody_linked_counts_as_lost() -> None:
    found = of(seen("laser_front/scan/rate", "nobody/is/this"))
    assert {h.id for h in found.hypotheses} == {"laser_front#dead", "host#off"}
    assert found.findings == ("laser_front/scan/rate", "nobody/is/this")
    assert found.hypotheses[0].proof == "laser_front/scan/rate: laser_front#dead"


def test_what_other_engines_found_is_handed_on() -> None:
    told = ObservedSituation(seen(FRONT, "nobody/is/this").symptoms, findings=("it smells",))
    assert of(told).findings == ("nobody/is/this", "it smells")


def test_nothing_seen_is_no_fault() -> None:
    found = of(seen(absent=(FRONT,)))
    assert [(h.id, h.probability) for h in found.hypotheses] == [("no fault", 1.0)]


def test_what_is_cut_off_is_said() -> None:
    found = of(seen(GIVEN_UP), Effort(hypotheses=1))
    assert len(found.hypotheses) == 1
    assert found.incomplete == "the 1 most probable of 3 minimal cut sets"
    assert found.hypotheses[0].faults == {"hook#bent"}
    assert 0.9 < found.mass_covered < 0.99


def test_time_that_runs_out_is_said() -> None:
    found = of(seen(GIVEN_UP), Effort(budget=Budget(is_over=lambda: True)))
    assert found.hypotheses == () and found.mass_covered == 0.0
    assert "the time was up" in found.incomplete


def test_a_symptom_that_is_hardly_believed_needs_no_cause() -> None:
    weak = ObservedSituation((Symptom(FRONT, "present"), Symptom(REAR, "present", strength=0.1)))
    first, *_ = of(weak).hypotheses
    assert first.faults == {"laser_front#dead"} and first.unexplained == (REAR,)


@pytest.mark.parametrize(
    "faults", [["laser_front#dead"], ["host#off"], ["laser_rear#wet", "hook#bent"]]
)
@pytest.mark.parametrize("strength", [1.0, 0.8])
def test_ratios_are_those_of_covering_where_it_has_the_same_sets(
    faults: list[str], strength: float
) -> None:
    """But for the chance that a failure mode is not there, which small priors make close to 1."""
    knowledge = Knowledge("small", small())
    expected = predict(knowledge.model, faults)
    situation = ObservedSituation(tuple(
        Symptom(sign.id, "present" if expected.present(knowledge.model, place) > 0.3 else "absent",
                strength=strength)
        for place, sign in enumerate(knowledge.model.signs)
    ))  # fmt: skip
    mine = {h.id: h for h in conclude(knowledge, situation, HEADING).hypotheses}
    other = {h.id: h for h in answer(knowledge, situation, HEADING).hypotheses}
    shared = [name for name in mine if name in other]
    assert " + ".join(sorted(faults)) == next(iter(mine)) == shared[0]
    for one, two in itertools.pairwise(shared):
        odds = other[one].probability / other[two].probability
        assert mine[one].probability / mine[two].probability == pytest.approx(odds, rel=0.1)


def test_of_a_tree_too_large_to_be_solved_the_most_probable_sets_are_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    exact = of(seen(GIVEN_UP))
    monkeypatch.setattr(faulttree, "_NODES", 8)
    found = of(seen(GIVEN_UP))
    assert found.incomplete.startswith("probability and cut sets: more than")
    assert [h.faults for h in found.hypotheses] == [h.faults for h in exact.hypotheses]
    for mine, other in zip(found.hypotheses, exact.hypotheses, strict=True):
        assert mine.probability == pytest.approx(other.probability)
    assert 0.0 < found.mass_covered <= 1.0
