"""Random fault trees, and their answers by looking at every state there is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from amberbox.diagnosis.faulttree.tree import (
    BooleanConstant,
    FaultTree,
    Formula,
    GateOperation,
    Name,
    Operator,
    fault_tree,
)

COHERENT: tuple[Operator, ...] = ("and", "or", "atleast")
OPERATORS: tuple[Operator, ...] = (
    *COHERENT,
    *("not", "xor", "iff", "nand", "nor", "imply", "cardinality"),
)
States = NDArray[np.bool_]
"""One entry per state; bit i of its index is set if event i has happened."""


@st.composite
def trees(
    draw: st.DrawFn,
    operators: Sequence[Operator] = OPERATORS,
    most_events: int = 10,
    most_gates: int = 10,
) -> FaultTree:
    """Draw a tree whose gates use events, house events, constants and earlier gates."""
    events = [f"e{n}" for n in range(draw(st.integers(1, most_events)))]
    gates: dict[str, Formula] = {}
    for number in range(draw(st.integers(1, most_gates))):
        gates[f"g{number}"] = draw(_formula(operators, [*events, *events, *gates, "on", "off"]))
    chances = draw(st.lists(st.sampled_from((0.0, 0.01, 0.3, 0.5, 0.97, 1.0)),
                            min_size=len(events), max_size=len(events)))  # fmt: skip
    houses = {"on": True, "off": False}
    top = list(gates)[-1]
    return fault_tree("random", top, gates, dict(zip(events, chances, strict=True)), houses)


@st.composite
def _formula(draw: st.DrawFn, operators: Sequence[Operator], names: Sequence[str]) -> Formula:
    operator = draw(st.sampled_from(operators))
    entry = st.sampled_from([Name(name) for name in names])
    some = st.one_of(entry, entry, entry, st.builds(BooleanConstant, st.booleans()), _pair(entry))
    fewest, most = {"not": (1, 1)}.get(operator, (1, 5))
    if operator in ("xor", "iff", "imply"):
        fewest = most = 2
    inputs = tuple(draw(st.lists(some, min_size=fewest, max_size=most)))
    if operator not in ("atleast", "cardinality"):
        return GateOperation(operator, inputs)
    low = draw(st.integers(0, len(inputs)))
    high = draw(st.integers(low, len(inputs))) if operator == "cardinality" else 0
    return GateOperation(operator, inputs, low, high)


def _pair(entry: st.SearchStrategy[Name]) -> st.SearchStrategy[Formula]:
    return st.builds(lambda a, b: GateOperation("and", (a, b)), entry, entry)


def truth(tree: FaultTree, events: Sequence[str]) -> States:
    """Return whether the top event happens, for every state of the events."""
    index = np.arange(1 << len(events))
    known: dict[str, States] = {e: (index >> n & 1).astype(bool) for n, e in enumerate(events)}
    known |= {house: np.full(len(index), value) for house, value in tree.houses.items()}
    for gate in tree.gates.values():  # each after those it uses
        known[gate.name] = _truth(gate.formula, known, len(index))
    return known[tree.top]


def _truth(formula: Formula, known: Mapping[str, States], size: int) -> States:
    if isinstance(formula, Name):
        return known[formula.name]
    if isinstance(formula, BooleanConstant):
        return np.full(size, formula.value)
    inputs = [_truth(entry, known, size) for entry in formula.inputs]
    count = np.sum(inputs, axis=0)
    low, high = formula.at_least, formula.at_most
    answers: dict[str, States] = {
        "and": count == len(inputs),
        "or": count > 0,
        "not": count == 0,
        "xor": count == 1,
        "iff": count != 1,
        "nand": count < len(inputs),
        "nor": count == 0,
        "imply": ~inputs[0] | inputs[-1],
        "atleast": count >= low,
        "cardinality": (count >= low) & (count <= high),
    }
    return answers[formula.operator]


def probability(states: States, chances: Sequence[float]) -> float:
    """Add up the probabilities of the states in which the top event happens."""
    weights = reduce(lambda w, p: np.concatenate((w * (1 - p), w * p)), chances, np.ones(1))
    return float(np.sum(weights[states]))


def minimal_states(states: States, events: Sequence[str]) -> set[frozenset[str]]:
    """Return the states without a smaller one, each as the events that have happened."""
    found: list[int] = []
    for state in sorted(np.flatnonzero(states).tolist(), key=int.bit_count):
        if not any(smaller & state == smaller for smaller in found):
            found.append(state)
    return {frozenset(e for n, e in enumerate(events) if state >> n & 1) for state in found}
