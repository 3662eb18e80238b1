"""Best-first search over sets of faults, the most probable first."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations, count
from typing import NamedTuple

from amberbox.core.contracts import Budget
from amberbox.diagnosis.covering.bounds import (
    GradedBounds,
    SearchBound,
    SearchBounds,
)
from amberbox.diagnosis.covering.problem import (
    NEVER,
    CoveringProblem,
    FaultCounts,
    ModeGroup,
    log_joint,
    log_likelihood,
    no_faults,
    with_one_more,
)

MOST_NODES = 2_000  # the most nodes that are opened by default (a few kB and 0.1 to 1 ms each)


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Sets of modes (by index) with their probabilities, from likely to unlikely.

    When a budget ended the search, they are the best that were reached: there may be better ones.

    Probabilities are shares of what was enumerated, ``covered`` is a lower bound of the share of
    this in all probability. ``incomplete`` names the budget that ended the search.
    """

    sets: tuple[tuple[tuple[int, ...], float], ...]
    covered: float
    incomplete: str
    opened: int


@dataclass(slots=True)
class _Sum:
    """A sum of exponentials, relative to a reference; it is updated continuously, and exact at the
    end.
    """

    reference: float
    terms: list[float] = field(default_factory=list)
    running: float = 0.0

    def add(self, log_value: float) -> None:
        value = _exp(log_value - self.reference)
        self.terms.append(value)
        self.running += value


class _Node(NamedTuple):
    state: FaultCounts
    closed: int
    bound: SearchBound


class _Members(NamedTuple):
    """The sets of one state that have not been returned yet, the best first.

    ``ways`` are (weight of the members chosen, their modes), ``log_base`` the remaining part of the
    score.
    """

    first: tuple[float, tuple[int, ...]]
    ways: Iterator[tuple[float, tuple[int, ...]]]
    log_base: float


_Entry = tuple[float, int, "_Node | _Members | FaultCounts"]


class _Search:
    """The heap of open nodes and sets, and the sets found so far."""

    def __init__(self, problem: CoveringProblem, most: int) -> None:
        self.problem = problem
        self.most = most
        self.order = count()
        self.heap: list[_Entry] = []
        self.bounds = (GradedBounds if problem.is_graded else SearchBounds)(problem)
        self.opened = 0
        self.found: list[tuple[tuple[int, ...], float]] = []
        start = no_faults(problem)
        first = self.bounds.beyond(start, 0)
        reference = max(log_likelihood(problem, start), first.log_best)
        self.reference = 0.0 if reference == NEVER else reference
        self.enumerated = _Sum(self.reference)
        self.listed = _Sum(self.reference)
        self.waiting = 0.0
        self.reach(start)
        self.push_node(_Node(start, 0, first))

    def push_node(self, node: _Node) -> None:
        """Push a node on the heap, unless it cannot lead to any set."""
        if node.bound.log_best > NEVER:
            self.waiting += _exp(node.bound.log_mass - self.reference)
            heapq.heappush(self.heap, (-node.bound.log_best, next(self.order), node))

    def reach(self, state: FaultCounts) -> None:
        """Count all sets of a state and push them on the heap."""
        likelihood = log_likelihood(self.problem, state)
        if likelihood == NEVER or state.log_best == NEVER:
            return
        likelihood += log_joint(self.problem, state)
        if likelihood == NEVER:
            return
        self.enumerated.add(state.log_sum + likelihood)
        heapq.heappush(self.heap, (-state.log_best - likelihood, next(self.order), state))

    def list_best(self, members: _Members) -> None:
        """List a set, and push the next one of its state on the heap."""
        score, modes = members.first
        self.found.append((modes, score + members.log_base))
        self.listed.add(score + members.log_base)
        following = next(members.ways, None)
        if following is not None:
            rest = _Members(following, members.ways, members.log_base)
            score = following[0] + members.log_base
            heapq.heappush(self.heap, (-score, next(self.order), rest))

    def step(self) -> None:
        """Pop the best entry: list it if it is a set of faults, split it if it is a node."""
        minus_score, _, best = heapq.heappop(self.heap)
        if isinstance(best, _Node):
            self.split(best)
        else:
            self.list_from(best, -minus_score)

    def list_from(self, best: FaultCounts | _Members, score: float) -> None:
        """List the best set of a state, or the next best."""
        if isinstance(best, FaultCounts):
            ways = _causal_paths(self.problem.groups, best.counts, self.most)
            first = next(ways)
            best = _Members(first, ways, score - first[0])
        self.list_best(best)

    def list_reached(self) -> None:
        """List the best sets reached so far, although open nodes may hold better ones."""
        nodes = [entry for entry in self.heap if isinstance(entry[2], _Node)]
        self.heap = [entry for entry in self.heap if not isinstance(entry[2], _Node)]
        heapq.heapify(self.heap)
        while self.heap and len(self.found) < self.most:
            self.step()
        self.heap += nodes

    def split(self, best: _Node) -> None:
        """Split a node: with one more member of the group to decide, and without."""
        self.opened += 1
        self.waiting -= _exp(best.bound.log_mass - self.reference)
        group = best.bound.branch
        more = with_one_more(self.problem, best.state, group)
        full = more.members(group) == self.problem.groups[group].most
        if more.log_best > NEVER:
            closed = best.closed | (1 << group if full else 0)
            self.reach(more)
            self.push_within(best.bound, more, closed | self.problem.excludes.get(group, 0))
        self.push_within(best.bound, best.state, best.closed | 1 << group)

    def push_within(self, outer: SearchBound, state: FaultCounts, closed: int) -> None:
        """Push a part of a node on the heap: bounds of the whole bound the part."""
        own = self.bounds.beyond(state, closed)
        log_best, log_mass = min(outer.log_best, own.log_best), min(outer.log_mass, own.log_mass)
        self.push_node(_Node(state, closed, SearchBound(log_best, log_mass, own.branch)))

    def exhausted(self, budget: Budget) -> str:
        """Return the budget that ends the search; empty if none does."""
        most = budget.most_nodes(MOST_NODES)
        if self.opened >= most and isinstance(self.heap[0][2], _Node):
            return f"more than {most:,} nodes"
        return "the time was up" if budget.is_over() else ""

    def share_listed(self) -> float:
        """Return the least share of everything that has been listed."""
        total = self.enumerated.running + max(0.0, self.waiting)
        return self.listed.running / total if total > 0 else 0.0

    def result(self, incomplete: str) -> SearchResult:
        """Return the sets that were found."""
        mass = math.fsum(self.enumerated.terms)
        nodes = (entry[2] for entry in self.heap)
        waiting = math.fsum(
            _exp(node.bound.log_mass - self.reference) for node in nodes if isinstance(node, _Node)
        )
        covered = mass / (mass + waiting) if mass > 0 and waiting < math.inf else 0.0
        sets = [
            (modes, _exp(score - self.reference) / mass) for modes, score in self.found if mass > 0
        ]
        return SearchResult(tuple(sets), covered, incomplete, self.opened)


def search(problem: CoveringProblem, max_sets: int, mass: float, budget: Budget) -> SearchResult:
    """Enumerate sets of faults until ``max_sets`` are listed or they hold ``mass`` of the
    probability.

    The budget is checked after each set; when it is used up, the best sets reached are listed.
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


def _causal_paths(
    groups: Sequence[ModeGroup], counts: Sequence[tuple[int, int]], most: int
) -> Iterator[_Way]:
    """Yield which members may be meant, at most ``most`` ways, the best first."""
    parts = [_members(groups[group], number, most) for group, number in counts]
    ways: list[_Way] = [(0.0, ())]
    for part in parts:
        products = [(a + b, left + right) for a, left in ways for b, right in part]
        ways = heapq.nsmallest(most, products, key=_best_first) if len(ways) > 1 else products
    yield from ways


def _members(group: ModeGroup, number: int, most: int) -> list[_Way]:
    """Return the best sets of ``number`` members: they are among the first members."""
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
