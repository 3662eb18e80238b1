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
        state.log_best + cost + group.weights[count],
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

    __slots__ = ("_causes", "_problem", "bests", "order", "sums", "total")

    def __init__(self, problem: Problem, lost: int) -> None:
        losses = problem.log_losses(lost)
        bests = problem.log_bests + losses
        sums = np.exp(problem.log_sums + losses)
        self.bests: list[float] = bests.tolist()
        self.sums: list[float] = sums.tolist()
        self.total = float(sums.sum())
        self.order: list[int] = np.argsort(-bests, kind="stable").tolist()
        self._problem = problem
        self._causes: dict[int, tuple[int, float]] = {}

    def causes(self, clue: int, closed: int) -> tuple[int, float]:
        """Return the best open cause of a clue (there is one), and the sum over all of them."""
        if closed & self._problem.cause_masks[clue]:
            return self._open_causes(clue, closed)
        if clue not in self._causes:
            self._causes[clue] = self._open_causes(clue, 0)
        return self._causes[clue]

    def _open_causes(self, clue: int, closed: int) -> tuple[int, float]:
        groups = [group for group in self._problem.causes[clue] if not closed >> group & 1]
        return max(groups, key=self.bests.__getitem__), sum(self.sums[group] for group in groups)


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
    top, unexplained = _limits(problem, state, closed)
    if best_open < 0 or top == NEVER:
        return DEAD
    left = max(0.0, view.total - sum(view.sums[group] for group in bits(closed)))
    branch, log_best, mass = best_open, view.bests[best_open], left
    for clue, share in unexplained:
        cause, weight = view.causes(clue, closed)
        tighter = max(view.bests[cause], log(share) + view.bests[best_open])
        mass = min(mass, weight + share * left)
        if tighter < log_best:
            branch, log_best = cause, tighter
    return Bound(
        log_best + top + state.log_best + problem.log_odd,
        log(mass) + top + state.log_sum + problem.log_all,
        branch,
    )


def _limits(problem: Problem, state: State, closed: int) -> tuple[float, list[tuple[int, float]]]:
    """Return the most that open groups can make of all clues, as a logarithm.

    With it come the clues that are not explained yet, each with the share of its limit that it
    has now.
    """
    top = 0.0
    unexplained = []
    for place, clue in enumerate(problem.clues):
        value = clue.alpha + clue.beta * state.misses[place]
        limit = problem.limits[place]
        if clue.beta < 0 and problem.cause_masks[place] & ~closed:
            top += problem.log_limits[place]
            if value < 0.5 * limit:
                unexplained.append((place, value / limit))
        else:
            top += log(value)
    return top, unexplained


def expm(value: float) -> float:
    """Return the exponential, infinity beyond what a number holds."""
    return math.exp(value) if value < 700 else math.inf
