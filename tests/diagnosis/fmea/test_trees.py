"""Fault trees that are compiled from failure modes, against every state of small robots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.errors import UsageError
from amberbox.core.needs import NOTHING, Needs, all_of, any_of, at_least
from amberbox.diagnosis.faulttree.analysis import analyse
from amberbox.diagnosis.faulttree.open_psa import read_mef, write_mef
from amberbox.diagnosis.faulttree.tree import BooleanConstant, FaultTree, Gate, Name
from amberbox.diagnosis.faulttree.tree import all_of as all_happen
from amberbox.diagnosis.faulttree.tree import any_of as any_happens
from amberbox.diagnosis.faulttree.tree import at_least as at_least_happen
from amberbox.diagnosis.fmea.fault_trees import effects, fault_tree_of, tree_over, unmet
from amberbox.diagnosis.fmea.model import FailureMode, Fmea, FmeaComponent, FmeaFunction, lost
from tests.diagnosis.faulttree.brute import minimal_states, probability
from tests.diagnosis.fmea.small import small

CHANCES = st.sampled_from((0.0, 1e-4, 0.02, 0.3, 0.5, 1.0))


@st.composite
def needs_of(draw: st.DrawFn, names: Sequence[str], deep: int = 2) -> Needs:
    """Draw needs over names, nested."""
    some = st.sampled_from(names)
    parts = draw(st.lists(st.one_of(some, needs_of(names, deep - 1)) if deep else some,
                          min_size=1, max_size=4, unique=True))  # fmt: skip
    return Needs(draw(st.integers(1, len(parts))), tuple(parts))


@st.composite
def fmeas(draw: st.DrawFn) -> Fmea:
    """Draw components with failure modes and functions; each may need earlier ones."""
    modes: dict[str, FailureMode] = {}
    components: dict[str, FmeaComponent] = {}
    functions: dict[str, FmeaFunction] = {}
    for number in range(draw(st.integers(1, 5))):
        name = f"c{number}"
        for place in range(draw(st.integers(0, 2))):
            mode = f"{name}#m{place}"
            modes[mode] = FailureMode(mode, name, f"m{place}", probability=draw(CHANCES),
                                      beta=0.5, takes_down=draw(st.integers(0, 3)) > 0)  # fmt: skip
        needed = draw(st.just(NOTHING) | needs_of([*components])) if components else NOTHING
        own = tuple(mode for mode in modes if mode.startswith(f"{name}#"))
        components[name] = FmeaComponent(name, "part", needs=needed, modes=own)
    for number in range(draw(st.integers(1, 3))):
        needed = draw(needs_of([*components, *functions]))
        functions[f"f{number}"] = FmeaFunction(f"f{number}", needed, system=draw(st.booleans()))
    return Fmea("robot", modes, components, functions, {})


@settings(max_examples=150)
@given(fmeas())
def test_trees_say_what_looking_at_every_state_says(fmea: Fmea) -> None:
    modes = list(fmea.modes)
    chances = [mode.chance() for mode in fmea.modes.values()]
    gone = [
        lost(fmea, [mode for place, mode in enumerate(modes) if state >> place & 1])
        for state in range(1 << len(modes))
    ]
    for name in fmea.needs():
        states = np.array([name in found for found in gone])
        found = analyse(fault_tree_of(fmea, name))
        assert found.top_probability == pytest.approx(probability(states, chances), abs=1e-12)
        assert found.cut_sets is not None and found.coherent
        assert set(found.cut_sets) == minimal_states(states, modes)


@settings(max_examples=50)
@given(fmeas())
def test_trees_survive_the_way_through_a_file(
    tmp_path_factory: pytest.TempPathFactory, fmea: Fmea
) -> None:
    path = tmp_path_factory.mktemp("mef") / "tree.xml"
    for name in effects(fmea):
        tree = fault_tree_of(fmea, name)
        path.write_text(write_mef(tree), encoding="utf-8")
        assert same(read_mef(path, name), tree)


def same(one: FaultTree, other: FaultTree) -> bool:
    """Compare what counts, not the order."""
    values = {name: event.probability for name, event in one.events.items()}
    others = {name: event.probability for name, event in other.events.items()}
    return dict(one.gates) == dict(other.gates) and values == others and one.top == other.top


@pytest.mark.parametrize(
    ("needs", "formula"),
    [
        (all_of("a", "b"), any_happens("a", "b")),
        (any_of("a", "b"), all_happen("a", "b")),
        (at_least(2, "a", "b", "c", "d"), at_least_happen(3, "a", "b", "c", "d")),
        (all_of("a", any_of("b", "c")), any_happens("a", all_happen("b", "c"))),
        (any_of("a"), Name("a")),
        (NOTHING, BooleanConstant(False)),
    ],
)
def test_needs_turn_into_gates(needs: Needs, formula: object) -> None:
    assert unmet(needs) == formula


def test_modes_that_do_not_take_their_component_down_are_no_cause() -> None:
    tree = fault_tree_of(small(), "see")
    assert set(tree.events) == {"laser_front#dead", "laser_rear#dead", "host#off"}
    assert tree.gates["laser_front"].formula == any_happens("laser_front#dead", "host")
    found = analyse(tree)
    assert found.by_order == (0, 1, 1)
    assert found.cut_sets is not None
    assert set(found.cut_sets) == {
        frozenset({"host#off"}),
        frozenset({"laser_front#dead", "laser_rear#dead"}),
    }


def test_probabilities_come_from_the_exposure_and_not_from_beta() -> None:
    fmea = small("rate: 1.0e-4", "rate: 1.0e-4\n        beta: 0.1")
    own, short = fault_tree_of(fmea, "see"), fault_tree_of(fmea, "see", exposure_h=1.0)
    assert own.events["laser_front#dead"].probability == pytest.approx(1 - np.exp(-0.01))
    assert short.events["laser_front#dead"].probability == pytest.approx(1 - np.exp(-1e-4))
    assert short.events["host#off"].probability == 0.001


def test_labels_are_the_descriptions() -> None:
    tree = fault_tree_of(small(), "see")
    assert tree.events["laser_rear#dead"].label == "the rear laser is dead"
    assert tree.gates["laser_rear"].label == "does not serve: the rear laser"
    assert tree.gates["see"].label == ""
    told = fault_tree_of(small("  see: {", "  see: {description: see people, "), "see")
    assert told.gates["see"].label == "lost: see people"


def test_effects_are_the_functions_of_the_system() -> None:
    assert effects(small()) == ("see", "carry")
    assert effects(small("    needs: [see, hook]\n    system: true", "    needs: [see, hook]")) == (
        "see",
    )


def test_a_component_can_be_the_top() -> None:
    assert analyse(fault_tree_of(small(), "hook")).by_order == (0, 2)


def test_an_effect_that_there_is_not() -> None:
    with pytest.raises(UsageError, match=r"no effect 'cary'; did you mean 'carry'\?") as error:
        fault_tree_of(small(), "cary")
    assert "see, carry" in error.value.hint


def test_gates_of_ones_own_stand_over_losses() -> None:
    both = Gate("both", all_happen("see", "laser_front#dirty"))
    found = analyse(tree_over(small(), "both", {"both": both}))
    assert found.cut_sets is not None and found.by_order == (0, 0, 1, 1)
    assert next(iter(found.cut_sets)) == {"host#off", "laser_front#dirty"}
