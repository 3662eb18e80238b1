"""Bounds on what can still come of a set of faults when more are added; they never lie low.

Three facts carry them. The likelihood of a present symptom only rises with more causes, up to a
known limit. Lost functions cost what their absent symptoms say, once: a set pays at least what
any one of its members would. The sum over all subsets of groups of the product of their weights
is the product of 1 + weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from operator import mul

import numpy as np
from numpy.typing import NDArray

from amberbox.diagnosis.covering.problem import NEVER, Problem, log
from amberbox.diagnosis.covering.state import State
from amberbox.diagnosis.covering.tables import Floats

LARGEST_EXPONENT = 700.0

SMALLEST = -1000.0
"""The logarithm of the least share that a clue counts with: gains must stay finite."""


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


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What adding one more group weighs while certain functions are lost.

    ``bests`` (logarithms) and ``sums`` bound, per group, the weight of its best member and of
    all members, with what the functions cost that this member alone would lose.
    """

    bests: Floats
    sums: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Unexplained:
    """The clues far from their limits, and the open groups that can bring them nearer.

    ``log_shares`` are the shares of their limits that they have now, ``causes`` a row of groups
    per clue, ``gains`` per group the logarithm of what it can make of all of them at most.
    """

    clues: list[int]
    shares: list[float]
    log_shares: Floats
    causes: NDArray[np.bool_]
    gains: Floats

    @property
    def log_share(self) -> float:
        """Return the share of the limit that all clues together have now."""
        return float(self.log_shares.sum())


class Bounds:
    """Bounds for one problem; remembers what weighs how much while which functions are lost."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._views: dict[int, View] = {}
        self._causes = np.zeros((len(problem.clues), len(problem.groups)), np.bool_)
        for clue, causes in enumerate(problem.causes):
            self._causes[clue, list(causes)] = True
        self._free = View(problem.log_bests, np.exp(problem.log_sums))

    def beyond(self, state: State, closed: int) -> Bound:
        """Bound all sets that add one or more members of groups that are not closed.

        Such a set has no cause of any clue that is not explained yet, then their likelihoods
        stay; or it has one, then several bounds hold and the tightest counts.
        """
        problem, view = self._problem, self._view(state.lost)
        top, clues, shares = self._limits(state, closed)
        if top == NEVER:
            return DEAD
        is_open = ~_unpacked(closed, len(problem.groups))
        if not clues:
            best = _unrelated(view, is_open, 0.0)
        else:
            open_clues = self._unexplained(clues, shares, is_open)
            causes = np.logical_or.reduce(open_clues.causes, axis=0)
            apart = _unrelated(view, is_open & ~causes, open_clues.log_share)
            best = _either(apart, self._explaining(state, open_clues, causes, closed))
        return Bound(
            best.log_best + top + state.log_best + problem.log_odd,
            best.log_mass + top + state.log_sum + problem.log_all,
            best.branch,
        )

    def _view(self, lost: int) -> View:
        if lost not in self._views:
            losses = self._problem.log_losses(lost)
            sums = np.exp(self._problem.log_sums + losses)
            self._views[lost] = View(self._problem.log_bests + losses, sums)
        return self._views[lost]

    def _limits(self, state: State, closed: int) -> tuple[float, list[int], list[float]]:
        """Return the most that open groups make of all clues, and those far from their limit."""
        problem, top = self._problem, 0.0
        clues, shares = [], []
        for place, clue in enumerate(problem.clues):
            value = clue.alpha + clue.beta * state.misses[place]
            limit = problem.limits[place]
            if clue.beta < 0 and problem.cause_masks[place] & ~closed:
                top += problem.log_limits[place]
                if value < 0.5 * limit:
                    clues.append(place)
                    shares.append(value / limit)
            else:
                top += log(value)
        return top, clues, shares

    def _unexplained(
        self, clues: list[int], shares: list[float], is_open: NDArray[np.bool_]
    ) -> Unexplained:
        log_shares = np.array([max(SMALLEST, log(share)) for share in shares])
        causes: NDArray[np.bool_] = self._causes[clues] & is_open
        gains = -log_shares @ causes
        return Unexplained(clues, shares, log_shares, causes, gains)

    def _explaining(
        self, state: State, clues: Unexplained, causes: NDArray[np.bool_], closed: int
    ) -> Bound:
        """Bound the sets that have one of these causes of clues that are not explained yet.

        Each clue gives a bound of its own: either one of its causes is added, or none is and
        its likelihood stays as it is. So do clues without common causes together, and so do
        the gains of all that may be added, as if no two of them explained the same clue.
        """
        view = self._view(state.lost)
        best, left = float(view.bests[causes].max()), float(view.sums[causes].sum())
        per_clue = np.where(clues.causes, view.bests, NEVER).max(axis=1)
        tightness = np.maximum(per_clue, clues.log_shares + best)
        first = int(tightness.argmin())
        mass = float((clues.causes @ view.sums + np.array(clues.shares) * left).min())
        among = clues.causes[first] if per_clue[first] >= tightness[first] else causes
        net = view.bests + clues.gains
        branch = int(np.where(among, net, NEVER).argmax())
        result = Bound(float(tightness[first]), log(min(mass, left)), branch)
        gained = self._gained(view, clues, causes, net)
        if gained.log_best < result.log_best:
            branch = gained.branch
        bounds = [result, gained]
        if len(clues.clues) > 1:
            order = tightness.argsort(kind="stable").tolist()
            bounds.append(self._together(state, closed, clues, order, (best, left)))
        return Bound(min(b.log_best for b in bounds), min(b.log_mass for b in bounds), branch)

    def _gained(
        self, view: View, clues: Unexplained, causes: NDArray[np.bool_], net: Floats
    ) -> Bound:
        """Bound by gains: what each group can make of all clues, whatever others make of them."""
        free = np.where(causes, self._free.bests + clues.gains, NEVER)
        rising = free > 0
        branch = int(np.where(causes, net, NEVER).argmax())
        log_best = float(free[rising].sum()) if rising.any() else float(net[branch])
        gains = np.exp(np.minimum(clues.gains[causes], LARGEST_EXPONENT))
        with np.errstate(over="ignore"):
            others = float(np.log1p(self._free.sums[causes] * gains).sum())
            one = log(float((view.sums[causes] * gains).sum()))
        return Bound(log_best + clues.log_share, one + others + clues.log_share, branch)

    def _together(
        self,
        state: State,
        closed: int,
        clues: Unexplained,
        order: list[int],
        rest: tuple[float, float],
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
        for place in order:
            mask = problem.cause_masks[clues.clues[place]] & ~hidden
            if not mask & seen:
                chosen.append(place)
                seen |= mask
        rows = clues.causes[chosen]
        if may_be_unknown:
            rows[:, unknown] = False
        free = _weights(self._free, rows)
        charged = _weights(self._view(state.lost), rows[:1])
        shares = [clues.shares[place] for place in chosen]
        log_best, mass = _apart(shares, charged[0], free, rest)
        if may_be_unknown:
            places = [clues.clues[place] for place in chosen]
            best, more = self._with_unknown(state, places, free)
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


def _unrelated(view: View, groups: NDArray[np.bool_], log_share: float) -> Bound:
    """Bound the sets of groups that change no likelihood."""
    if not groups.any():
        return DEAD
    branch = int(np.where(groups, view.bests, NEVER).argmax())
    mass = log(float(view.sums[groups].sum()))
    return Bound(float(view.bests[branch]) + log_share, mass + log_share, branch)


def _either(left: Bound, right: Bound) -> Bound:
    better = left if left.log_best >= right.log_best else right
    high, low = max(left.log_mass, right.log_mass), min(left.log_mass, right.log_mass)
    mass = high if low == NEVER else high + math.log1p(math.exp(low - high))
    return Bound(better.log_best, mass, better.branch)


def _weights(view: View, rows: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return per row of groups the logarithm of the best weight, and the sum of all."""
    bests = np.where(rows, view.bests, NEVER).max(axis=1)
    return list(zip(bests.tolist(), (rows @ view.sums).tolist(), strict=True))


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


def _unpacked(mask: int, width: int) -> NDArray[np.bool_]:
    data = np.frombuffer(mask.to_bytes(width // 8 + 1, "little"), np.uint8)
    return np.unpackbits(data, count=width, bitorder="little").astype(np.bool_)
