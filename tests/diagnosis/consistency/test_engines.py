"""The solvers against each other and against python-sat."""

from __future__ import annotations

import random
from collections.abc import Iterable
from pathlib import Path

import pytest
from pysat.examples.rc2 import RC2
from pysat.formula import WCNF
from pysat.solvers import Minisat22

from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.core.errors import UsageError
from amberbox.diagnosis.consistency import engines
from amberbox.diagnosis.consistency.circuits import Circuit, encode, read_circuit
from amberbox.diagnosis.consistency.engines import SolverName, make_solver
from amberbox.diagnosis.consistency.question import ask, of_circuit
from amberbox.diagnosis.consistency.satisfiability import Solver
from benchmarks.consistency import observation, random_circuit

ENGINES: list[SolverName] = ["python", "clingo"]


class Recorded(Solver):
    """Keeps the clauses that are added."""

    def __init__(self) -> None:
        super().__init__()
        self.clauses: list[list[int]] = []

    def add(self, literals: Iterable[int]) -> None:
        self.clauses.append(list(literals))


@pytest.mark.parametrize("engine", ENGINES)
def test_it_decides_as_python_sat_does(engine: SolverName) -> None:
    rng = random.Random(4)
    for _ in range(15):
        solver, oracle = make_solver(Budget(), engine), Minisat22()
        for _ in range(40):
            solver.variable()
        for _ in range(4):
            for _ in range(42):
                clause = [rng.choice((1, -1)) * n for n in rng.sample(range(1, 41), 3)]
                solver.add(clause)
                oracle.add_clause(clause)
            assumed = [rng.choice((1, -1)) * n for n in rng.sample(range(1, 41), 3)]
            assert solver.solve(assumed) == oracle.solve(assumptions=assumed)
            assert oracle.solve(assumptions=solver.core) == (not solver.core) or not solver.core


def smallest(circuit: Circuit, observed: dict[str, bool]) -> list[list[str]]:
    """Return the diagnoses with the fewest gates, by python-sat."""
    recorded = Recorded()
    gates = {name: recorded.variable() for name in circuit.gates}
    encode(circuit, recorded, gates, observed)
    problem = WCNF()
    problem.extend(recorded.clauses)
    problem.extend([[-gate] for gate in gates.values()], weights=[1] * len(gates))
    found: set[tuple[str, ...]] = set()
    with RC2(problem) as solver:
        least = None
        while (model := solver.compute()) is not None and least in (None, solver.cost):
            least, holds = solver.cost, {*model}
            names = sorted(name for name, gate in gates.items() if gate in holds)
            found.add(tuple(names))
            solver.add_clause([-gates[name] for name in names])
    return sorted(map(list, found))


def check(circuit: Circuit, rng: random.Random) -> None:
    observed = observation(circuit, 2, rng)
    known = smallest(circuit, observed)
    for engine in ENGINES:
        question = of_circuit(circuit, [observed], Budget(), engine)
        found = ask(question, "cardinality", 1_000, Budget())
        assert [names for _, names in found.diagnoses] == known


def test_the_smallest_diagnoses_of_circuits() -> None:
    rng = random.Random(7)
    for _ in range(2):
        check(random_circuit(rng), rng)


@pytest.mark.needs_data
def test_the_smallest_diagnoses_of_c432(shared_data: Path) -> None:
    circuit = read_circuit(shared_data / "diagnosis" / "circuits" / "c432.bench")
    check(circuit, random.Random(3))


@pytest.mark.parametrize("engine", ENGINES)
def test_a_budget_ends_the_search(engine: SolverName) -> None:
    solver = make_solver(Budget(is_over=lambda: True), engine)
    solver.add([solver.variable()])
    with pytest.raises(OutOfTimeError):
        solver.solve()


def test_without_clingo_the_own_solver_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "has_clingo", lambda: False)
    assert type(make_solver(Budget())) is type(make_solver(Budget(), "python"))
    with pytest.raises(UsageError, match="clingo is not installed"):
        make_solver(Budget(), "clingo")
