"""Upper bounds of what the sets of faults beyond a state of the search can weigh.

Bounds of the weight of a set with further faults added are never too low.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from operator import mul
from typing import NamedTuple

import numpy as np

from amberbox.diagnosis.covering.model import Floats, bits
from amberbox.diagnosis.covering.problem import (
    NEVER,
    CoveringProblem,
    FaultCounts,
    as_mask,
    log_or_never,
)

LARGEST_EXPONENT = 700.0
FAR = 0.5  # A likelihood factor with less than this share of its limit is not explained yet
NEAR = -math.log(FAR)

# The logarithm of the least share that a factor counts with: gains must stay finite
SMALLEST = -1000.0


class SearchBound(NamedTuple):
    """Upper bounds of the sets beyond a state.

    ``log_best`` is the logarithm of the best set's weight, ``log_mass`` that of all together.
    ``branch`` is the group to decide next, -1 when none is open.
    """

    log_best: float
    log_mass: float
    branch: int


DEAD = SearchBound(NEVER, NEVER, -1)


class OpenCauses(NamedTuple):
    """The open causes of a factor; equal ones have the same number."""

    number: int
    groups: Sequence[int]


class GroupWeights:
    """Weights of adding one more group while certain functions are lost.

    ``bests`` (logarithms) and ``sums`` bound, per group, the weight of its best member and of all
    members, including the cost of the functions that only this member would lose.
    """

    __slots__ = ("_known", "_order", "bests", "sums", "total")

    def __init__(self, log_bests: Floats, log_sums: Floats) -> None:
        self.bests: list[float] = log_bests.tolist()
        self.sums: list[float] = np.exp(log_sums).tolist()
        self.total = sum(self.sums)
        self._order: list[int] | None = None
        self._known: dict[int, tuple[float, float]] = {}

    def of(self, causes: OpenCauses) -> tuple[float, float]:
        """Return the logarithm of the best weight among causes, and the sum of all."""
        known = self._known.get(causes.number)
        if known is None:
            best = max([self.bests[group] for group in causes.groups], default=NEVER)
            known = best, sum([self.sums[group] for group in causes.groups])
            self._known[causes.number] = known
        return known

    def unrelated(self, hidden: int, log_share: float) -> SearchBound:
        """Bound the sets of groups that are not hidden; they change no likelihood."""
        if self._order is None:
            self._order = sorted(range(len(self.bests)), key=self.bests.__getitem__, reverse=True)
        branch = next((group for group in self._order if not hidden >> group & 1), -1)
        if branch < 0:
            return DEAD
        sums = self.sums
        left = self.total - sum([sums[group] for group in bits(hidden)])
        # What is left of a difference may be a little less than its best member.
        mass = max(log_or_never(left), self.bests[branch]) + log_share
        return SearchBound(self.bests[branch] + log_share, mass, branch)


class UnexplainedFactor(NamedTuple):
    """A factor far from its limit: the share of it that it has now, and its open causes."""

    factor: int
    share: float
    log_share: float
    causes: OpenCauses


class SearchBounds:
    """Bounds for one problem; caches the weights of groups by the functions lost."""

    def __init__(self, problem: CoveringProblem) -> None:
        self._problem = problem
        self._views: dict[int, GroupWeights] = {}
        self._free = GroupWeights(problem.log_bests, problem.log_sums)
        self._open: dict[int, OpenCauses] = {}
        coefficients = [(factor.alpha, factor.beta) for factor in problem.factors]
        self._terms = [
            (*of, mask, limit, log_limit)
            for of, mask, limit, log_limit in zip(
                coefficients, problem.causes, problem.limits, problem.log_limits, strict=True
            )
        ]

    def beyond(self, state: FaultCounts, closed: int) -> SearchBound:
        """Bound all sets that add one or more members of groups that are not closed.

        Such a set has no cause of any factor that is not explained yet, then their likelihoods
        stay; or it has one, then several bounds hold and the tightest counts.
        """
        problem, view = self._problem, self._view(state.lost)
        top, factors = self._limits(state, closed)
        if top == NEVER:
            return DEAD
        hidden, log_share = closed, 0.0
        for factor in factors:
            hidden |= problem.causes[factor.factor]
            log_share += factor.log_share
        best = view.unrelated(hidden, log_share)
        if factors:
            best = _either(best, self._explaining(state, closed, factors))
        return SearchBound(
            best.log_best + top + state.log_best + problem.log_odd,
            best.log_mass + top + state.log_sum + problem.log_all,
            best.branch,
        )

    def _view(self, lost: int) -> GroupWeights:
        if lost not in self._views:
            problem = self._problem
            losses = problem.log_losses(lost)
            self._views[lost] = GroupWeights(problem.log_bests + losses, problem.log_sums + losses)
        return self._views[lost]

    def _limits(self, state: FaultCounts, closed: int) -> tuple[float, list[UnexplainedFactor]]:
        """Return the most that open groups make of all factors, and those far from their limit."""
        top, open_groups = 0.0, ~closed
        factors = []
        terms = zip(self._terms, state.misses, strict=True)
        for place, ((alpha, beta, mask, limit, log_limit), miss) in enumerate(terms):
            value = alpha + beta * miss
            if beta < 0 and mask & open_groups:
                top += log_limit
                share = value / limit
                if share < FAR:
                    causes = self._open_causes(mask & open_groups)
                    factors.append(
                        UnexplainedFactor(place, share, max(SMALLEST, log_or_never(share)), causes)
                    )
            else:
                top += log_or_never(value)
        return top, factors

    def _open_causes(self, mask: int) -> OpenCauses:
        known = self._open.get(mask)
        if known is None:
            known = self._open[mask] = OpenCauses(len(self._open), tuple(bits(mask)))
        return known

    def _explaining(
        self, state: FaultCounts, closed: int, factors: list[UnexplainedFactor]
    ) -> SearchBound:
        """Bound the sets that have a cause of factors that are not explained yet.

        Each factor gives a bound of its own: either one of its causes is added, or none is and its
        likelihood stays the same. Factors without common causes together give another bound, and so
        does the sum of the gains of all causes, as if no two of them explained the same factor.
        """
        view = self._view(state.lost)
        gains: dict[int, float] = {}
        for _, _, log_share, causes in factors:
            for group in causes.groups:
                gains[group] = gains.get(group, 0.0) - log_share
        bests, sums = view.bests, view.sums
        best = max([bests[group] for group in gains])
        left = sum([sums[group] for group in gains])
        tightest, among, mass = math.inf, None, left
        order: list[tuple[float, UnexplainedFactor]] = []
        for factor in factors:
            cause, weight = view.of(factor.causes)
            without = factor.log_share + best
            mass = min(mass, weight + factor.share * left)
            order.append((max(cause, without), factor))
            if order[-1][0] < tightest:
                tightest, among = order[-1][0], factor.causes.groups if cause >= without else None
        net = {group: bests[group] + gain for group, gain in gains.items()}
        result = SearchBound(tightest, log_or_never(mass), max(among or net, key=net.__getitem__))
        if len(factors) == 1:
            return result
        order.sort(key=_tightest_first)
        gained = self._gained(view, factors, gains, net)
        apart = self._together(state, closed, [factor for _, factor in order], (best, left))
        return SearchBound(
            min(result.log_best, gained.log_best, apart.log_best),
            min(result.log_mass, gained.log_mass, apart.log_mass),
            gained.branch if gained.log_best < result.log_best else result.branch,
        )

    def _gained(
        self,
        view: GroupWeights,
        factors: list[UnexplainedFactor],
        gains: Mapping[int, float],
        net: Mapping[int, float],
    ) -> SearchBound:
        """Bound by gains: the most that each group can gain on all factors, independent of other
        groups.
        """
        log_share = sum(factor.log_share for factor in factors)
        branch = max(net, key=net.__getitem__)
        rising = log_sum = others = 0.0
        bests, free, sums = self._free.bests, self._free.sums, view.sums
        for group, gain in gains.items():
            if bests[group] + gain > 0.0:
                rising += bests[group] + gain
            gain_ratio = math.exp(gain if gain < LARGEST_EXPONENT else LARGEST_EXPONENT)
            log_sum += sums[group] * gain_ratio
            others += math.log1p(free[group] * gain_ratio)
        log_best = rising if rising > 0 else net[branch]
        if max(gains.values()) > LARGEST_EXPONENT:
            return SearchBound(log_best + log_share, math.inf, branch)
        return SearchBound(log_best + log_share, log_or_never(log_sum) + others + log_share, branch)

    def _together(
        self,
        state: FaultCounts,
        closed: int,
        factors: list[UnexplainedFactor],
        rest: tuple[float, float],
    ) -> SearchBound:
        """Bound by factors that have no open cause in common but the unknown mode.

        Either the unknown mode is not added: then each factor needs a cause of its own or stays;
        what functions cost is charged for one member only. Or it is: then each factor has at
        least the share that the unknown mode gives it.
        """
        problem, unknown = self._problem, self._problem.unknown
        may_be_unknown = unknown >= 0 and not closed >> unknown & 1
        hidden = closed | (1 << unknown if may_be_unknown else 0)
        chosen, causes, seen = [], [], 0
        for factor in factors:
            mask = problem.causes[factor.factor] & ~hidden
            if not mask & seen:
                chosen.append(factor)
                causes.append(self._open_causes(mask))
                seen |= mask
        free = [self._free.of(of) for of in causes]
        charged = self._view(state.lost).of(causes[0])
        log_best, mass = _apart([factor.share for factor in chosen], charged, free, rest)
        if may_be_unknown:
            best, more = self._with_unknown(state, [factor.factor for factor in chosen], free)
            log_best, mass = max(log_best, best), mass + more
        return SearchBound(log_best, log_or_never(mass), -1)

    def _with_unknown(
        self, state: FaultCounts, places: list[int], free: list[tuple[float, float]]
    ) -> tuple[float, float]:
        problem = self._problem
        group = problem.groups[problem.unknown]
        shows = dict(group.hits)
        log_best, mass = group.log_best, math.exp(min(LARGEST_EXPONENT, group.log_best))
        for place, (best, weight) in zip(places, free, strict=True):
            factor = problem.factors[place]
            miss = state.misses[place] * shows.get(place, 1.0)
            share = (factor.alpha + factor.beta * miss) / problem.limits[place]
            log_best += max(log_or_never(share), best)
            mass *= share + weight
        return log_best, mass


class FactorReach(NamedTuple):
    """The most that the causes of a factor make of it, beyond a state.

    That is its limit; or, of a size that lost functions explain to a share only, what all of them
    make of it. Then ``lifts`` are the logarithms of how much more each group that acts on it itself
    can make of it. ``debt`` is how far the factor is from there, as a logarithm.
    """

    log_value: float
    log_limit: float
    causes: int
    debt: float
    lifts: Sequence[tuple[int, float]]


BANDS = (5.0, 15.0, math.inf)  # logarithms of what the losses of the dearest group of a set cost


class GradedBounds(SearchBounds):
    """Bounds for evidence with sizes, of which each cause explains a share only.

    The causes of each factor pay its debt, or as much as their weights can pay: a set gains no more
    than its members pay, so it remains below the limits by all that was paid. What a set loses
    costs at least as much as what any one of its groups loses. This and the rest of that group's
    weight count in addition, and sets are told apart by the dearest such group.
    """

    def __init__(self, problem: CoveringProblem) -> None:
        super().__init__(problem)
        self._costs: list[float] = (-problem.log_bests).tolist()
        self._spread: list[float] = (problem.log_sums - problem.log_bests).tolist()
        self._paid_off = as_mask(problem.log_bests >= 0)
        self._direct = [list[tuple[int, float]]() for _ in problem.factors]
        for number, group in enumerate(problem.groups):
            for place, miss in group.hits:
                self._direct[place].append((number, miss**group.most))
        self._functions = [
            sum(1 << function for function, detects in factor.functions if detects > 0)
            for factor in problem.factors
        ]
        self._losers = {function: self._that_lose(function) for function in problem.function_hits}
        self._reaches: dict[tuple[int, float, float, int], FactorReach] = {}
        self._losses: dict[int, tuple[list[float], list[tuple[int, int]]]] = {}

    def _that_lose(self, function: int) -> int:
        support = self._problem.gates.support[function]
        return sum(
            1 << number
            for number, group in enumerate(self._problem.groups)
            if group.component >= 0 and support >> group.component & 1
        )

    def beyond(self, state: FaultCounts, closed: int) -> SearchBound:
        """Bound all sets that add one or more members of groups that are not closed."""
        problem, top, debts, hidden = self._problem, 0.0, 0.0, closed
        lifts: dict[int, float] = {}
        factors: list[tuple[int, float]] = []
        for place in range(len(problem.factors)):
            reach = self._reach(place, state)
            causes = reach.causes & ~closed
            if not causes:
                top += reach.log_value
                continue
            top += reach.log_limit
            for group, lift in reach.lifts:
                if not closed >> group & 1:
                    lifts[group] = lifts.get(group, 0.0) + lift
            if reach.debt > NEAR:
                factors.append((causes, reach.debt))
                debts += reach.debt
                hidden |= causes
        if top == NEVER:
            return DEAD
        best = self._unrelated(state.lost, hidden, lifts, debts)
        if factors:
            best = _either(best, self._paying(state.lost, factors, lifts))
        log_odd, log_all = problem.log_odd, problem.log_all
        for group, lift in lifts.items():
            own, weight = self._free.bests[group], self._free.sums[group]
            log_odd += max(0.0, own + lift) - max(0.0, own)
            shares = -math.expm1(-weight) * math.expm1(min(LARGEST_EXPONENT, lift))
            log_all += math.log1p(shares) + max(0.0, lift - LARGEST_EXPONENT)
        return SearchBound(
            best.log_best + top + state.log_best + log_odd,
            best.log_mass + top + state.log_sum + log_all,
            best.branch,
        )

    def _reach(self, place: int, state: FaultCounts) -> FactorReach:
        rest = state.misses[place + 1] if self._problem.factors[place].gain else 0.0
        key = (place, state.misses[place], rest, state.lost & self._functions[place])
        known = self._reaches.get(key)
        if known is None:
            known = self._reaches[key] = self._reach_of(*key)
        return known

    def _reach_of(self, place: int, miss: float, rest: float, lost: int) -> FactorReach:
        factor, limit = self._problem.factors[place], self._problem.limits[place]
        base = factor.alpha + factor.gain * rest
        log_value = log_or_never(base + factor.beta * miss)
        if factor.beta >= 0 or limit <= 0:
            return FactorReach(log_value, NEVER, 0, 0.0, ())
        causes, left, lifts = sum(1 << group for group, _ in self._direct[place]), miss, []
        for function, detects in factor.functions:
            if detects > 0 and not lost >> function & 1:
                causes |= self._losers[function]
                left *= 1.0 - detects
        by_functions = base + factor.beta * left
        if self._functions[place] and 0 < by_functions < FAR * limit:
            limit = by_functions
            for group, shown in self._direct[place]:
                lifts.append((group, math.log((base + factor.beta * left * shown) / limit)))
        debt = min(-SMALLEST, math.log(limit) - log_value)
        return FactorReach(log_value, math.log(limit), causes, debt, lifts)

    def _unrelated(
        self, lost: int, hidden: int, lifts: Mapping[int, float], debts: float
    ) -> SearchBound:
        """Bound the sets that pay no debt."""
        view = self._view(lost)
        best = view.unrelated(hidden, -debts)
        for group, lift in lifts.items():
            if not hidden >> group & 1:
                own = view.bests[group] + lift - debts
                best = _either(best, SearchBound(own, own + self._spread[group], group))
        return best

    def _paying(
        self, lost: int, factors: list[tuple[int, float]], lifts: Mapping[int, float]
    ) -> SearchBound:
        """Bound the sets that pay debts: those that some group can pay are due first."""
        costs, paid_off, payers = self._costs.copy(), self._paid_off, 0
        for group, lift in lifts.items():
            costs[group] -= lift
            paid_off |= 1 << group if costs[group] <= 0 else 0
        for causes, _ in factors:
            payers |= causes
        factors.sort(key=_fewest_causes_first)
        losses, bands = self._losses_of(lost)
        result = DEAD
        for within, band in bands:
            if payers & band:
                left = costs.copy()
                paid, more = self._pay(factors, within, left, paid_off)
                best, mass, branch = NEVER, 0.0, -1
                for group in self._open_causes(payers & band).groups:
                    charged = losses[group] - max(0.0, left[group])
                    mass += math.exp(
                        min(LARGEST_EXPONENT, losses[group] - left[group] + self._spread[group])
                    )
                    if charged > best:
                        best, branch = charged, group
                part = SearchBound(best - paid, log_or_never(mass) + more - paid, branch)
                result = _either(result, part)
        return result

    def _pay(
        self, factors: Sequence[tuple[int, float]], within: int, costs: list[float], paid_off: int
    ) -> tuple[float, float]:
        """Let groups pay for factors; return what was paid, and how much this adds to the mass."""
        total, paying = 0.0, 0
        for causes, debt in factors:
            payers = causes & within
            if payers & paid_off:
                continue
            groups = self._open_causes(payers).groups
            price = min([debt, *[costs[group] for group in groups]])
            for group in groups:
                costs[group] -= price
                if costs[group] <= 0:
                    paid_off |= 1 << group
            total += price
            paying |= payers
        more = [
            math.log1p(math.exp(self._spread[g] - costs[g]))
            for g in self._open_causes(paying).groups
        ]
        return total, sum(more)

    def _losses_of(self, lost: int) -> tuple[list[float], list[tuple[int, int]]]:
        """Return per group what its newly lost functions cost, and (groups up to a band, in it)."""
        known = self._losses.get(lost)
        if known is None:
            losses, bands, before = self._problem.log_losses(lost), list[tuple[int, int]](), 0
            for most in BANDS:
                within = as_mask(losses >= -most)
                bands.append((within, within & ~before))
                before = within
            known = self._losses[lost] = losses.tolist(), bands
        return known


def _fewest_causes_first(factor: tuple[int, float]) -> int:
    return factor[0].bit_count()


def _either(one: SearchBound, other: SearchBound) -> SearchBound:
    """Bound the sets that are bounded by either."""
    better = one if one.log_best >= other.log_best else other
    high, low = max(one.log_mass, other.log_mass), min(one.log_mass, other.log_mass)
    mass = high if low == NEVER else high + math.log1p(math.exp(low - high))
    return SearchBound(better.log_best, mass, better.branch)


def _tightest_first(tightness: tuple[float, UnexplainedFactor]) -> float:
    return tightness[0]


def _apart(
    shares: list[float],
    charged: tuple[float, float],
    free: list[tuple[float, float]],
    rest: tuple[float, float],
) -> tuple[float, float]:
    """Bound factors without common causes: the first is charged what its functions cost."""
    best_open, left = rest
    weights = [charged, *free[1:]]
    pairs = [(log_or_never(share), best) for share, (best, _) in zip(shares, weights, strict=True)]
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
