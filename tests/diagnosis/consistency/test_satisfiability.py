"""The solver of clauses against all assignments."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.diagnosis.consistency.satisfiability import Solver

VARIABLES = 6
literals = st.integers(1, VARIABLES).flatmap(lambda number: st.sampled_from([number, -number]))
clauses = st.lists(st.lists(literals, min_size=1, max_size=4), max_size=25)


def holds(clause: list[int], values: tuple[bool, ...]) -> bool:
    return any(values[abs(literal) - 1] == (literal > 0) for literal in clause)


def possible(all_clauses: list[list[int]]) -> bool:
    return any(
        all(holds(clause, values) for clause in all_clauses)
        for values in product((False, True), repeat=VARIABLES)
    )


@settings(max_examples=150)
@given(clauses, st.lists(st.lists(literals, max_size=4), min_size=1, max_size=4), st.data())
def test_it_decides_as_all_assignments_do(
    first: list[list[int]], questions: list[list[int]], data: st.DataObject
) -> None:
    solver, known = Solver(), list(first)
    for _ in range(VARIABLES):
        solver.variable()
    for clause in first:
        solver.add(clause)
    for assumed in questions:
        units = [[literal] for literal in assumed]
        if solver.solve(assumed):
            values = tuple(solver.model[1:])
            assert all(holds(clause, values) for clause in [*known, *units])
        else:
            assert not possible([*known, *([literal] for literal in solver.core)])
            assert set(solver.core) <= set(assumed)
        more = data.draw(st.lists(literals, min_size=1, max_size=3))
        solver.add(more)
        known.append(more)


def pigeons(count: int, budget: Budget | None = None) -> Solver:
    """Return clauses that put ``count`` pigeons into one hole less: they cannot hold."""
    solver = Solver(budget)
    sits = [[solver.variable() for _ in range(count - 1)] for _ in range(count)]
    for holes in sits:
        solver.add(holes)
    for hole in range(count - 1):
        for one in range(count):
            for other in range(one):
                solver.add([-sits[one][hole], -sits[other][hole]])
    return solver


def test_what_needs_learning_is_decided() -> None:
    assert not pigeons(6).solve()


def test_a_budget_ends_the_search() -> None:
    with pytest.raises(OutOfTimeError):
        pigeons(9, Budget(is_over=lambda: True)).solve()
