"""Bounds on what can still come of a set of faults when more are added; they never lie low.

Three facts carry them. The likelihood of a present symptom only rises with more causes, up to a
known limit. Lost functions cost what their absent symptoms say, once: a set pays at least what
any one of its members would. The sum over all subsets of groups of the product of their weights
is the product of 1 + weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from operator import mul
from typing import NamedTuple

import numpy as np

from amberbox.diagnosis.covering.gates import bits
from amberbox.diagnosis.covering.problem import NEVER, Problem, log
from amberbox.diagnosis.covering.state import State
from amberbox.diagnosis.covering.tables import Floats

LARGEST_EXPONENT = 700.0

FAR = 0.5
"""A clue with less than this share of its limit is not explained yet."""

SMALLEST = -1000.0
"""The logarithm of the least share that a clue counts with: gains must stay finite."""


class Bound(NamedTuple):
    """What the sets beyond a state can reach at most.

    ``log_best`` is the logarithm of the best set's weight, ``log_mass`` that of all together.
    ``branch`` is the group to decide next, -1 when none is open.
    """

    log_best: float
    log_mass: float
    branch: int


DEAD = Bound(NEVER, NEVER, -1)


class Causes(NamedTuple):
    """The open causes of a clue; equal ones have the same number."""

    number: int
    groups: Sequence[int]


class View:
    """What adding one more group weighs while certain functions are lost.

    ``bests`` (logarithms) and ``sums`` bound, per group, the weight of its best member and of
    all members, with what the functions cost that this member alone would lose.
    """

    __slots__ = ("_known", "_order", "bests", "sums", "total")

    def __init__(self, log_bests: Floats, log_sums: Floats) -> None:
        self.bests: list[float] = log_bests.tolist()
        self.sums: list[float] = np.exp(log_sums).tolist()
        self.total = sum(self.sums)
        self._order: list[int] | None = None
        self._known: dict[int, tuple[float, float]] = {}

    def of(self, causes: Causes) -> tuple[float, float]:
        """Return the logarithm of the best weight among causes, and the sum of all."""
        known = self._known.get(causes.number)
        if known is None:
            best = max([self.bests[group] for group in causes.groups], default=NEVER)
            known = best, sum([self.sums[group] for group in causes.groups])
            self._known[causes.number] = known
        return known

    def unrelated(self, hidden: int, log_share: float) -> Bound:
        """Bound the sets of groups that are not hidden; they change no likelihood."""
        if self._order is None:
            self._order = sorted(range(len(self.bests)), key=self.bests.__getitem__, reverse=True)
        branch = next((group for group in self._order if not hidden >> group & 1), -1)
        if branch < 0:
            return DEAD
        left = self.total - sum(self.sums[group] for group in bits(hidden))
        # What is left of a difference may be a little less than its best member.
        mass = max(log(left), self.bests[branch]) + log_share
        return Bound(self.bests[branch] + log_share, mass, branch)


class Unexplained(NamedTuple):
    """A clue far from its limit: the share of it that it has now, and its open causes."""

    clue: int
    share: float
    log_share: float
    causes: Causes


class Bounds:
    """Bounds for one problem; remembers what weighs how much while which functions are lost."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._views: dict[int, View] = {}
        self._free = View(problem.log_bests, problem.log_sums)
        self._open: dict[tuple[int, int], Causes] = {}

    def beyond(self, state: State, closed: int) -> Bound:
        """Bound all sets that add one or more members of groups that are not closed.

        Such a set has no cause of any clue that is not explained yet, then their likelihoods
        stay; or it has one, then several bounds hold and the tightest counts.
        """
        problem, view = self._problem, self._view(state.lost)
        top, clues = self._limits(state, closed)
        if top == NEVER:
            return DEAD
        hidden, log_share = closed, 0.0
        for clue in clues:
            hidden |= problem.cause_masks[clue.clue]
            log_share += clue.log_share
        best = view.unrelated(hidden, log_share)
        if clues:
            best = _either(best, self._explaining(state, closed, clues))
        return Bound(
            best.log_best + top + state.log_best + problem.log_odd,
            best.log_mass + top + state.log_sum + problem.log_all,
            best.branch,
        )

    def _view(self, lost: int) -> View:
        if lost not in self._views:
            problem = self._problem
            losses = problem.log_losses(lost)
            self._views[lost] = View(problem.log_bests + losses, problem.log_sums + losses)
        return self._views[lost]

    def _limits(self, state: State, closed: int) -> tuple[float, list[Unexplained]]:
        """Return the most that open groups make of all clues, and those far from their limit."""
        problem, top = self._problem, 0.0
        clues = []
        for place, clue in enumerate(problem.clues):
            value = clue.alpha + clue.beta * state.misses[place]
            mask = problem.cause_masks[place]
            if clue.beta < 0 and mask & ~closed:
                top += problem.log_limits[place]
                share = value / problem.limits[place]
                if share < FAR:
                    causes = self._open_causes(place, closed)
                    clues.append(Unexplained(place, share, max(SMALLEST, log(share)), causes))
            else:
                top += log(value)
        return top, clues

    def _open_causes(self, clue: int, closed: int) -> Causes:
        key = (clue, closed & self._problem.cause_masks[clue])
        known = self._open.get(key)
        if known is None:
            groups = [group for group in self._problem.causes[clue] if not closed >> group & 1]
            known = self._open[key] = Causes(len(self._open), groups)
        return known

    def _explaining(self, state: State, closed: int, clues: list[Unexplained]) -> Bound:
        """Bound the sets that have a cause of clues that are not explained yet.

        Each clue gives a bound of its own: either one of its causes is added, or none is and
        its likelihood stays as it is. So do clues without common causes together, and so do
        the gains of all that may be added, as if no two of them explained the same clue.
        """
        view = self._view(state.lost)
        gains: dict[int, float] = {}
        for clue in clues:
            for group in clue.causes.groups:
                gains[group] = gains.get(group, 0.0) - clue.log_share
        best = max(view.bests[group] for group in gains)
        left = sum(view.sums[group] for group in gains)
        tightest, among, mass = math.inf, None, left
        order: list[tuple[float, Unexplained]] = []
        for clue in clues:
            cause, weight = view.of(clue.causes)
            without = clue.log_share + best
            mass = min(mass, weight + clue.share * left)
            order.append((max(cause, without), clue))
            if order[-1][0] < tightest:
                tightest, among = order[-1][0], clue.causes.groups if cause >= without else None
        net = {group: view.bests[group] + gain for group, gain in gains.items()}
        result = Bound(tightest, log(mass), max(among or net, key=net.__getitem__))
        if len(clues) == 1:
            return result
        order.sort(key=_tightest_first)
        gained = self._gained(view, clues, gains, net)
        apart = self._together(state, closed, [clue for _, clue in order], (best, left))
        return Bound(
            min(result.log_best, gained.log_best, apart.log_best),
            min(result.log_mass, gained.log_mass, apart.log_mass),
            gained.branch if gained.log_best < result.log_best else result.branch,
        )

    def _gained(
        self,
        view: View,
        clues: list[Unexplained],
        gains: Mapping[int, float],
        net: Mapping[int, float],
    ) -> Bound:
        """Bound by gains: what each group can make of all clues, whatever others make of them."""
        log_share = sum(clue.log_share for clue in clues)
        branch = max(net, key=net.__getitem__)
        rising = log_sum = others = 0.0
        for group, gain in gains.items():
            rising += max(0.0, self._free.bests[group] + gain)
            factor = math.exp(min(LARGEST_EXPONENT, gain))
            log_sum += view.sums[group] * factor
            others += math.log1p(self._free.sums[group] * factor)
        log_best = rising if rising > 0 else net[branch]
        if max(gains.values()) > LARGEST_EXPONENT:
            return Bound(log_best + log_share, math.inf, branch)
        return Bound(log_best + log_share, log(log_sum) + others + log_share, branch)

    def _together(
        self, state: State, closed: int, clues: list[Unexplained], rest: tuple[float, float]
    ) -> Bound:
        """Bound by clues that have no open cause in common but the unknown mode.

        Either the unknown mode is not added: then each clue needs a cause of its own or stays;
        what functions cost is charged for one member only. Or it is: then each clue has at
        least the share that the unknown mode gives it.
        """
        problem, unknown = self._problem, self._problem.unknown
        may_be_unknown = unknown >= 0 and not closed >> unknown & 1
        hidden = closed | (1 << unknown if may_be_unknown else 0)
        chosen, seen = [], 0
        for clue in clues:
            mask = problem.cause_masks[clue.clue] & ~hidden
            if not mask & seen:
                chosen.append(clue)
                seen |= mask
        causes = [self._open_causes(clue.clue, hidden) for clue in chosen]
        free = [self._free.of(of) for of in causes]
        charged = self._view(state.lost).of(causes[0])
        log_best, mass = _apart([clue.share for clue in chosen], charged, free, rest)
        if may_be_unknown:
            best, more = self._with_unknown(state, [clue.clue for clue in chosen], free)
            log_best, mass = max(log_best, best), mass + more
        return Bound(log_best, log(mass), -1)

    def _with_unknown(
        self, state: State, places: list[int], free: list[tuple[float, float]]
    ) -> tuple[float, float]:
        problem = self._problem
        group = problem.groups[problem.unknown]
        shows = dict(group.hits)
        log_best, mass = group.log_best, math.exp(min(LARGEST_EXPONENT, group.log_best))
        for place, (best, weight) in zip(places, free, strict=True):
            clue = problem.clues[place]
            miss = state.misses[place] * shows.get(place, 1.0)
            share = (clue.alpha + clue.beta * miss) / problem.limits[place]
            log_best += max(log(share), best)
            mass *= share + weight
        return log_best, mass


def _either(left: Bound, right: Bound) -> Bound:
    better = left if left.log_best >= right.log_best else right
    high, low = max(left.log_mass, right.log_mass), min(left.log_mass, right.log_mass)
    mass = high if low == NEVER else high + math.log1p(math.exp(low - high))
    return Bound(better.log_best, mass, better.branch)


def _tightest_first(tightness: tuple[float, Unexplained]) -> float:
    return tightness[0]


def _apart(
    shares: list[float],
    charged: tuple[float, float],
    free: list[tuple[float, float]],
    rest: tuple[float, float],
) -> tuple[float, float]:
    """Bound clues without common causes: the first is charged what its functions cost."""
    best_open, left = rest
    weights = [charged, *free[1:]]
    pairs = [(log(share), best) for share, (best, _) in zip(shares, weights, strict=True)]
    log_best = sum(max(pair) for pair in pairs)
    if all(best <= log_share for log_share, best in pairs):
        # No cause is better than none, but something is added.
        log_best += min(0.0, max(best_open, *(best - share for share, best in pairs)))
    before = list(accumulate(shares, mul, initial=1.0))
    mass, after = 0.0, 1.0
    for place in range(len(shares) - 1, -1, -1):
        mass += before[place] * free[place][1] * after
        after *= shares[place] + free[place][1]
    return log_best, mass + before[-1] * left
