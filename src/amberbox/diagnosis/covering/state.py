"""Sets of faults while the search builds them up, and bounds on what can still come of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from amberbox.diagnosis.covering.gates import bits
from amberbox.diagnosis.covering.problem import NEVER, Problem, log


@dataclass(frozen=True, slots=True)
class State:
    """So many members of each group are faulty, and nothing else.

    ``misses[k]`` is q of clue k. ``log_best`` is the weight of the most probable choice of
    members, ``log_sum`` that of all choices; both with what the lost functions cost.
    """

    counts: tuple[tuple[int, int], ...]
    misses: tuple[float, ...]
    down: int
    lost: int
    log_best: float
    log_sum: float

    def count(self, group: int) -> int:
        """Return how many members of a group are faulty."""
        return next((count for number, count in self.counts if number == group), 0)


def nothing(problem: Problem) -> State:
    """Return the state without any fault."""
    return State((), (1.0,) * len(problem.clues), 0, 0, 0.0, 0.0)


def with_one_more(problem: Problem, state: State, number: int) -> State:
    """Return the state with one more member of a group faulty."""
    group, count = problem.groups[number], state.count(number)
    others = tuple(pair for pair in state.counts if pair[0] != number)
    misses = list(state.misses)
    for clue, miss in group.hits:
        misses[clue] *= miss
    down, lost, cost = state.down, state.lost, 0.0
    if group.component >= 0 and not down >> group.component & 1:
        down |= 1 << group.component
        lost = problem.gates.lost(down) & problem.relevant
        for function in bits(lost & ~state.lost):
            cost += problem.log_loss[function]
            for clue, miss in problem.function_hits.get(function, ()):
                misses[clue] *= miss
    more = group.log_sum(count + 1) - (group.log_sum(count) if count else 0.0)
    return State(
        (*others, (number, count + 1)),
        tuple(misses),
        down,
        lost,
        state.log_best + cost + group.log_weight(count),
        state.log_sum + cost + more,
    )


def log_likelihood(problem: Problem, state: State) -> float:
    """Return the logarithm of the product of all clues' likelihoods."""
    total = 0.0
    for clue, miss in zip(problem.clues, state.misses, strict=True):
        total += log(clue.alpha + clue.beta * miss)
    return total


class View:
    """What adding one more group costs while these functions are lost.

    ``bests`` and ``sums`` bound, per group, the weight of its best member and of all members,
    with what the functions cost that this member alone would lose.
    """

    __slots__ = ("bests", "order", "sums", "total")

    def __init__(self, problem: Problem, lost: int) -> None:
        losses = problem.log_losses(lost)
        self.bests: list[float] = (problem.log_bests + losses).tolist()
        sums = np.exp(problem.log_sums + losses)
        self.sums: list[float] = sums.tolist()
        self.total = float(sums.sum())
        self.order = np.argsort(-(problem.log_bests + losses), kind="stable").tolist()


@dataclass(frozen=True, slots=True)
class Bound:
    """What the sets beyond a state can reach at most.

    ``log_best`` is the logarithm of the best set's weight, ``log_mass`` that of all together.
    ``branch`` is the group to decide next, -1 when none is open.
    """

    log_best: float
    log_mass: float
    branch: int


DEAD = Bound(NEVER, NEVER, -1)


def bound(problem: Problem, state: State, closed: int, view: View) -> Bound:
    """Bound all sets that add one or more members of groups that are not closed.

    Each clue that is not explained yet gives a bound of its own: either one of its causes is
    added, or none is and its likelihood stays as it is. The tightest counts.
    """
    best_open = next((group for group in view.order if not closed >> group & 1), -1)
    if best_open < 0:
        return DEAD
    now, most = _likelihoods(problem, state, closed)
    top = sum(map(log, most))
    if top == NEVER:
        return DEAD
    left = max(0.0, view.total - sum(view.sums[group] for group in bits(closed)))
    result = Bound(top + view.bests[best_open], top + log(left), best_open)
    for clue, (value, limit) in enumerate(zip(now, most, strict=True)):
        if value < 0.5 * limit:
            tighter = _through(problem, clue, closed, view, (value / limit, left, best_open))
            if tighter.log_best + top < result.log_best:
                mass = min(result.log_mass, tighter.log_mass + top)
                result = Bound(tighter.log_best + top, mass, tighter.branch)
    return Bound(
        result.log_best + state.log_best + problem.log_odd,
        result.log_mass + state.log_sum + problem.log_all,
        result.branch,
    )


def _likelihoods(problem: Problem, state: State, closed: int) -> tuple[list[float], list[float]]:
    """Return each clue's likelihood now, and the most that open groups can make of it."""
    now, most = [], []
    for place, clue in enumerate(problem.clues):
        value = clue.alpha + clue.beta * state.misses[place]
        can_rise = clue.beta < 0 and problem.cause_masks[place] & ~closed
        now.append(value)
        most.append(clue.alpha + clue.beta * problem.least[place] if can_rise else value)
    return now, most


def _through(
    problem: Problem, clue: int, closed: int, view: View, without: tuple[float, float, int]
) -> Bound:
    """Bound by one clue: a cause of it is added, or its likelihood stays at ``share``."""
    share, left, best_open = without
    branch, log_best, mass = -1, NEVER, 0.0
    for group in problem.causes[clue]:
        if not closed >> group & 1:
            mass += view.sums[group]
            if view.bests[group] > log_best or branch < 0:
                branch, log_best = group, view.bests[group]
    log_best = max(log_best, log(share) + view.bests[best_open])
    return Bound(log_best, log(mass + share * left), branch)


def expm(value: float) -> float:
    """Return the exponential, infinity beyond what a number holds."""
    return math.exp(value) if value < 700 else math.inf
