"""Trees that are too large for the budget: bounds and most probable cut sets."""

from __future__ import annotations

import math
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.contracts import Budget
from amberbox.diagnosis.faulttree.analysis import analyse, most_probable
from amberbox.diagnosis.faulttree.bounded import BoundedSearch, quick_bounds
from amberbox.diagnosis.faulttree.bounds import (
    ProbabilityBounds,
    bounds_of_part,
    least_given,
    rough_bounds,
)
from amberbox.diagnosis.faulttree.decision_diagrams import (
    Diagram,
    gate_of_diagrams,
    operations_of_gate,
)
from amberbox.diagnosis.faulttree.graph import (
    FaultGraph,
    FaultGraphVertex,
    FaultTreeModule,
    build_fault_graph,
    split_modules,
    variable_orders,
)
from amberbox.diagnosis.faulttree.probable import (
    ProbableCutSets,
    probable_cut_sets,
    union_bounds,
)
from amberbox.diagnosis.faulttree.tree import FaultTree, Name, all_of, any_of, fault_tree
from benchmarks.fault_tree_plants import LayerShape, PlantShape, layers, plant
from tests.diagnosis.faulttree.brute import COHERENT, minimal_states, probability, trees, truth

ROUNDING = 1e-12


def graph_of(tree: FaultTree) -> tuple[FaultGraph, int]:
    formulas = {name: gate.formula for name, gate in tree.gates.items()}
    return build_fault_graph(formulas, tree.houses, Name(tree.top))


def chances(tree: FaultTree) -> dict[str, float]:
    return {name: event.probability or 0.0 for name, event in tree.events.items()}


def bounds(tree: FaultTree, size: int) -> ProbabilityBounds:
    """Return bounds with so few nodes by gate."""
    graph, top = graph_of(tree)
    found: dict[int, ProbabilityBounds] = {}
    of_event = chances(tree)
    for part in split_modules(graph, top):
        of_leaf = {leaf: found.get(leaf) or _known(graph, leaf, of_event) for leaf in part.leaves}
        order = variable_orders(graph, part)[0]
        found[part.vertex] = bounds_of_part(graph, part, order, of_leaf, size, Budget())
    return found[top]


def _known(graph: FaultGraph, leaf: int, of_event: dict[str, float]) -> ProbabilityBounds:
    return ProbabilityBounds(*[of_event[graph.vertices[leaf].event]] * 2)


def probable(tree: FaultTree, size: int, cutoff: float = 0.0) -> ProbableCutSets:
    return probable_cut_sets(*graph_of(tree), chances(tree), size, cutoff, Budget())


@settings(max_examples=40)
@given(trees(), st.sampled_from((1, 2, 3, 5, 8, 1000)))
def test_the_probability_is_within_its_bounds(tree: FaultTree, size: int) -> None:
    events = list(tree.events)
    exact = probability(truth(tree, events), list(chances(tree).values()))
    graph, top = graph_of(tree)  # dividing it may add vertices
    rough = rough_bounds(graph, split_modules(graph, top), chances(tree))
    assert exact <= rough.upper + ROUNDING
    found = bounds(tree, size)
    assert found.lower - ROUNDING <= exact <= found.upper + ROUNDING
    if size == 1000:
        assert found.lower == pytest.approx(found.upper, rel=1e-9, abs=1e-15)


@settings(max_examples=80)
@given(trees(), st.sampled_from((1, 2, 4, 64)), st.sampled_from((0.0, 0.001, 0.1)))
def test_probable_sets_are_minimal_and_none_above_the_floor_is_missing(
    tree: FaultTree, size: int, cutoff: float
) -> None:
    events = list(tree.events)
    every = minimal_states(truth(tree, events), events)
    of_event = chances(tree)
    found = probable(tree, size, cutoff)
    assert set(found.sets) <= every and len(set(found.sets)) == len(found.sets)
    assert list(found.probabilities) == sorted(found.probabilities, reverse=True)
    for entry in every:
        chance = math.prod(of_event[event] for event in entry)
        assert entry in found.sets or chance <= found.floor + ROUNDING


@settings(max_examples=50)
@given(trees(), st.sampled_from((1, 3, 64)))
def test_the_union_of_the_sets_is_within_its_bounds(tree: FaultTree, size: int) -> None:
    events = list(tree.events)
    states = truth(tree, events)
    of_event = chances(tree)
    found = probable(tree, size)
    by_sets = states & False
    for entry in found.sets:
        bits = sum(1 << events.index(event) for event in entry)
        by_sets |= [state & bits == bits for state in range(len(states))]
    lower, upper = union_bounds(found, of_event)
    weights = list(of_event.values())
    if found.sets:
        gates = {"top": any_of(*(all_of(*sorted(entry), "on") for entry in found.sets))}
        graph, top = graph_of(fault_tree("sets", "top", gates, of_event, {"on": True}))
        joined = quick_bounds(graph, split_modules(graph, top), of_event)
        exact = probability(by_sets, weights)
        assert joined.lower - ROUNDING <= exact <= joined.upper + ROUNDING
    assert lower <= probability(by_sets & states, weights) + ROUNDING
    graph, top = graph_of(tree)
    given = least_given(graph, split_modules(graph, top), of_event, found.sets)
    for least, entry in zip(given, found.sets, strict=True):
        certain = [1.0 if event in entry else of_event[event] for event in events]
        assert least <= probability(states, certain) + ROUNDING
    lower = union_bounds(found, of_event, given)[0]
    assert lower <= probability(by_sets & states, weights) + ROUNDING
    assert probability(by_sets, weights) <= upper + ROUNDING


@settings(max_examples=40)
@given(trees(COHERENT), st.integers(0, 40))
def test_whatever_the_budget_the_answer_holds(tree: FaultTree, nodes: int) -> None:
    events = list(tree.events)
    states = truth(tree, events)
    exact = probability(states, list(chances(tree).values()))
    found = analyse(tree, budget=Budget(nodes))
    assert found.top_probability is None or found.top_probability == pytest.approx(exact)
    assert found.bounds is None or found.bounds.lower - ROUNDING <= exact
    assert found.bounds is None or exact <= found.bounds.upper + ROUNDING
    best = most_probable(found, 5)
    assert best is not None and set(best.sets) <= minimal_states(states, events)
    if best.share is not None:
        of_event = chances(tree)
        total = math.fsum(math.prod(of_event[event] for event in entry) for entry in best.sets)
        assert best.share[0] * exact <= total + 1e-9
    every = minimal_states(states, events)
    ranks = sorted((math.prod(chances(tree)[e] for e in s) for s in every), reverse=True)
    assert [*(best.probabilities or ())[: best.certain]] == pytest.approx(ranks[: best.certain])


def test_a_plant_that_is_too_large_has_close_bounds_and_its_best_sets() -> None:
    tree = plant(PlantShape(12, 3, 2, 2, 8), 3)
    exact = analyse(tree)
    assert not exact.incomplete and exact.top_probability is not None
    few = analyse(tree, budget=Budget(nodes=8_000))
    assert few.incomplete.startswith("probability and cut sets: more than ")
    assert few.bounds is not None and few.bounds.width < 0.1
    assert few.bounds.lower <= exact.top_probability <= few.bounds.upper
    best, same = most_probable(few, 20), most_probable(exact, 20)
    assert best is not None and same is not None and best.share is not None
    assert best.certain == 20 and best.probabilities == pytest.approx(same.probabilities)
    assert same.share is not None and best.share[0] <= same.share[1]
    assert best.share[0] > 0.5


@pytest.mark.parametrize("odd", [0.0, 0.04])
def test_probable_events_and_not_have_close_bounds_too(odd: float) -> None:
    tree = layers(LayerShape(6, 20, 110, odd=odd), 1)
    exact, few = analyse(tree), analyse(tree, budget=Budget(nodes=3_000))
    assert exact.top_probability is not None and few.incomplete and few.bounds is not None
    assert few.bounds.lower <= exact.top_probability <= few.bounds.upper
    assert few.bounds.width < 0.2
    best, same = most_probable(few, 20), most_probable(exact, 20)
    assert best is not None and best.share is not None and best.certain == 20
    assert same is not None and same.share is not None and same.sets == best.sets
    assert best.share[0] <= same.share[0] <= same.share[1] <= best.share[1] + ROUNDING
    assert best.share[1] - best.share[0] < 0.2


def test_more_time_never_makes_the_bounds_worse() -> None:
    tree = plant(PlantShape(10, 2, 2, 2, 6), 5)
    graph, top = graph_of(tree)
    parts: list[FaultTreeModule] = split_modules(graph, top)
    widths = []
    for rounds in (40, 400, 4_000):
        asked = count()
        budget = Budget(is_over=lambda asked=asked, most=rounds: next(asked) > most)  # type: ignore[misc]  # bound
        search = BoundedSearch(graph, parts, {}, chances(tree), budget)
        search.run(with_bounds=True)
        widths.append(1.0 if search.bounds is None else search.bounds.width)
    assert widths == sorted(widths, reverse=True) and widths[-1] < 0.01


def test_rounds_fit_into_the_time_and_searches_share_it() -> None:
    tree = plant(PlantShape(12, 3, 2, 2, 8), 3)
    graph, top = graph_of(tree)
    clock = count()
    asked: list[float] = []

    def is_past(share: float) -> bool:
        asked.append(next(clock) / 1_500)
        return asked[-1] >= share

    budget = Budget(is_over=lambda: is_past(1.0), is_past=is_past)
    second = budget.turn(1)
    search = BoundedSearch(graph, split_modules(graph, top), {}, chances(tree), second)
    search.run(with_bounds=True)
    assert search.bounds is not None and search.bounds.width < 0.1 and 0.2 < asked[-1] < 0.8
    assert second.is_over() and not budget.is_over()
    assert budget.turn(0) is budget and not budget.turn(1).is_over()


def test_without_probabilities_the_smallest_sets_come_first() -> None:
    tree = plant(PlantShape(8, 3, 2, 2, 6), 2)
    events = {name: type(event)(name) for name, event in tree.events.items()}
    bare = type(tree)(tree.name, tree.top, tree.gates, events, tree.houses)
    found = most_probable(analyse(bare, budget=Budget(nodes=100)), 30)
    assert found is not None and found.probabilities is None and found.share is None
    sizes = [len(entry) for entry in found.sets]
    assert sizes and sizes == sorted(sizes)


@pytest.mark.parametrize("size", [2, 3, 5, 8])
def test_every_gate_takes_as_many_operations_as_foreseen(size: int) -> None:
    kinds = [("and", 0), ("or", 0), *(("atleast", needed) for needed in range(2, size))]
    for kind, needed in [*kinds, ("xor", 0), ("not", 0)]:
        inputs = {"xor": 2, "not": 1}.get(kind, size)
        diagram = Diagram(Budget())
        leaves = [diagram.stored(level, 1, 0) for level in range(inputs)]
        gate_of_diagrams(diagram, kind, leaves, needed)
        vertex = FaultGraphVertex(kind, tuple(range(inputs)), needed)
        assert diagram.steps == operations_of_gate(vertex), (kind, needed)
