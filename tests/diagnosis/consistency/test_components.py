"""Models of components, against all combinations of modes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import product
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.core.contracts import Budget
from amberbox.core.expression import parse
from amberbox.diagnosis.consistency.components import Mode, Step, load_components
from amberbox.diagnosis.consistency.question import Answer, Minimal, ask, of_components
from tests.cli.test_consistency import POLYBOX


def answer(
    path: Path, minimal: Minimal = "subset", observed: Mapping[str, int] | None = None
) -> Answer:
    model = load_components(path)
    steps = [Step({**step.observe, **(observed or {})}) for step in model.steps or [Step()]]
    return ask(of_components(model, steps, Budget()), minimal, 1_000, Budget())


def names(found: Answer) -> list[list[str]]:
    """Return the components of the diagnoses, without their modes."""
    return [[name.partition("=")[0] for name in one] for _, one in found.diagnoses]


PROBED = {
    "M1.out": {4: ["M1"], 6: ["A1", "A2 M2", "M2 M3"]},
    "M2.out": {4: ["A2 M2", "M2 M3"], 6: ["A1", "M1"]},
    "M3.out": {6: ["A1", "M1", "A2 M2"], 8: ["M2 M3", "A1 A2 M3", "A2 M1 M3"]},
}


def test_the_polybox(tmp_path: Path) -> None:
    path = tmp_path / "polybox.yaml"
    path.write_text(POLYBOX)
    found = answer(path)
    assert found.conflicts == [["A1", "M1", "M2"], ["A1", "A2", "M1", "M3"]]
    assert names(found) == [["A1"], ["M1"], ["A2", "M2"], ["M2", "M3"]]
    assert [rank for rank, _ in found.diagnoses] == [2, 2, 4, 4]
    assert names(answer(path, "cardinality")) == [["A1"], ["M1"]]
    for port, outcomes in PROBED.items():
        for value, known in outcomes.items():
            assert names(answer(path, observed={port: value})) == [one.split() for one in known]


@pytest.mark.needs_data
def test_the_polybox_of_the_textbook(shared_data: Path, tmp_path: Path) -> None:
    known = json.loads((shared_data / "diagnosis/textbook/known_answers.json").read_text())
    known = known["polybox"]
    model = yaml.safe_load(POLYBOX)
    ports = {"A": "M1.left", "B": "M2.left", "C": "M1.right", "D": "M2.right", "E": "M3.right"}
    ports |= {"F": "A1.out", "G": "A2.out", "X": "M1.out", "Y": "M2.out", "Z": "M3.out"}
    seen = {ports[name]: value for name, value in (known["inputs"] | known["observed"]).items()}
    path = tmp_path / "polybox.yaml"
    path.write_text(json.dumps(model | {"steps": [{"observe": seen}]}))
    found = answer(path)
    assert found.conflicts == known["minimal_conflicts"]
    assert names(found) == known["minimal_diagnoses"]
    for probe, diagnoses in known["after"].items():
        name, _, value = probe.partition("=")
        path.write_text(
            json.dumps(model | {"steps": [{"observe": seen | {ports[name]: int(value)}}]})
        )
        assert sorted(names(answer(path))) == sorted(diagnoses)


GATE = {"left": [False, True], "right": [False, True], "out": [False, True]}
ADDER = {
    "kind": "components",
    "types": {
        kind: {"ports": GATE, "modes": {
            "ok": {"nominal": True, "constraints": [f"out == ({what})"]}, "broken": {}}}
        for kind, what in {
            "xor": "left != right", "and": "left and right", "or": "left or right",
        }.items()
    },
    "components": {"X1": "xor", "X2": "xor", "A1": "and", "A2": "and", "O1": "or"},
    "connections": [
        ["X1.left", "A1.left"], ["X1.right", "A1.right"], ["X2.right", "A2.left"],
        ["X1.out", "X2.left", "A2.right"], ["A1.out", "O1.left"], ["A2.out", "O1.right"],
    ],
}  # fmt: skip
SUM = {"X1.left": "a", "X1.right": "b", "X2.right": "c", "X2.out": "sum", "O1.out": "carry"}


def adder(path: Path, *observations: dict[str, int]) -> Answer:
    steps = [{"observe": {port: bool(seen[n]) for port, n in SUM.items()}} for seen in observations]
    path.write_text(json.dumps(ADDER | {"steps": steps}))
    return answer(path)


def test_the_full_adder(tmp_path: Path) -> None:
    seen = {"a": 1, "b": 0, "c": 1, "sum": 1, "carry": 0}
    found = adder(tmp_path / "adder.yaml", seen)
    assert found.conflicts == [["X1", "X2"], ["A2", "O1", "X1"]]
    assert names(found) == [["X1"], ["A2", "X2"], ["O1", "X2"]]
    # A second observation that only a fault of X2 and one of the carry explain.
    other = {"a": 0, "b": 0, "c": 0, "sum": 1, "carry": 1}
    assert ["X1"] not in names(adder(tmp_path / "adder.yaml", seen, other))
    assert ["O1", "X2"] in names(adder(tmp_path / "adder.yaml", seen, other))
    assert names(adder(tmp_path / "adder.yaml", seen | {"sum": 0, "carry": 1})) == [[]]


@pytest.mark.needs_data
def test_the_full_adder_of_the_textbook(shared_data: Path, tmp_path: Path) -> None:
    known = json.loads((shared_data / "diagnosis/textbook/known_answers.json").read_text())
    found = adder(
        tmp_path / "adder.yaml", known["full_adder"]["inputs"] | known["full_adder"]["observed"]
    )
    assert found.conflicts == known["full_adder"]["minimal_conflicts"]
    assert names(found) == known["full_adder"]["minimal_diagnoses"]


@pytest.mark.parametrize(
    ("probability", "rank"),
    [(0.05, 1), (0.01, 2), (0.005, 2), (0.0025, 3), (1e-4, 4), (1e-10, 10), (0.9, 1), (None, 3)],
)
def test_the_rank_of_a_probability(probability: float | None, rank: int) -> None:
    assert Mode(probability=probability).rank == rank


VALUES = ("low", "mid", "high")
RELATIONS = ("out == in", "out != in", "out == low", "in == high or out == mid", "not in == low")
SUMS = ("out == in", "out == in + 1", "out + in == 3", "out == 2 * in", "in == 0", "out * in == 0")


@st.composite
def models(draw: st.DrawFn, *, of_integers: bool) -> dict[str, object]:
    """Return a chain of up to three components, with the port that two of them share at times."""
    relations = st.lists(st.sampled_from(SUMS if of_integers else RELATIONS), max_size=2)
    ports = "int" if of_integers else [*VALUES]
    types, components = {}, {}
    for number in range(draw(st.integers(1, 3))):
        modes: dict[str, object] = {"ok": {"nominal": True, "constraints": draw(relations)}}
        if draw(st.booleans()):
            modes["other"] = {"nominal": True, "constraints": draw(relations)}
        for mode in ("stuck", "lost")[: draw(st.integers(0, 2))]:
            probability = draw(st.sampled_from([0.1, 0.01, 0.001]))
            modes[mode] = {"probability": probability, "constraints": draw(relations)}
        types[f"t{number}"] = {"ports": {"in": ports, "out": ports}, "modes": modes}
        components[f"c{number}"] = f"t{number}"
    joined = [[f"c{n}.out", f"c{n + 1}.in"] for n in range(len(components) - 1)]
    every = [f"c{n}.{port}" for n in range(len(components)) for port in ("in", "out")]
    value = st.integers(0, 3) if of_integers else st.sampled_from(VALUES)
    seen = st.dictionaries(st.sampled_from(every), value)
    if of_integers:  # what is known everywhere is decided by propagation, exactly
        seen = st.fixed_dictionaries(dict.fromkeys(every, value))
    steps = draw(st.lists(seen.map(lambda one: {"observe": one}), min_size=1, max_size=2))
    return {
        "kind": "components", "types": types, "components": components, "connections": joined,
        "steps": steps,
    }  # fmt: skip


def agrees(model: dict[str, object], modes: dict[str, dict[str, object]], seen: object) -> bool:
    """Tell whether some values of all ports agree with modes, connections and an observation."""
    assert isinstance(seen, dict)
    ports = [f"{name}.{port}" for name in modes for port in ("in", "out")]
    choices = [[seen[port]] if port in seen else VALUES for port in ports]
    for row in product(*choices):
        values = dict(zip(ports, row, strict=True))
        joined = model["connections"]
        assert isinstance(joined, list)
        if any(values[one] != values[other] for one, other in joined):
            continue
        if all(
            parse(constraint).evaluate(
                {word: word for word in VALUES}
                | {"in": values[f"{name}.in"], "out": values[f"{name}.out"]}
            )
            for name, mode in modes.items()
            for constraint in mode["constraints"]  # type: ignore[attr-defined]  # a list
        ):
            return True
    return False


def by_brute_force(model: dict[str, object]) -> tuple[list[list[str]], list[list[str]]]:
    """Return the minimal diagnoses and the minimal conflicts, by looking at everything."""
    fit: list[set[str]] = []
    types: dict[str, dict[str, dict[str, dict[str, object]]]] = model["types"]  # type: ignore[assignment]  # as drawn
    components: dict[str, str] = model["components"]  # type: ignore[assignment]  # as drawn
    steps: list[dict[str, object]] = model["steps"]  # type: ignore[assignment]  # as drawn
    offered = [types[kind]["modes"].items() for kind in components.values()]
    for chosen in product(*offered):
        modes = {name: mode for name, (_, mode) in zip(components, chosen, strict=True)}
        if all(agrees(model, modes, step["observe"]) for step in steps):
            named = zip(components, chosen, strict=True)
            fit.append({f"{c}={m}" for c, (m, mode) in named if "nominal" not in mode})
    faulty = [{name.partition("=")[0] for name in one} for one in fit]
    able = [c for c, kind in components.items() if {"stuck"} & types[kind]["modes"].keys()]
    sets = [{c for c, take in zip(able, row, strict=True) if take}
            for row in product((False, True), repeat=len(able))]  # fmt: skip
    conflicts = [one for one in sets if all(one & other for other in faulty)]
    return minimal(fit), minimal(conflicts)


def minimal(sets: list[set[str]]) -> list[list[str]]:
    kept = {tuple(sorted(one)) for one in sets if not any(other < one for other in sets)}
    return sorted(map(list, kept), key=lambda one: (len(one), one))


@pytest.mark.parametrize("of_integers", [False, True])
def test_random_models_against_all_combinations(tmp_path: Path, of_integers: bool) -> None:
    path = tmp_path / "model.yaml"

    @settings(max_examples=60, suppress_health_check=list(HealthCheck))
    @given(models(of_integers=of_integers))
    def check(model: dict[str, object]) -> None:
        path.write_text(json.dumps(model))
        found = answer(path)
        diagnoses, conflicts = by_brute_force(model)
        assert [one for _, one in found.diagnoses] == diagnoses
        assert found.conflicts == conflicts
        ranks = {rank for rank, _ in answer(path, "rank").diagnoses}
        assert ranks == ({found.rank} if diagnoses else set())
        few = [one for one in diagnoses if len(one) == len(diagnoses[0])]
        assert [one for _, one in answer(path, "cardinality").diagnoses] == few

    check()


def test_integers_are_solved_in_all_directions(tmp_path: Path) -> None:
    text = """\
kind: components
types:
  it:
    ports: {a: int, b: int}
    modes: {ok: {nominal: true, constraints: ["SAID"]}, broken: {}}
components: {it: it}
steps: [{observe: {it.a: 7, it.b: 3}}]
"""
    path = tmp_path / "it.yaml"
    for said, holds in {
        "a == 2 * b + 1": True, "2 * b == a": False, "-a + 10 == b == 3": True,
        "a * b == 20": False, "a - b - 4 == 0": True,
    }.items():  # fmt: skip
        path.write_text(text.replace("SAID", said))
        assert (names(answer(path)) == [[]]) is holds
    # One of both is unknown: it follows, has to be whole, and cannot follow where it is squared.
    one = text.replace(", it.b: 3", "")
    for said, holds in {
        "a == 2 * b": False, "a == 7 * b": True, "a == 0 * b": False, "a == b * b": True,
    }.items():  # fmt: skip
        path.write_text(one.replace("SAID", said))
        assert (names(answer(path)) == [[]]) is holds


def test_a_value_that_grows_without_end_ends(tmp_path: Path) -> None:
    model = {
        "kind": "components",
        "types": {"square": {"ports": {"in": "int", "out": "int"}, "modes": {
            "ok": {"nominal": True, "constraints": ["out == in * in"]}, "broken": {}}}},
        "components": {f"s{n}": "square" for n in range(200)},
        "connections": [[f"s{n}.out", f"s{n + 1}.in"] for n in range(199)],
        "steps": [{"observe": {"s0.in": 9, "s0.out": 80}}],
    }  # fmt: skip
    path = tmp_path / "squares.yaml"
    path.write_text(json.dumps(model))
    assert names(answer(path)) == [["s0"]]
