"""Minimal diagnoses and minimal conflicts of clauses some of which depend on faults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import gcd

from amberbox.core.contracts import Budget
from amberbox.diagnosis.consistency.satisfiability import Solver

_FIRST_BOUND = 4  # what is counted at first; it doubles when that is not enough


def minimal_diagnoses(
    solver: Solver,
    faults: Mapping[str, int],
    ranks: Mapping[str, int] | None = None,
    *,
    only_least: bool = False,
    named: Mapping[str, int] | None = None,
    assumed: Sequence[int] = (),
    within: int | None = None,
) -> Iterator[tuple[int, list[str]]]:
    """Yield the minimal sets of faults that agree with the clauses: their rank, and their names.

    ``faults`` are literals by name. The rank of a set is the sum of those of its faults, which
    are 1 (its size) or given and greater than 0. Sets come by rank, and none contains another;
    ``only_least`` ends after those of the least rank, ``within`` after those that exceed it by no
    more than this. With ``named`` literals these are what is
    yielded, each set of them once; ``faults`` are only counted. ``assumed`` literals hold.
    The clauses remain as they are; raises OutOfTimeError when the budget of the solver is spent.
    """
    given = {name: (ranks or {}).get(name, 1) for name in faults}
    unit = gcd(*given.values())
    weights = {name: rank // unit for name, rank in given.items()}
    enough = sum(weights.values())
    blocking = solver.variable()
    bound = min(_FIRST_BOUND, enough)
    counted = _counter(solver, faults, weights, bound)
    rank = solver.lower_bound({faults[name]: w for name, w in weights.items()}, assumed)
    last = enough
    while rank <= last and solver.solve([blocking, *assumed]):
        if rank > bound:
            bound = min(2 * bound, enough)
            counted = _counter(solver, faults, weights, bound)
        limit = [blocking, *assumed] + ([-counted[rank]] if rank < len(counted) else [])
        while solver.solve(limit):
            found = [name for name, literal in (named or faults).items() if solver.holds(literal)]
            if only_least or within is not None:
                last = min(last, rank + (0 if only_least else (within or 0) // (unit or 1)))
            others = [] if named is None else [named[name] for name in named.keys() - {*found}]
            yield rank * unit, found
            solver.add([-blocking, *others, *(-(named or faults)[name] for name in found)])
        rank += 1
    solver.add([-blocking])


def minimal_sets(sets: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return the sets that contain no other one."""
    kept: list[tuple[Sequence[str], frozenset[str]]] = []
    for names in sorted(sets, key=len):
        one = frozenset(names)
        if not any(other <= one for _, other in kept):
            kept.append((names, one))
    return [names for names, _ in kept]


def _counter(
    solver: Solver, faults: Mapping[str, int], weights: Mapping[str, int], bound: int
) -> Sequence[int]:
    """Return literals of which number n holds if the rank is greater than n, for n <= bound.

    Source: Bailleux, Boufkhad, Efficient CNF encoding of Boolean cardinality constraints, CP 2003.
    """
    sums = [[literal] * min(weights[name], bound + 1) for name, literal in faults.items()]
    while len(sums) > 1:
        pairs = zip(sums[::2], sums[1::2], strict=False)
        rest = sums[-1:] if len(sums) % 2 else []
        sums = [_sum(solver, left, right, bound + 1) for left, right in pairs] + rest
    return sums[0][: bound + 1] if sums else []


def _sum(solver: Solver, left: Sequence[int], right: Sequence[int], most: int) -> list[int]:
    made = [solver.variable() for _ in range(min(len(left) + len(right), most))]
    for i in range(len(left) + 1):
        for j in range(len(right) + 1):
            if 0 < i + j <= len(made):
                reached = [-left[i - 1]] * (i > 0) + [-right[j - 1]] * (j > 0)
                solver.add([*reached, made[i + j - 1]])
    return made


def minimal_conflicts(
    solver: Solver, faults: Mapping[str, int], budget: Budget | None = None
) -> Iterator[list[str]]:
    """Yield the minimal sets of faults at least one of which must be there."""
    yield from (found for found in search_conflicts(solver, faults, budget) if found is not None)


def search_conflicts(
    solver: Solver, faults: Mapping[str, int], budget: Budget | None = None
) -> Iterator[list[str] | None]:
    """Yield the minimal conflicts, and None between them after each part of the search.

    Source: Liffiton, Previti, Malik, Marques-Silva, Fast, flexible MUS enumeration, Constraints
    21 (2016).
    """
    chart = Solver(budget)
    there = {name: chart.variable() for name in faults}  # assumed to be there
    names = {-literal: name for name, literal in faults.items()}
    while chart.solve():
        absent = [name for name in faults if not chart.model[there[name]]]
        if solver.solve([-faults[name] for name in absent]):
            most = _widened(solver, faults)
            chart.add([-there[name] for name in faults if name not in most])
            yield None
            continue
        conflict = _narrowed(solver, faults, [names[literal] for literal in solver.core])
        yield sorted(conflict)
        chart.add([there[name] for name in conflict])


def _widened(solver: Solver, faults: Mapping[str, int]) -> set[str]:
    """Return as many faults as can be absent together with those absent in the last model."""
    found = [name for name, literal in faults.items() if not solver.holds(literal)]
    while len(found) < len(faults):
        open_ = [name for name in faults if name not in {*found}]
        wanted = solver.variable()
        solver.add([-wanted, *(-faults[name] for name in open_)])
        can_be = solver.solve([wanted, *(-faults[name] for name in found)])
        found += [name for name in open_ if can_be and not solver.holds(faults[name])]
        solver.add([-wanted])
        if not can_be:
            break
    return set(found)


def _narrowed(solver: Solver, faults: Mapping[str, int], conflict: Sequence[str]) -> list[str]:
    """Return a part of a conflict from which nothing can be left out."""
    needed = list(conflict)
    for name in conflict:
        if name in needed and not solver.solve([-faults[n] for n in needed if n != name]):
            inner = {-literal for literal in solver.core}
            needed = [n for n in needed if faults[n] in inner]
    return needed
