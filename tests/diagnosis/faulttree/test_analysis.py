"""Known answers, budgets, deep trees, and queries about a running robot."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from amberbox.core.contracts import Budget
from amberbox.core.errors import AmberboxError
from amberbox.diagnosis.faulttree.analysis import CutSetCloseness, analyse, closest
from amberbox.diagnosis.faulttree.open_psa import read_mef
from amberbox.diagnosis.faulttree.tree import (
    FaultTree,
    Formula,
    all_of,
    any_of,
    at_least,
    fault_tree,
    none_of,
)
from benchmarks.faulttrees import robot


def redundant(pairs: int, chance: float = 0.01) -> FaultTree:
    """Any of many pairs, and with each pair two more ways through a shared event."""
    gates: dict[str, Formula] = {
        f"pair{n}": all_of(f"a{n}", any_of(f"b{n}", f"a{n + 1}")) for n in range(pairs)
    }
    gates["top"] = any_of(*gates)
    names = [f"{letter}{n}" for n in range(pairs + 1) for letter in "ab"]
    return fault_tree("pairs", "top", gates, dict.fromkeys(names, chance))


def voting(groups: int, size: int) -> FaultTree:
    """All groups must lose: at least two of the events of each."""
    gates: dict[str, Formula] = {
        f"g{n}": at_least(2, *(f"e{n}_{k}" for k in range(size))) for n in range(groups)
    }
    gates["top"] = all_of(*gates)
    names = [f"e{n}_{k}" for n in range(groups) for k in range(size)]
    return fault_tree("voting", "top", gates, dict.fromkeys(names, 0.1))


@pytest.mark.needs_data
@pytest.mark.parametrize("name", ["chinese", "baobab1", "das9201", "isp9606", "ftr10"])
def test_trees_of_the_aralia_benchmark(shared_data: Path, name: str) -> None:
    folder = shared_data / "diagnosis" / "fault_trees"
    expected = json.loads((folder / "expected.json").read_text())[name]
    analysis = analyse(read_mef(folder / f"{name}.xml"))
    assert len(analysis.events) == expected["basic_events"]
    assert len(analysis.gates) == expected["gates"]
    assert analysis.minimal_cut_sets == expected["minimal_cut_sets"]
    assert list(analysis.by_order or ()) == expected["minimal_cut_sets_by_order"]
    assert analysis.top_probability == pytest.approx(expected["top_event_probability"], rel=1e-12)


def test_large_numbers_of_cut_sets_are_counted_without_listing_them() -> None:
    analysis = analyse(voting(30, 10))
    one = 45  # pairs of ten
    assert analysis.minimal_cut_sets == one**30 > sys.maxsize
    assert analysis.by_order == (*[0] * 60, one**30)
    group = 1 - 0.9**10 - 10 * 0.1 * 0.9**9
    assert analysis.top_probability == pytest.approx(group**30, rel=1e-12)
    first = next(iter(analysis.cut_sets or ()))
    assert len(first) == 60


def test_a_tree_that_shares_events_has_the_counts_of_its_formula() -> None:
    analysis = analyse(redundant(300))
    assert analysis.by_order == (0, 0, 600)
    assert len(list(analysis.cut_sets or ())) == 600


def test_a_tree_deeper_than_any_recursion() -> None:
    depth = 3 * sys.getrecursionlimit()
    gates: dict[str, Formula] = {"g0": all_of("e0", "e1")}
    for n in range(1, depth):
        gates[f"g{n}"] = (any_of if n % 2 else all_of)(f"g{n - 1}", f"e{n % 40}")
    tree = fault_tree("deep", f"g{depth - 1}", gates, {f"e{n}": 0.5 for n in range(40)})
    assert analyse(tree, importance=True).top_probability == pytest.approx(2 / 3)


def test_many_variables_in_one_part_need_no_recursion() -> None:
    size = 2 * sys.getrecursionlimit()
    gates: dict[str, Formula] = {"top": any_of(*(f"g{n}" for n in range(size)))}
    gates |= {f"g{n}": all_of(f"e{n}", f"e{n + 1}") for n in range(size)}
    tree = fault_tree("chain", "top", gates, {f"e{n}": 0.01 for n in range(size + 1)})
    analysis = analyse(tree, importance=True)
    assert analysis.by_order == (0, 0, size)
    assert len(closest(analysis, {"e5": True}, 3)) == 3
    assert sum(1 for _ in analysis.cut_sets or ()) == size


def test_long_chains_of_needs_find_a_good_order_of_events() -> None:
    analysis = analyse(robot(200), budget=Budget(nodes=400_000))
    assert not analysis.incomplete
    assert analysis.minimal_cut_sets == sum(1 for _ in analysis.cut_sets or ())


def test_a_budget_of_nodes_ends_with_incomplete_and_says_what() -> None:
    few = analyse(redundant(20), budget=Budget(nodes=20))
    assert few.incomplete.startswith("probability and cut sets: more than ")
    assert few.top_probability is None and few.minimal_cut_sets is None and few.by_order is None
    assert few.rare_event_sum() is None and few.upper_bound() is None
    with pytest.raises(AmberboxError, match="the cut sets are not known"):
        closest(few, {})
    assert not analyse(redundant(20), budget=Budget(nodes=2000)).incomplete


def test_a_deadline_ends_with_incomplete() -> None:
    late = analyse(redundant(20), budget=Budget(is_over=lambda: True))
    assert late.incomplete == "probability and cut sets: the time was up"


def test_a_deadline_during_the_cut_sets_leaves_the_probability() -> None:
    results = [analyse(redundant(20), budget=Budget(is_over=after(n))) for n in range(40, 120)]
    late = [entry for entry in results if entry.incomplete == "cut sets: the time was up"]
    assert late and all(entry.cut_sets is None for entry in late)
    assert {entry.top_probability for entry in late} == {analyse(redundant(20)).top_probability}


def after(count: int) -> Callable[[], bool]:
    """Return a deadline that passes after ``count`` calls."""
    asked = iter(range(count))
    return lambda: next(asked, None) is None


def test_a_tree_with_not_says_that_it_is_not_coherent() -> None:
    gates = {"top": any_of(all_of("a", none_of("b")), all_of("b", "c"))}
    analysis = analyse(fault_tree("t", "top", gates, dict.fromkeys("abc", 0.5)))
    assert not analysis.coherent
    assert set(analysis.cut_sets or ()) == {frozenset("a"), frozenset("bc")}
    assert analysis.top_probability == pytest.approx(0.5)


def test_a_double_negation_is_coherent() -> None:
    gates = {"top": none_of(none_of(all_of("a", "b")))}
    assert analyse(fault_tree("t", "top", gates, dict.fromkeys("ab", 0.5))).coherent


def test_what_is_closest_to_complete() -> None:
    gates = {"top": any_of("ab", "cde"), "ab": all_of("a", "b"), "cde": all_of("c", "d", "e")}
    tree = fault_tree("t", "top", gates, {"a": 0.1, "b": 0.2, "c": 0.5, "d": 0.5, "e": 0.5})
    assert [set(found.missing) for found in closest(tree, {})] == [set("cde"), set("ab")]
    assert closest(tree, {"b": True, "c": True}) == [
        CutSetCloseness(("c",), ("d", "e"), 0.25), CutSetCloseness(("b",), ("a",), 0.1),
    ]  # fmt: skip
    (only,) = closest(tree, {"d": False, "a": 0.9})
    assert only.missing == ("a", "b") and only.probability == pytest.approx(0.18)
    assert closest(tree, {"a": True, "b": True})[0] == CutSetCloseness(("a", "b"), (), 1.0)
    assert len(closest(tree, {}, 1)) == 1


def test_without_probabilities_the_closest_is_what_misses_the_fewest_events() -> None:
    gates = {"top": any_of(all_of("a", "b"), all_of("c", "d", "e"))}
    tree = fault_tree("t", "top", gates, {**dict.fromkeys("abcd", 0.5), "e": None})
    found = closest(tree, {"c": True, "d": True})
    assert found == [
        CutSetCloseness(("c", "d"), ("e",), None),
        CutSetCloseness((), ("a", "b"), 0.25),
    ]


def test_an_event_without_which_nothing_happens_has_no_finite_reduction() -> None:
    tree = fault_tree("t", "top", {"top": all_of("a", "b")}, {"a": 0.1, "b": 1e-9})
    found = analyse(tree, importance=True).importance
    assert found["a"].rrw == found["b"].rrw == math.inf
    assert found["a"].raw == pytest.approx(10) and found["b"].raw == pytest.approx(1e9)
