"""Small trees with every kind of gate, compared with looking at all states."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.diagnosis.faulttree.analysis import analyse, closest
from amberbox.diagnosis.faulttree.tree import FaultTree
from tests.diagnosis.faulttree.brute import COHERENT, minimal_states, probability, trees, truth


def chances(tree: FaultTree, events: Sequence[str], **other: float) -> list[float]:
    known = {name: event.probability or 0.0 for name, event in tree.events.items()}
    return [{**known, **other}[name] for name in events]


@settings(max_examples=80)
@given(trees())
def test_probability_and_cut_sets(tree: FaultTree) -> None:
    events = list(tree.events)
    states = truth(tree, events)
    analysis = analyse(tree)
    assert analysis.top_probability == pytest.approx(
        probability(states, chances(tree, events)), rel=1e-9, abs=1e-15
    )
    assert analysis.cut_sets is not None
    listed = list(analysis.cut_sets)
    assert set(listed) == minimal_states(states, events)
    assert len(listed) == len(set(listed)) == analysis.minimal_cut_sets
    assert [len(events) for events in listed] == sorted(len(events) for events in listed)
    assert not analysis.incomplete and analysis.truncated_at is None


@settings(max_examples=40)
@given(trees(COHERENT), st.integers(0, 4))
def test_an_order_limit_only_leaves_out_what_is_larger(tree: FaultTree, limit: int) -> None:
    analysis = analyse(tree, order_limit=limit)
    whole = analyse(tree)
    assert analysis.coherent and analysis.truncated_at == limit
    assert analysis.cut_sets is not None and whole.cut_sets is not None
    assert set(analysis.cut_sets) == {entry for entry in whole.cut_sets if len(entry) <= limit}
    assert sum(analysis.by_order or ()) == len(list(analysis.cut_sets))
    assert analysis.top_probability == whole.top_probability
    of_event = {name: event.probability or 0.0 for name, event in tree.events.items()}
    expected = sum(math.prod(of_event[e] for e in entry) for entry in analysis.cut_sets)
    assert analysis.rare_event_sum() == pytest.approx(expected, rel=1e-9, abs=1e-15)


@settings(max_examples=40)
@given(trees())
def test_importance_is_what_conditioning_gives(tree: FaultTree) -> None:
    events = list(tree.events)
    states = truth(tree, events)
    analysis = analyse(tree, importance=True)
    top = probability(states, chances(tree, events))
    assert set(analysis.importance) == set(analysis.events)
    for event, found in analysis.importance.items():
        chance = tree.events[event].probability or 0.0
        with_it = probability(states, chances(tree, events, **{event: 1.0}))
        without = probability(states, chances(tree, events, **{event: 0.0}))
        assert found.mif == pytest.approx(with_it - without, rel=1e-9, abs=1e-12)
        if not top:
            assert math.isnan(found.cif) and math.isnan(found.raw) and math.isnan(found.rrw)
            continue
        assert found.cif == pytest.approx((with_it - without) * chance / top, rel=1e-9, abs=1e-9)
        assert found.raw == pytest.approx(with_it / top, rel=1e-9, abs=1e-9)
        assert found.dif == pytest.approx(chance * with_it / top, rel=1e-9, abs=1e-9)
        assert found.rrw == pytest.approx(top / without if without else math.inf, rel=1e-6)


@settings(max_examples=40)
@given(trees(COHERENT))
def test_bounds_hold_and_are_what_their_names_say(tree: FaultTree) -> None:
    analysis = analyse(tree)
    assert analysis.cut_sets is not None and analysis.top_probability is not None
    of_event = {name: event.probability or 0.0 for name, event in tree.events.items()}
    each = [math.prod(of_event[e] for e in entry) for entry in analysis.cut_sets]
    assert analysis.rare_event_sum() == pytest.approx(sum(each))
    bound = analysis.upper_bound()
    if bound is not None:
        assert bound == pytest.approx(1 - math.prod(1 - q for q in each), abs=1e-12)
        assert analysis.top_probability <= bound + 1e-12 <= sum(each) + 1e-9


@settings(max_examples=40)
@given(trees(), st.data())
def test_the_closest_cut_sets_are_the_most_probable_ones(
    tree: FaultTree, data: st.DataObject
) -> None:
    known = st.sampled_from((True, False, None, 0.25))
    state = {event: data.draw(known) for event in tree.events}
    analysis = analyse(tree)
    assert analysis.cut_sets is not None
    chance = {
        event: value if value is not None else tree.events[event].probability
        for event, value in state.items()
    }
    expected = sorted(
        (math.prod(chance[e] or 0.0 for e in entry) for entry in analysis.cut_sets), reverse=True
    )
    possible = [value for value in expected if value > 0][:3]
    found = closest(analysis, state, 3)
    assert [entry.probability for entry in found] == pytest.approx(possible)
    assert all({*e.happened, *e.missing} in set(analysis.cut_sets) for e in found)
    assert all(chance[event] == 1 for e in found for event in e.happened)
