"""Diagnoses and conflicts of circuits, against all sets of gates."""

from __future__ import annotations

import json
from itertools import chain, combinations, groupby, product
from operator import itemgetter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.errors import ConfigurationError
from amberbox.diagnosis.consistency.circuits import Circuit, Gate, encode, read_circuit
from amberbox.diagnosis.consistency.diagnoses import minimal_conflicts, minimal_diagnoses
from amberbox.diagnosis.consistency.satisfiability import Solver

Observation = dict[str, bool]
GATES = {
    "AND": all, "OR": any, "XOR": lambda values: sum(values) % 2 == 1, "BUFF": all,
}  # fmt: skip
OPPOSITE = {"NAND": "AND", "NOR": "OR", "XNOR": "XOR", "NOT": "BUFF"}


def value_of(gate: Gate, inputs: list[bool]) -> bool:
    made = GATES[OPPOSITE.get(gate.kind, gate.kind)](inputs)
    return not made if gate.kind in OPPOSITE else made


@st.composite
def circuits(draw: st.DrawFn) -> Circuit:
    """Return a circuit of up to five gates with three inputs."""
    signals, gates = ["a", "b", "c"], {}
    for number in range(draw(st.integers(1, 5))):
        kind = draw(st.sampled_from([*GATES, *OPPOSITE]))
        most = 1 if kind in ("BUFF", "NOT") else 3
        inputs = st.lists(st.sampled_from(signals), min_size=1, max_size=most, unique=True)
        gates[f"g{number}"] = Gate(kind, draw(inputs))
        signals.append(f"g{number}")
    return Circuit(["a", "b", "c"], [signals[-1], signals[-2]][: len(gates)], gates)


def agrees(circuit: Circuit, faulty: set[str], observed: Observation) -> bool:
    """Tell whether some values of the faulty gates give what was observed."""
    for freely in product((False, True), repeat=len(faulty)):
        values = {name: observed[name] for name in circuit.inputs}
        given_ = dict(zip(sorted(faulty), freely, strict=True))
        for name, gate in circuit.gates.items():
            inputs = [values[source] for source in gate.inputs]
            values[name] = given_[name] if name in given_ else value_of(gate, inputs)
        if all(values[name] == value for name, value in observed.items()):
            return True
    return False


def subsets(names: list[str]) -> list[set[str]]:
    sizes = range(len(names) + 1)
    return [set(s) for s in chain.from_iterable(combinations(names, size) for size in sizes)]


def minimal(sets: list[set[str]]) -> list[list[str]]:
    return sorted(sorted(s) for s in sets if not any(other < s for other in sets))


def encoded(circuit: Circuit, observations: list[Observation]) -> tuple[Solver, dict[str, int]]:
    solver = Solver()
    faults = {name: solver.variable() for name in circuit.gates}
    for observed in observations:
        encode(circuit, solver, faults, observed)
    return solver, faults


@settings(max_examples=60)
@given(circuits(), st.data())
def test_diagnoses_and_conflicts_are_those_of_all_sets(
    circuit: Circuit, data: st.DataObject
) -> None:
    names = sorted({*circuit.inputs, *circuit.outputs})
    one = st.tuples(*(st.booleans() for _ in names))
    drawn = data.draw(st.lists(one, min_size=1, max_size=2))
    observations = [dict(zip(names, values, strict=True)) for values in drawn]
    solver, faults = encoded(circuit, observations)
    every = subsets(list(circuit.gates))
    fit = [s for s in every if all(agrees(circuit, s, seen) for seen in observations)]
    found = list(minimal_diagnoses(solver, faults))
    assert [rank for rank, _ in found] == sorted(len(names) for _, names in found)
    assert sorted(sorted(names) for _, names in found) == minimal(fit)
    gates = set(circuit.gates)
    conflicts = [s for s in every if gates - s not in fit]
    assert sorted(minimal_conflicts(solver, faults)) == minimal(conflicts)
    ranks = {name: data.draw(st.integers(1, 3)) for name in circuit.gates}
    ranked = list(minimal_diagnoses(solver, faults, ranks))
    assert sorted(sorted(names) for _, names in ranked) == minimal(fit)
    assert [rank for rank, _ in ranked] == sorted(sum(ranks[n] for n in s) for _, s in ranked)


@pytest.mark.needs_data
def test_published_answers(shared_data: Path) -> None:
    folder = shared_data / "diagnosis" / "circuits"
    for known in json.loads((folder / "minimum_cardinality.json").read_text()):
        circuit = read_circuit(folder / f"{known['circuit']}.bench")
        inputs = known["input_order"] or circuit.inputs
        ports = (*inputs, *(known["output_order"] or circuit.outputs))
        values = known["inputs"] + known["outputs"]
        observed = {name: value == "1" for name, value in zip(ports, values, strict=True)}
        solver, faults = encoded(circuit, [observed])
        _, first = next(groupby(minimal_diagnoses(solver, faults), itemgetter(0)))
        made = sorted(sorted(names) for _, names in first)
        assert {len(names) for names in made} == {known["min_card"]}
        assert len(made) == known["n_min_card"]
        assert made == sorted(map(sorted, known.get("diagnoses") or made))


CIRCUIT = """\
# a comment
INPUT(a)
INPUT(b)
OUTPUT(out)
inner = NAND(a, b)  # and another
out = NOT(inner)
"""


def test_a_file(tmp_path: Path) -> None:
    path = tmp_path / "and.bench"
    path.write_text(CIRCUIT)
    circuit = read_circuit(path)
    assert circuit.gates == {"inner": Gate("NAND", ["a", "b"]), "out": Gate("NOT", ["inner"])}
    solver, faults = encoded(circuit, [{"a": True, "b": True, "out": False}])
    assert sorted(minimal_diagnoses(solver, faults)) == [(1, ["inner"]), (1, ["out"])]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("NAND(a, b)", "NAND(a, c)", "and.bench:5: inner: nothing makes 'c'"),
        ("NAND", "MAYBE", "and.bench:5: inner: there is no kind of gate 'MAYBE'"),
        ("NOT(inner)", "NOT(inner, a)", "and.bench:6: out: has not the inputs of its kind"),
        ("NAND(a, b)", "NAND(a,)", "and.bench:5: inner: has not the inputs"),
        ("out = NOT", "inner = NOT", "is made twice"),
        ("inner =", "a =", "is an input, too"),
        ("OUTPUT(out)", "OUTPUT(it)", "and.bench:4: it: nothing makes it"),
        ("INPUT(b)", "what is this", "and.bench:3: file: is neither a port nor a gate"),
        ("NOT(inner)", "NOT(out)", "out: is made from itself"),
    ],
)
def test_mistakes_are_said_by_their_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "and.bench"
    path.write_text(CIRCUIT.replace(old, new))
    with pytest.raises(ConfigurationError) as error:
        read_circuit(path)
    assert said in str(error.value)
