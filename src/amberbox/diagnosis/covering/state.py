"""Sets of faults while the search builds them up."""

from __future__ import annotations

from typing import NamedTuple

from amberbox.diagnosis.covering.gates import bits
from amberbox.diagnosis.covering.problem import Problem, log


class State(NamedTuple):
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

    def members(self, group: int) -> int:
        """Return how many members of a group are faulty."""
        return next((count for number, count in self.counts if number == group), 0)


def nothing(problem: Problem) -> State:
    """Return the state without any fault."""
    return State((), (1.0,) * len(problem.clues), 0, 0, 0.0, 0.0)


def with_one_more(problem: Problem, state: State, number: int) -> State:
    """Return the state with one more member of a group faulty."""
    group, count = problem.groups[number], state.members(number)
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
