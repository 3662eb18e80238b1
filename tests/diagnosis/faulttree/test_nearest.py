"""Cut sets that a diagnosis brings closest to complete, against weighing every one of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.errors import AmberboxError
from amberbox.core.types import Diagnosis, Hypothesis
from amberbox.diagnosis.faulttree.analysis import analyse, nearest
from amberbox.diagnosis.faulttree.tree import FaultTree, all_of, any_of, fault_tree
from tests.diagnosis.faulttree.brute import COHERENT, trees

LASERS = fault_tree(
    "robot",
    "blind",
    {"blind": any_of("off", "both"), "both": all_of("front", "rear")},
    {"off": 0.001, "front": 0.01, "rear": 0.02},
)


def diagnosis(*hypotheses: tuple[Sequence[str], float]) -> Diagnosis:
    """Return a diagnosis of sets of faults with their probabilities."""
    made = tuple(Hypothesis(str(sorted(f)), frozenset(f), chance) for f, chance in hypotheses)
    return Diagnosis("d", 1, "robot", 0, "", made, 1.0)


def complete(tree: FaultTree, found: Diagnosis, events: frozenset[str]) -> float:
    """Add up over the hypotheses how probable it is that all events have happened."""
    rest = 1.0 - sum(h.probability for h in found.hypotheses)
    worlds = [*((h.faults, h.probability) for h in found.hypotheses), (frozenset[str](), rest)]
    return sum(
        share * math.prod(tree.events[e].probability or 0.0 for e in events - faults)
        for faults, share in worlds
    )


def test_without_a_diagnosis_the_most_probable_cut_sets_come_first() -> None:
    first, second = nearest(analyse(LASERS), None)
    assert first.probability == 0.001 and first.events == {"off": 0.001}
    assert second.probability == pytest.approx(0.0002) and second.happened == ()
    assert second.missing == ("rear", "front")


def test_a_fault_that_is_known_brings_its_cut_sets_close() -> None:
    first, *_ = nearest(analyse(LASERS), diagnosis((["front", "hook"], 0.9), (["other"], 0.1)))
    assert first.probability == pytest.approx(0.9 * 0.02 + 0.1 * 0.01 * 0.02)
    assert first.happened == ("front",) and first.missing == ("rear",)
    assert first.events["front"] == pytest.approx(0.901)


def test_one_or_the_other_is_not_both() -> None:
    """Of two hypotheses only one can be: their faults do not complete a cut set together."""
    first, *_ = nearest(analyse(LASERS), diagnosis((["front"], 0.5), (["rear"], 0.5)))
    assert first.probability == pytest.approx(0.5 * 0.02 + 0.5 * 0.01)
    assert set(first.happened) == {"front", "rear"}


def test_what_is_complete_says_so() -> None:
    first, *_ = nearest(analyse(LASERS), diagnosis((["front", "rear"], 1.0)))
    assert first.probability == 1.0 and first.missing == ()


def test_a_tree_without_probabilities_cannot_be_ranked() -> None:
    with pytest.raises(AmberboxError, match="the event b has no probability"):
        nearest(analyse(fault_tree("t", "top", {"top": all_of("a", "b")}, {"a": 0.1, "b": None})),
                None)  # fmt: skip


@settings(max_examples=100)
@given(trees(COHERENT, most_events=8), st.data())
def test_no_other_cut_set_is_more_probable(tree: FaultTree, data: st.DataObject) -> None:
    analysis = analyse(tree)
    names = st.frozensets(st.sampled_from([*tree.events, "elsewhere"]), max_size=4)
    drawn = data.draw(st.lists(names, max_size=4, unique=True))
    found = diagnosis(*((sorted(faults), 0.9 / len(drawn)) for faults in drawn))
    listed = nearest(analysis, found, 3)
    chances = sorted((complete(tree, found, c) for c in analysis.cut_sets or ()), reverse=True)
    possible = [chance for chance in chances if chance > 0.0]
    assert [near.probability for near in listed] == pytest.approx(possible[:3], rel=1e-9)
