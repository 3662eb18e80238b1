"""Bounds on what can still come of a set of faults when more are added; they never lie low.

Three facts carry them. Likelihoods of present symptoms only rise with more causes, up to a known
limit. Lost functions cost what their absent symptoms say, once: a set pays at least what any one
of its members would. The sum over all subsets of groups of the product of their weights is the
product of 1 + weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from operator import mul

import numpy as np

from amberbox.diagnosis.covering.gates import bits
from amberbox.diagnosis.covering.problem import NEVER, Problem, log
from amberbox.diagnosis.covering.state import State


class View:
    """What adding one more group weighs while these functions are lost.

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
        self._causes: dict[tuple[int, int], tuple[int, float]] = {}

    def causes(self, clue: int, closed: int) -> tuple[int, float]:
        """Return the best open cause of a clue, -1 for none, and the sum over all of them."""
        key = (clue, closed & self._problem.cause_masks[clue])
        known = self._causes.get(key)
        if known is None:
            known = self._causes[key] = self._open_causes(clue, closed)
        return known

    def best_open(self, closed: int) -> int:
        """Return the group that is not closed and whose best member weighs most, -1 for none."""
        return next((group for group in self.order if not closed >> group & 1), -1)

    def _open_causes(self, clue: int, closed: int) -> tuple[int, float]:
        groups = [group for group in self._problem.causes[clue] if not closed >> group & 1]
        if not groups:
            return -1, 0.0
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


@dataclass(frozen=True, slots=True)
class Open:
    """A clue that is not explained yet: the share of its limit that it has now."""

    clue: int
    share: float


class Bounds:
    """Bounds for one problem; remembers what weighs how much while which functions are lost."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._views: dict[int, View] = {}

    def view(self, lost: int) -> View:
        """Return the weights while these functions are lost."""
        if lost not in self._views:
            self._views[lost] = View(self._problem, lost)
        return self._views[lost]

    def beyond(self, state: State, closed: int) -> Bound:
        """Bound all sets that add one or more members of groups that are not closed.

        Such a set has no cause of any clue that is not explained yet, then their likelihoods
        stay; or it has one, then each of these clues bounds it.
        """
        problem, view = self._problem, self.view(state.lost)
        top, clues = self._limits(state, closed)
        if top == NEVER:
            return DEAD
        causes = closed
        for clue in clues:
            causes |= problem.cause_masks[clue.clue]
        left = max(0.0, view.total - sum(view.sums[group] for group in bits(causes)))
        group = view.best_open(causes)
        share = math.prod(clue.share for clue in clues)
        here = Bound(log(share) + view.bests[group], log(share * left), group) if group >= 0 else DEAD
        with_cause = self._explaining(state, closed, clues, causes & ~closed) if clues else DEAD
        best = here if here.log_best >= with_cause.log_best else with_cause
        return Bound(
            best.log_best + top + state.log_best + problem.log_odd,
            _log_add(here.log_mass, with_cause.log_mass) + top + state.log_sum + problem.log_all,
            best.branch,
        )

    def _explaining(self, state: State, closed: int, clues: list[Open], causes: int) -> Bound:
        """Bound the sets that have one of these causes of clues that are not explained yet.

        Each clue gives a bound of its own: either one of its causes is added, or none is and
        its likelihood stays as it is. Clues without common causes are bounded together. The
        tightest counts.
        """
        view = self.view(state.lost)
        best_cause = view.best_open(~causes)
        left = sum(view.sums[group] for group in bits(causes))
        branch, log_best, mass = best_cause, view.bests[best_cause], left
        tightness: list[tuple[float, Open]] = []
        for clue in clues:
            cause, weight = view.causes(clue.clue, closed)
            without = log(clue.share) + view.bests[best_cause]
            tighter = max(view.bests[cause], without)
            tightness.append((tighter, clue))
            mass = min(mass, weight + clue.share * left)
            if tighter < log_best:
                branch, log_best = cause if tighter > without else best_cause, tighter
        if len(clues) > 1:
            tightness.sort(key=_tightest_first)
            ordered = [clue for _, clue in tightness]
            together = self._together(state, closed, ordered, (view.bests[best_cause], left))
            log_best, mass = min(log_best, together[0]), min(mass, together[1])
        return Bound(log_best, log(mass), branch)

    def _limits(self, state: State, closed: int) -> tuple[float, list[Open]]:
        """Return the most that open groups make of all clues, and those far from their limit."""
        problem, top = self._problem, 0.0
        clues = []
        for place, clue in enumerate(problem.clues):
            value = clue.alpha + clue.beta * state.misses[place]
            limit = problem.limits[place]
            if clue.beta < 0 and problem.cause_masks[place] & ~closed:
                top += problem.log_limits[place]
                if value < 0.5 * limit:
                    clues.append(Open(place, value / limit))
            else:
                top += log(value)
        return top, clues

    def _together(
        self, state: State, closed: int, clues: list[Open], rest: tuple[float, float]
    ) -> tuple[float, float]:
        """Bound by clues that have no open cause in common but the unknown mode.

        Either the unknown mode is not added: then each clue needs a cause of its own or stays;
        what functions cost is charged for one member only. Or it is: then each clue has at
        least the share that the unknown mode gives it. Returns (log of the best, mass).
        """
        problem, unknown = self._problem, self._problem.unknown
        may_be_unknown = unknown >= 0 and not closed >> unknown & 1
        taken = closed | (1 << unknown if may_be_unknown else 0)
        chosen, seen = [], taken
        for clue in clues:
            mask = problem.cause_masks[clue.clue] & ~taken
            if not mask & seen & ~taken:
                chosen.append(clue)
                seen |= mask
        log_best, mass = self._apart(state, taken, chosen, rest)
        if may_be_unknown:
            best, more = self._with_unknown(state, taken, chosen)
            log_best, mass = max(log_best, best), mass + more
        return log_best, mass

    def _apart(
        self, state: State, closed: int, clues: list[Open], rest: tuple[float, float]
    ) -> tuple[float, float]:
        view, free = self.view(state.lost), self.view(self._problem.relevant)
        best_open, left = rest
        log_shares = [log(clue.share) for clue in clues]
        charged = [_weights(view, clue, closed) for clue in clues]
        uncharged = [_weights(free, clue, closed) for clue in clues]
        log_best = max(log_shares[0], charged[0][0])
        for log_share, (best, _) in zip(log_shares[1:], uncharged[1:], strict=True):
            log_best += max(log_share, best)
        if charged[0][0] <= log_shares[0] and all(
            best <= share for share, (best, _) in zip(log_shares[1:], uncharged[1:], strict=True)
        ):  # no cause is better than none, but something is added
            steps = [best - share for share, (best, _) in zip(log_shares, uncharged, strict=True)]
            log_best += min(0.0, max(best_open, *steps))
        shares = [clue.share for clue in clues]
        before = list(accumulate(shares, mul, initial=1.0))
        mass, after = 0.0, 1.0
        for place in range(len(clues) - 1, -1, -1):
            mass += before[place] * charged[place][1] * after
            after *= shares[place] + uncharged[place][1]
        return log_best, mass + before[-1] * left

    def _with_unknown(self, state: State, closed: int, clues: list[Open]) -> tuple[float, float]:
        problem, free = self._problem, self.view(self._problem.relevant)
        unknown = problem.groups[problem.unknown]
        shows = dict(unknown.hits)
        log_best, mass = unknown.log_best, math.exp(min(700.0, unknown.log_best))
        for clue in clues:
            of, limit = problem.clues[clue.clue], problem.limits[clue.clue]
            miss = state.misses[clue.clue] * shows.get(clue.clue, 1.0)
            share = (of.alpha + of.beta * miss) / limit
            best, weight = _weights(free, clue, closed)
            log_best += max(log(share), best)
            mass *= share + weight
        return log_best, mass


def _weights(view: View, clue: Open, closed: int) -> tuple[float, float]:
    """Return the logarithm of a clue's best open cause, and the sum of all."""
    cause, weight = view.causes(clue.clue, closed)
    return (view.bests[cause] if cause >= 0 else NEVER), weight


def _tightest_first(tightness: tuple[float, Open]) -> float:
    return tightness[0]


def _log_add(left: float, right: float) -> float:
    high, low = max(left, right), min(left, right)
    return high if low == NEVER else high + math.log1p(math.exp(low - high))
