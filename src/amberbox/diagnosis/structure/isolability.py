"""Which faults a set of equations can detect, and tell from each other."""

from __future__ import annotations

from collections.abc import Sequence

from amberbox.core.contracts import Budget
from amberbox.core.equations.matching import Matching
from amberbox.core.equations.structure import Causality, Structure, bits

ENDLESS = Budget()


def testable(model: Structure, equations: int, causality: Causality = Causality.MIXED) -> int:
    """Return the equations whose violation can be seen, as a mask.

    They are the over-determined part of those whose unknowns can be computed.

    Source: Frisk et al., Diagnosability analysis considering causal interpretations for
    differential constraints, IEEE Transactions on Systems, Man and Cybernetics A 42 (2012).
    """
    if causality is Causality.INTEGRAL:
        equations = _without_undetermined(model, equations)
    elif causality is Causality.DERIVATIVE:
        equations = _without_derivatives_of_unknowns(model, equations)
    matching = _match(model, equations, causality)
    return matching.reached_from(matching.free, model.variables)


def _match(model: Structure, equations: int, causality: Causality) -> Matching:
    edges = [model.computable(e, causality) for e in range(len(model.equations))]
    return Matching.of(edges, equations, len(model.unknowns))


def _all_known(model: Structure, equations: int, known: int) -> int:
    """Return those of the equations all of whose unknowns are known."""
    return sum(1 << e for e in bits(equations) if not model.variables[e] & ~known)


def _without_undetermined(model: Structure, equations: int) -> int:
    """Return the equations whose unknowns are all computed when states are integrated."""
    while True:
        known = _match(model, equations, Causality.INTEGRAL).determined()
        left = _all_known(model, equations, known)
        if left == equations:
            return left
        equations = left


def _without_derivatives_of_unknowns(model: Structure, equations: int) -> int:
    """Return the equations whose unknowns are all computed when states are differentiated.

    A derivative can be used once its state is known, so that no loop has a derivative in it.
    """
    known = 0
    while True:
        usable = equations
        for equation, (state, _) in model.differentials.items():
            if not known >> state & 1:
                usable &= ~(1 << equation)
        edges = [
            model.computable(e, Causality.DERIVATIVE) & ~known for e in range(len(model.equations))
        ]
        new = Matching.of(edges, usable, len(model.unknowns)).determined()
        if not new:
            return _all_known(model, equations, known)
        known |= new


def detectable(model: Structure, causality: Causality = Causality.MIXED) -> int:
    """Return the faults that can be detected, as a mask."""
    seen = testable(model, model.all, causality)
    return sum(1 << f for f, shown in enumerate(model.shown_in) if shown & seen)


def isolability(
    model: Structure, causality: Causality = Causality.MIXED, budget: Budget = ENDLESS
) -> Sequence[Sequence[bool]]:
    """Return, for each fault (row) and each that may be meant instead (column), whether it may.

    That is so when no test shows the fault of the row but not that of the column. A fault that
    cannot be detected has only such columns. Raises OutOfTimeError.
    """
    columns = []
    for shown_in in model.shown_in:
        budget.check()
        seen = testable(model, model.all & ~shown_in, causality)
        columns.append([not shown & seen for shown in model.shown_in])
    return [list(row) for row in zip(*columns, strict=True)]
