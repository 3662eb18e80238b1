"""Best-first search over sets of faults, the most probable first, with bounds for unexplored sets.

Bounds of the weight of a set with further faults added are never too low.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, combinations, count
from operator import mul
from typing import NamedTuple

import numpy as np

from amberbox.core.contracts import Budget
from amberbox.diagnosis.covering.model import Floats, FunctionGates, Ints, ModelTables, bits
from amberbox.diagnosis.covering.observations import FoldedEvidence, LikelihoodFactor

NEVER = -math.inf

Hits = tuple[tuple[int, float], ...]  # factors with 1 - detects


class ModeGroup:
    """Failure modes with the same effect on every relevant factor and function.

    ``hits`` are (factor, 1 - detects), ``component`` what they take down (-1: nothing relevant),
    ``modes`` from the most to the least probable.
    """

    __slots__ = ("_sums", "component", "hits", "log_best", "modes", "weights")

    def __init__(
        self, modes: list[int], log_weights: Sequence[float], hits: Hits, component: int
    ) -> None:
        if len(modes) > 1:
            modes.sort(key=lambda mode: (-log_weights[mode], mode))
        self.modes = modes
        self.weights = [log_weights[mode] for mode in modes]
        self.hits = hits
        self.component = component
        self.log_best = best = self.weights[0]
        first = best
        if len(modes) > 1:
            first += math.log(sum([math.exp(weight - best) for weight in self.weights]))
        self._sums = [0.0, first]

    def __len__(self) -> int:
        return len(self.modes)

    def log_sum(self, count: int) -> float:
        """Return the logarithm of the summed weight of all sets of ``count`` members."""
        while len(self._sums) <= count:
            self._extend()
        return self._sums[count]

    def _extend(self) -> None:
        """Add the next elementary symmetric polynomial of the weights, scaled by the best."""
        count = len(self._sums)
        sums = [1.0] + [0.0] * count
        for weight in self.weights:
            ratio = math.exp(weight - self.log_best)
            for k in range(count, 0, -1):
                sums[k] += sums[k - 1] * ratio
        self._sums.append(log_or_never(sums[count]) + count * self.log_best)


@dataclass(frozen=True, slots=True, eq=False)
class CoveringProblem:
    """The relevant groups, and for each factor and function the groups that act on it.

    ``unknown`` is the group of the unknown mode, its only member; -1 if there is none.

    ``causes[k]`` are the groups that can act on factor k, ``cause_masks`` the same as masks;
    ``limits[k]`` is its likelihood when all modes are present. ``log_all`` is the logarithm of the
    product of 1 + weight over all modes, ``log_odd`` that of all weights above 1.
    """

    factors: tuple[LikelihoodFactor, ...]
    groups: tuple[ModeGroup, ...]
    causes: tuple[tuple[int, ...], ...]
    cause_masks: tuple[int, ...]
    limits: tuple[float, ...]
    log_limits: tuple[float, ...]
    gates: FunctionGates
    relevant: int
    log_loss: Sequence[float]
    function_hits: Mapping[int, Sequence[tuple[int, float]]]
    log_all: float
    log_odd: float
    group_component: Ints
    log_sums: Floats
    log_bests: Floats
    pair_component: Ints
    pair_loss: Floats
    pair_function: Ints
    component_count: int
    unknown: int

    def log_losses(self, lost: int) -> Floats:
        """Return per group the logarithm of what its newly lost functions cost."""
        loss = self.pair_loss
        if lost:
            gone = np.zeros(len(self.log_loss), np.bool_)
            gone[list(bits(lost))] = True
            loss = np.where(gone[self.pair_function], 0.0, loss)
        per = np.bincount(self.pair_component, weights=loss, minlength=self.component_count + 1)
        losses: Floats = per[self.group_component].astype(np.float64)
        return losses


def covering_problem(tables: ModelTables, evidence: FoldedEvidence) -> CoveringProblem:
    """Find the modes that are relevant for any factor, and group those with the same effect."""
    function_hits = _function_hits(evidence.factors)
    matters = evidence.log_loss < 0
    matters[list(function_hits)] = True
    hits = _mode_hits(evidence, tables)
    components = _components(tables, hits, function_hits, np.flatnonzero(matters).tolist())
    groups = tuple(_groups(tables, evidence.log_weight, hits, components))
    causes = tuple(_causes(groups, evidence.factors, tables.gates))
    weights = np.array([weight for group in groups for weight in group.weights], np.float64)
    keep = matters[tables.pair_function]
    limits = tuple(_limits(groups, evidence.factors))
    loss = np.maximum(evidence.log_loss, -1e9)  # 0 * inf is no number
    return CoveringProblem(
        evidence.factors,
        groups,
        causes,
        tuple(sum(1 << group for group in of) for of in causes),
        limits,
        tuple(map(log_or_never, limits)),
        tables.gates,
        int.from_bytes(np.packbits(matters, bitorder="little").tobytes(), "little"),
        evidence.log_loss.tolist(),
        function_hits,
        float(np.logaddexp(0.0, weights).sum()),
        float(np.maximum(weights, 0.0).sum()),
        np.array([g.component for g in groups], np.int64),
        np.array([g.log_sum(1) for g in groups], np.float64),
        np.array([g.log_best for g in groups], np.float64),
        tables.pair_component[keep],
        loss[tables.pair_function[keep]],
        tables.pair_function[keep],
        tables.component_count,
        next((n for n, g in enumerate(groups) if g.modes[0] == tables.unknown), -1),
    )


def log_or_never(value: float) -> float:
    """Return the natural logarithm, minus infinity for zero."""
    return math.log(value) if value > 0 else NEVER


def _function_hits(factors: Sequence[LikelihoodFactor]) -> dict[int, list[tuple[int, float]]]:
    hits: dict[int, list[tuple[int, float]]] = {}
    for place, factor in enumerate(factors):
        for function, detects in factor.functions:
            if detects > 0:
                hits.setdefault(function, []).append((place, 1.0 - detects))
    return hits


def _mode_hits(evidence: FoldedEvidence, tables: ModelTables) -> dict[int, list[tuple[int, float]]]:
    hits: dict[int, list[tuple[int, float]]] = {}
    for place, factor in enumerate(evidence.factors):
        for mode, detects in factor.modes:
            if detects > 0 and evidence.log_weight[mode] > NEVER:
                hits.setdefault(mode, []).append((place, 1.0 - detects))
    return hits


def _components(
    tables: ModelTables, hits: Iterable[int], function_hits: Iterable[int], matter: Sequence[int]
) -> int:
    """Return the components whose state is tied to some factor through functions that matter."""
    supports = [tables.gates.support[place] for place in matter]
    tied = 0
    for mode in hits:
        place = tables.component[mode]
        tied |= 1 << place if place >= 0 else 0
    for function in function_hits:
        tied |= tables.gates.support[function]
    all_supports = 0
    for support in supports:
        all_supports |= support
    apart = supports
    while reached := [support for support in apart if support & tied]:
        apart = [support for support in apart if not support & tied]
        for support in reached:
            tied |= support
    return tied & all_supports


def _groups(
    tables: ModelTables,
    log_weight: Floats,
    hits: Mapping[int, Sequence[tuple[int, float]]],
    components: int,
) -> Iterator[ModeGroup]:
    """Yield the modes that act on factors, grouped by their effect, and the others by component."""
    weights = log_weight.tolist()
    found: dict[tuple[int, Hits, bool], list[int]] = {}
    for mode, seen in hits.items():
        place = tables.component[mode]
        component = place if place >= 0 and components >> place & 1 else -1
        found.setdefault((component, _merged(seen), mode == tables.unknown), []).append(mode)
    for (component, hit, _), modes in found.items():
        yield ModeGroup(modes, weights, hit, component)
    for component in bits(components):
        of = tables.modes_of[component]
        modes = [mode for mode in of if mode not in hits and weights[mode] > NEVER]
        if modes:
            yield ModeGroup(modes, weights, (), component)


def _merged(hits: Sequence[tuple[int, float]]) -> Hits:
    """Combine several hits on one factor, from repeated links, into one."""
    if len(hits) == 1:
        return (hits[0],)
    merged: dict[int, float] = {}
    for factor, miss in hits:
        merged[factor] = merged.get(factor, 1.0) * miss
    return tuple(merged.items())


def _causes(
    groups: Sequence[ModeGroup], factors: Sequence[LikelihoodFactor], gates: FunctionGates
) -> Iterator[tuple[int, ...]]:
    supports = [0] * len(factors)
    for place, factor in enumerate(factors):
        for function, detects in factor.functions:
            supports[place] |= gates.support[function] if detects > 0 else 0
    through = [(place, support) for place, support in enumerate(supports) if support]
    direct: list[dict[int, None]] = [{} for _ in factors]
    for number, group in enumerate(groups):
        for place, _ in group.hits:
            direct[place][number] = None
        if group.component >= 0:
            for place, support in through:
                if support >> group.component & 1:
                    direct[place][number] = None
    return (tuple(of) for of in direct)


def _limits(groups: Sequence[ModeGroup], factors: Sequence[LikelihoodFactor]) -> Iterator[float]:
    least = [1.0] * len(factors)
    for group in groups:
        for place, miss in group.hits:
            least[place] *= miss ** len(group)
    for place, factor in enumerate(factors):
        for _, detects in factor.functions:
            least[place] *= 1.0 - detects
        yield factor.alpha + factor.beta * least[place]


class FaultCounts(NamedTuple):
    """A state of the search: the number of faulty members of each group, and no other faults.

    ``misses[k]`` is q of factor k. ``log_best`` is the weight of the most probable choice of
    members, ``log_sum`` that of all choices; both include the cost of the lost functions.
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


def no_faults(problem: CoveringProblem) -> FaultCounts:
    """Return the state without any fault."""
    return FaultCounts((), (1.0,) * len(problem.factors), 0, 0, 0.0, 0.0)


def with_one_more(problem: CoveringProblem, state: FaultCounts, number: int) -> FaultCounts:
    """Return the state with one more member of a group faulty."""
    group, count = problem.groups[number], state.members(number)
    others = tuple(pair for pair in state.counts if pair[0] != number)
    misses = list(state.misses)
    for factor, miss in group.hits:
        misses[factor] *= miss
    down, lost, cost = state.down, state.lost, 0.0
    if group.component >= 0 and not down >> group.component & 1:
        down |= 1 << group.component
        lost = problem.gates.lost(down) & problem.relevant
        for function in bits(lost & ~state.lost):
            cost += problem.log_loss[function]
            for factor, miss in problem.function_hits.get(function, ()):
                misses[factor] *= miss
    more = group.log_sum(count + 1) - (group.log_sum(count) if count else 0.0)
    return FaultCounts(
        (*others, (number, count + 1)),
        tuple(misses),
        down,
        lost,
        state.log_best + cost + group.weights[count],
        state.log_sum + cost + more,
    )


def log_likelihood(problem: CoveringProblem, state: FaultCounts) -> float:
    """Return the logarithm of the product of all factors' likelihoods."""
    total = 0.0
    for factor, miss in zip(problem.factors, state.misses, strict=True):
        total += log_or_never(factor.alpha + factor.beta * miss)
    return total


MOST_NODES = 2_000  # the most nodes that are opened by default (a few kB and 0.1 to 1 ms each)
LARGEST_EXPONENT = 700.0

FAR = 0.5  # A likelihood factor with less than this share of its limit is not explained yet

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
        left = self.total - sum(self.sums[group] for group in bits(hidden))
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
        self._open: dict[tuple[int, int], OpenCauses] = {}

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
            hidden |= problem.cause_masks[factor.factor]
            log_share += factor.log_share
        best = view.unrelated(hidden, log_share)
        if factors:
            right = self._explaining(state, closed, factors)
            better = best if best.log_best >= right.log_best else right
            high, low = max(best.log_mass, right.log_mass), min(best.log_mass, right.log_mass)
            mass = high if low == NEVER else high + math.log1p(math.exp(low - high))
            best = SearchBound(better.log_best, mass, better.branch)
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
        problem, top = self._problem, 0.0
        factors = []
        for place, factor in enumerate(problem.factors):
            value = factor.alpha + factor.beta * state.misses[place]
            mask = problem.cause_masks[place]
            if factor.beta < 0 and mask & ~closed:
                top += problem.log_limits[place]
                share = value / problem.limits[place]
                if share < FAR:
                    causes = self._open_causes(place, closed)
                    factors.append(
                        UnexplainedFactor(place, share, max(SMALLEST, log_or_never(share)), causes)
                    )
            else:
                top += log_or_never(value)
        return top, factors

    def _open_causes(self, factor: int, closed: int) -> OpenCauses:
        key = (factor, closed & self._problem.cause_masks[factor])
        known = self._open.get(key)
        if known is None:
            groups = [group for group in self._problem.causes[factor] if not closed >> group & 1]
            known = self._open[key] = OpenCauses(len(self._open), groups)
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
        for factor in factors:
            for group in factor.causes.groups:
                gains[group] = gains.get(group, 0.0) - factor.log_share
        best = max(view.bests[group] for group in gains)
        left = sum(view.sums[group] for group in gains)
        tightest, among, mass = math.inf, None, left
        order: list[tuple[float, UnexplainedFactor]] = []
        for factor in factors:
            cause, weight = view.of(factor.causes)
            without = factor.log_share + best
            mass = min(mass, weight + factor.share * left)
            order.append((max(cause, without), factor))
            if order[-1][0] < tightest:
                tightest, among = order[-1][0], factor.causes.groups if cause >= without else None
        net = {group: view.bests[group] + gain for group, gain in gains.items()}
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
        for group, gain in gains.items():
            rising += max(0.0, self._free.bests[group] + gain)
            gain_ratio = math.exp(min(LARGEST_EXPONENT, gain))
            log_sum += view.sums[group] * gain_ratio
            others += math.log1p(self._free.sums[group] * gain_ratio)
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
        chosen, seen = [], 0
        for factor in factors:
            mask = problem.cause_masks[factor.factor] & ~hidden
            if not mask & seen:
                chosen.append(factor)
                seen |= mask
        causes = [self._open_causes(factor.factor, hidden) for factor in chosen]
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
        self.bounds = SearchBounds(problem)
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
        full = more.members(group) == len(self.problem.groups[group])
        if more.log_best > NEVER:
            self.reach(more)
            self.push_within(best.bound, more, best.closed | (1 << group if full else 0))
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
