"""Solvers by name: the own one in Python, or clingo where it is installed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any, Literal, TypeAlias

from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.core.errors import UsageError
from amberbox.diagnosis.consistency.integers import IntegerSolver
from amberbox.diagnosis.consistency.satisfiability import Solver

SolverName: TypeAlias = Literal["", "python", "clingo"]  # empty: clingo where it is installed

_LOOK_S = 0.05  # between two looks at the budget


@cache
def has_clingo() -> bool:
    """Return whether clingo is installed."""
    return find_spec("clingo") is not None


def make_solver(budget: Budget, name: SolverName = "") -> IntegerSolver:
    """Return a solver; raises UsageError for clingo where it is not installed."""
    if name == "clingo" and not has_clingo():
        raise UsageError("clingo is not installed", "pip install clingo, or --solver python")
    use_clingo = name == "clingo" or (not name and has_clingo())
    return ClingoIntegerSolver(budget) if use_clingo else IntegerSolver(budget)


class ClingoSolver(Solver):
    """The clauses in clingo: a choice for each variable, a constraint for each clause.

    Optima are found by unsatisfiable cores (``usc``); the default strategy has bad worst cases.
    """

    def __init__(self, budget: Budget | None = None) -> None:
        import clingo  # an optional package, and only here

        super().__init__(budget)
        self._control: Any = clingo.Control(["--opt-strategy=usc", "--opt-mode=ignore"])
        self._atoms: list[int] = [0]  # by variable
        self._new: list[list[int]] = []
        self._counted: Mapping[int, int] = {}

    def variable(self) -> int:
        """Return a new variable."""
        self._atoms.append(0)
        return len(self._atoms) - 1

    def add(self, literals: Iterable[int]) -> None:
        """Add a clause: at least one of the literals holds."""
        self._new.append(list(literals))

    def solve(self, assumptions: Sequence[int] = ()) -> bool:
        """Return whether all clauses can hold with the assumptions.

        Raises OutOfTimeError when the budget is spent.
        """
        self._write()
        self._control.configuration.solve.opt_mode = "ignore"
        self.core = ()
        return self._solve(assumptions) is not None

    def lower_bound(self, weights: Mapping[int, int], assumptions: Sequence[int] = ()) -> int:
        """Return the least sum of the weights of literals that hold; raises OutOfTimeError."""
        self._write()
        if weights != self._counted:
            with self._control.backend() as backend:
                if self._counted:
                    return 0  # clingo keeps what it minimises
                backend.add_minimize(0, [(self._literal(n), w) for n, w in weights.items()])
            self._counted = dict(weights)
        self._control.configuration.solve.opt_mode = "opt"
        cost = self._solve(assumptions)
        return cost or 0

    def _literal(self, literal: int) -> int:
        atom = self._atoms[abs(literal)]
        return atom if literal > 0 else -atom

    def _write(self) -> None:
        """Hand over the variables and clauses since the last time."""
        new = [number for number in range(1, len(self._atoms)) if not self._atoms[number]]
        if not new and not self._new:
            return
        with self._control.backend() as backend:
            for number in new:
                self._atoms[number] = backend.add_atom()
                backend.add_rule([self._atoms[number]], [], True)
            for clause in self._new:
                backend.add_rule([], [-self._literal(literal) for literal in clause])
        self._new = []

    def _solve(self, assumptions: Sequence[int]) -> int | None:
        """Return the cost of the last model; None without one."""
        self._budget.check()
        assumed = {self._literal(literal): literal for literal in assumptions}
        cost: int | None = None
        is_endless = self._budget.is_over is bool
        with self._control.solve([*assumed], yield_=True, async_=not is_endless) as handle:
            while True:
                handle.resume()
                while not is_endless and not handle.wait(_LOOK_S):
                    if self._budget.is_over():
                        handle.cancel()
                        raise OutOfTimeError
                model = handle.model()
                if model is None:
                    break
                cost = sum(model.cost)
                self.model = [False, *(model.is_true(atom) for atom in self._atoms[1:])]
                if self._control.configuration.solve.opt_mode == "ignore":
                    break
            if cost is None:
                self.core = [assumed[literal] for literal in handle.core()]
        return cost


class ClingoIntegerSolver(IntegerSolver, ClingoSolver):
    """Clingo, with the equations of integers."""
