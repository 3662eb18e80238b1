"""The sets of equations from which a test of a robot can be made.

All walks take classes of equations out of an over-determined set: those that leave its
over-determined part together. Each set is met once: on a later branch nothing is taken out that
an earlier one has tried.

Sources: Krysander, Åslund, Nyberg, An efficient algorithm for finding minimal overconstrained
subsystems for model-based diagnosis, IEEE Transactions on Systems, Man and Cybernetics A 38
(2008); Krysander, Åslund, Frisk, A structural algorithm for finding testable sub-models and
multiple fault isolability analysis, DX 2010.
"""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.core.contracts import Budget
from amberbox.core.equations.matching import Matching
from amberbox.core.equations.structure import Structure
from amberbox.diagnosis.structure.isolability import ENDLESS


def mso_sets(model: Structure, budget: Budget = ENDLESS) -> Iterator[int]:
    """Yield the minimal structurally over-determined sets, as masks of equations.

    Each has one equation more than unknowns, and no part that has. Their number can grow
    exponentially with the redundancy: take as many as are wanted. Raises OutOfTimeError.

    Each class that is taken out lowers the redundancy by one: where too few can still be taken
    out, there is no set.
    """
    part = _overdetermined_part(model)
    waiting = [(part, part.equations)] if part.free else []
    while waiting:
        part, removable = waiting.pop()
        if part.free.bit_count() == 1:
            yield part.equations
            continue
        for left, taken in _classes(part, removable, budget):
            if not taken & ~removable:
                removable &= ~taken
                if left.free.bit_count() <= removable.bit_count() + 1:
                    waiting.append((left, removable))


def mtes_sets(model: Structure, budget: Budget = ENDLESS) -> Iterator[int]:
    """Yield the minimal test equation supports, as masks of equations.

    Each is the largest over-determined set with its faults, and no part of it has fewer: from it
    a test can be made that reacts to as few faults as can be. Raises OutOfTimeError.
    """
    part = _overdetermined_part(model)
    faulty = 0
    for shown in model.shown_in:
        faulty |= shown & part.equations
    waiting = [(part, faulty)] if faulty else []
    while waiting:
        part, removable = waiting.pop()
        smaller = [
            (left, taken & faulty)
            for left, taken in _classes(part, faulty & part.equations, budget)
            if left.equations & faulty
        ]
        if not smaller:
            yield part.equations
        for left, taken in smaller:
            if not taken & ~removable:
                removable &= ~taken
                waiting.append((left, removable))


def _overdetermined_part(model: Structure) -> Matching:
    matching = Matching.of(model.variables, model.all, len(model.unknowns))
    return matching.overdetermined_part()


def _classes(part: Matching, among: int, budget: Budget) -> Iterator[tuple[Matching, int]]:
    """Yield, for each class with an equation of ``among``, what is left without it, and the class.

    ``part`` is over-determined, and so is what is left.
    """
    while among:
        budget.check()
        left = part.without(among & -among).overdetermined_part()
        taken = part.equations & ~left.equations
        among &= ~taken
        yield left, taken
