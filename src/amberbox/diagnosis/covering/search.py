"""Best first over sets of faults: the most probable come first, what is left out is bounded.

A node stands for all proper supersets of a set, made from groups that are still open. Opening
it picks a group of a clue that is not explained yet and splits: one more member of the group is
faulty, or no more of them. Every set is reached exactly once.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations, count
from typing import NamedTuple

from amberbox.diagnosis.covering.bounds import Bound, Bounds
from amberbox.diagnosis.covering.budget import Budget
from amberbox.diagnosis.covering.problem import NEVER, Group, Problem
from amberbox.diagnosis.covering.state import (
    State,
    log_likelihood,
    nothing,
    with_one_more,
)


@dataclass(frozen=True, slots=True)
class Found:
    """Sets of modes (by place) with their probabilities, from likely to unlikely.

    When a budget ended the search, they are the best that were reached: better ones may wait.

    Probabilities are shares of what was enumerated, ``covered`` is the least share that this
    is of everything. ``incomplete`` says which budget ended the search.
    """

    sets: tuple[tuple[tuple[int, ...], float], ...]
    covered: float
    incomplete: str
    opened: int


@dataclass(slots=True)
class _Sum:
    """A sum of exponentials, relative to a reference; exact at the end, running meanwhile."""

    reference: float
    terms: list[float] = field(default_factory=list)
    running: float = 0.0

    def add(self, log_value: float) -> None:
        value = _exp(log_value - self.reference)
        self.terms.append(value)
        self.running += value


class _Node(NamedTuple):
    state: State
    closed: int
    bound: Bound


class _Members(NamedTuple):
    """The sets of one state that have not come up yet, the best first.

    ``ways`` are (weight of the members chosen, their modes), ``log_base`` the rest of the score.
    """

    first: tuple[float, tuple[int, ...]]
    ways: Iterator[tuple[float, tuple[int, ...]]]
    log_base: float


_Entry = tuple[float, int, "_Node | _Members | State"]


class _Search:
    """The heap of nodes and sets that wait, and what has been found."""

    def __init__(self, problem: Problem, most: int) -> None:
        self.problem = problem
        self.most = most
        self.order = count()
        self.heap: list[_Entry] = []
        self.bounds = Bounds(problem)
        self.opened = 0
        self.found: list[tuple[tuple[int, ...], float]] = []
        start = nothing(problem)
        first = self.bounds.beyond(start, 0)
        reference = max(log_likelihood(problem, start), first.log_best)
        self.reference = 0.0 if reference == NEVER else reference
        self.enumerated = _Sum(self.reference)
        self.listed = _Sum(self.reference)
        self.waiting = 0.0
        self.reach(start)
        self.push_node(_Node(start, 0, first))

    def push_node(self, node: _Node) -> None:
        """Let a node wait, unless nothing can come of it."""
        if node.bound.log_best > NEVER:
            self.waiting += _exp(node.bound.log_mass - self.reference)
            heapq.heappush(self.heap, (-node.bound.log_best, next(self.order), node))

    def reach(self, state: State) -> None:
        """Count all sets of a state and let them wait."""
        likelihood = log_likelihood(self.problem, state)
        if likelihood == NEVER or state.log_best == NEVER:
            return
        self.enumerated.add(state.log_sum + likelihood)
        heapq.heappush(self.heap, (-state.log_best - likelihood, next(self.order), state))

    def list_best(self, members: _Members) -> None:
        """List a set, and let the next one of its state wait."""
        score, modes = members.first
        self.found.append((modes, score + members.log_base))
        self.listed.add(score + members.log_base)
        following = next(members.ways, None)
        if following is not None:
            rest = _Members(following, members.ways, members.log_base)
            score = following[0] + members.log_base
            heapq.heappush(self.heap, (-score, next(self.order), rest))

    def step(self) -> None:
        """Take what is best: list it if it is a set of faults, split it if it is a node."""
        minus_score, _, best = heapq.heappop(self.heap)
        if isinstance(best, _Node):
            self.split(best)
        else:
            self.list_from(best, -minus_score)

    def list_from(self, best: State | _Members, score: float) -> None:
        """List the best set of a state, or the next best."""
        if isinstance(best, State):
            ways = _ways(self.problem.groups, best.counts, self.most)
            first = next(ways)
            best = _Members(first, ways, score - first[0])
        self.list_best(best)

    def list_reached(self) -> None:
        """List the best of what was reached, though nodes that wait may hold better."""
        nodes = [entry for entry in self.heap if isinstance(entry[2], _Node)]
        self.heap = [entry for entry in self.heap if not isinstance(entry[2], _Node)]
        heapq.heapify(self.heap)
        while self.heap and len(self.found) < self.most:
            self.step()
        self.heap += nodes

    def split(self, best: _Node) -> None:
        """Add one more member of the group to decide, and do not."""
        self.opened += 1
        self.waiting -= _exp(best.bound.log_mass - self.reference)
        group = best.bound.branch
        more = with_one_more(self.problem, best.state, group)
        full = more.members(group) == len(self.problem.groups[group])
        if more.log_best > NEVER:
            self.reach(more)
            self.push_within(best.bound, more, best.closed | (1 << group if full else 0))
        self.push_within(best.bound, best.state, best.closed | 1 << group)

    def push_within(self, outer: Bound, state: State, closed: int) -> None:
        """Let a part of a node wait: what bounds the whole bounds the part."""
        own = self.bounds.beyond(state, closed)
        log_best, log_mass = min(outer.log_best, own.log_best), min(outer.log_mass, own.log_mass)
        self.push_node(_Node(state, closed, Bound(log_best, log_mass, own.branch)))

    def exhausted(self, budget: Budget) -> str:
        """Say which budget keeps the search from taking what is best, if one does."""
        if self.opened >= budget.nodes and isinstance(self.heap[0][2], _Node):
            return f"more than {budget.nodes:,} nodes"
        return "the time was up" if budget.deadline() else ""

    def share_listed(self) -> float:
        """Return the least share of everything that has been listed."""
        total = self.enumerated.running + max(0.0, self.waiting)
        return self.listed.running / total if total > 0 else 0.0

    def result(self, incomplete: str) -> Found:
        """Return what was found."""
        mass = math.fsum(self.enumerated.terms)
        nodes = (entry[2] for entry in self.heap)
        waiting = math.fsum(
            _exp(node.bound.log_mass - self.reference) for node in nodes if isinstance(node, _Node)
        )
        covered = mass / (mass + waiting) if mass > 0 and waiting < math.inf else 0.0
        sets = [
            (modes, _exp(score - self.reference) / mass) for modes, score in self.found if mass > 0
        ]
        return Found(tuple(sets), covered, incomplete, self.opened)


def search(problem: Problem, max_sets: int, mass: float, budget: Budget) -> Found:
    """Enumerate sets of faults until so many are listed or they hold so much of the mass.

    Set by set is asked whether a budget is used up; then the best that were reached are listed.
    """
    running = _Search(problem, max_sets)
    incomplete = ""
    while running.heap and len(running.found) < max_sets and running.share_listed() < mass:
        incomplete = running.exhausted(budget)
        if incomplete:
            running.list_reached()
            break
        running.step()
    return running.result(incomplete)


_Way = tuple[float, tuple[int, ...]]


def _ways(groups: Sequence[Group], counts: Sequence[tuple[int, int]], most: int) -> Iterator[_Way]:
    """Yield which members may be meant, at most ``most`` ways, the best first."""
    parts = [_members(groups[group], number, most) for group, number in counts]
    ways: list[_Way] = [(0.0, ())]
    for part in parts:
        products = [(a + b, left + right) for a, left in ways for b, right in part]
        ways = heapq.nsmallest(most, products, key=_best_first) if len(ways) > 1 else products
    yield from ways


def _members(group: Group, number: int, most: int) -> list[_Way]:
    """Return the best sets of so many members: they are among the first members."""
    places = range(min(len(group), number + most - 1))
    if number == 1:
        return [(group.weights[place], (group.modes[place],)) for place in places]
    ways = (
        (sum(group.weights[place] for place in chosen), tuple(group.modes[p] for p in chosen))
        for chosen in combinations(places, number)
    )
    return heapq.nsmallest(most, ways, key=_best_first)


def _best_first(way: _Way) -> tuple[float, tuple[int, ...]]:
    return (-way[0], way[1])


def _exp(log_value: float) -> float:
    return math.exp(log_value) if log_value < 700 else math.inf
