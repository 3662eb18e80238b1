"""Which further sensors would let more faults be detected and told apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from amberbox.core.contracts import Budget
from amberbox.core.equations.structure import Structure, bits
from amberbox.diagnosis.structure.isolability import ENDLESS, detectable, isolability


def with_sensors(model: Structure, measured: int, *, may_fail: bool) -> Structure:
    """Return the model with a sensor for each of these unknowns, and its fault if it may fail."""
    names = [f"sensor of {model.unknowns[unknown]}" for unknown in bits(measured)]
    first = len(model.equations)
    faults = names if may_fail else []
    return replace(
        model,
        equations=[*model.equations, *names],
        variables=[*model.variables, *(1 << unknown for unknown in bits(measured))],
        faults=[*model.faults, *faults],
        shown_in=[*model.shown_in, *(1 << first + number for number in range(len(faults)))],
    )


def sensor_sets(
    model: Structure, measurable: int, *, may_fail: bool = False, budget: Budget = ENDLESS
) -> Iterator[int]:
    """Yield the minimal sets of unknowns to measure, as masks, smallest first.

    With each, every fault of the model is detected, and told from every other one, as well as
    with sensors for all that is ``measurable``. With sensors that ``may_fail``, it must also be
    told from the faults of those that are in the set. Raises OutOfTimeError.
    """
    best, _ = _shown(model, measurable, may_fail, budget)

    def suffices(measured: int) -> bool:
        shown, possible = _shown(model, measured, may_fail, budget)
        return all(pair in shown for pair in best if pair[1] in possible)

    return minimal_sets(measurable, suffices)


def _shown(
    model: Structure, measured: int, may_fail: bool, budget: Budget
) -> tuple[set[tuple[int, str]], set[str]]:
    """Return each fault of the model with what it is told from, and what it can be told from.

    That is the name of another fault, or "" for no fault at all.
    """
    budget.check()
    extended = with_sensors(model, measured, may_fail=may_fail)
    found = detectable(extended)
    hidden = isolability(extended, budget=budget)
    shown = set()
    for fault in range(len(model.faults)):
        if found >> fault & 1:
            shown.add((fault, ""))
        names = enumerate(extended.faults)
        shown |= {(fault, name) for number, name in names if not hidden[fault][number]}
    return shown, {"", *extended.faults}


def minimal_sets(candidates: int, suffices: Callable[[int], bool]) -> Iterator[int]:
    """Yield the minimal sufficient sets of candidates, as masks, smallest first.

    More candidates never make a set insufficient. Each set that is not sufficient is made as
    large as it can be: every sufficient one then has something that this one lacks.

    Source: Reiter, A theory of diagnosis from first principles, Artificial Intelligence 32 (1987).
    """
    if not suffices(candidates):
        return
    found: list[int] = []
    lacks: list[int] = []  # what a set that is not sufficient lacks
    waiting: dict[int, None] = {0: None}
    while waiting:
        wider: dict[int, None] = {}
        for chosen in waiting:
            if any(known & chosen == known for known in found):
                continue
            lack = next((lack for lack in lacks if not lack & chosen), 0)
            if not lack and suffices(chosen):
                found.append(chosen)
                yield chosen
                continue
            if not lack:
                lack = candidates & ~_largest_insufficient(candidates, chosen, suffices)
                lacks.append(lack)
            wider |= dict.fromkeys(chosen | 1 << number for number in bits(lack))
        waiting = wider


def _largest_insufficient(candidates: int, chosen: int, suffices: Callable[[int], bool]) -> int:
    for number in bits(candidates & ~chosen):
        if not suffices(chosen | 1 << number):
            chosen |= 1 << number
    return chosen
